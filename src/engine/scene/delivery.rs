//! Which steps a stream carries, for writers and for subscribers, and the rate of subscriptions.

use std::time::Duration;

use modalcast_model::error::{Result, invalid};

/// Upper limit of the time between two results of a stream, so that a deadline always fits into an `Instant`: 10 years.
const MAX_INTERVAL: Duration = Duration::from_secs(10 * 365 * 86_400);

/// Which steps a stream carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Every step, in order. A lossless subscriber that reads slowly makes a lossless writer wait, until it exceeds the
    /// stall budget. If the writer is `Latest`, such a subscriber skips steps.
    Lossless,
    /// A subscriber receives the newest step, starting with the current one if the scene has had a step. Queued steps
    /// of a writer are merged into one whose effect on the state equals applying all of them in order.
    Latest,
}

/// The delivery of a stream, and a limit on its rate. Only [`Delivery::Latest`] has a limit, because a limit makes a
/// stream skip steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamDelivery {
    delivery: Delivery,
    max_hz: f64,
}

impl StreamDelivery {
    /// Limits a stream to `max_hz` results per second; 0 means no limit.
    ///
    /// # Errors
    /// `Invalid` unless `max_hz` is 0 or, for [`Delivery::Latest`], a finite positive number.
    pub fn new(delivery: Delivery, max_hz: f64) -> Result<Self> {
        let is_valid = max_hz == 0.0 || (delivery == Delivery::Latest && max_hz.is_finite() && max_hz > 0.0);
        let expected = match delivery {
            Delivery::Lossless => "0, because a lossless stream carries every step",
            Delivery::Latest => "0 or a finite number above 0",
        };
        if is_valid { Ok(Self { delivery, max_hz }) } else { Err(invalid("max_hz", expected, max_hz)) }
    }

    pub const fn delivery(self) -> Delivery {
        self.delivery
    }

    /// Maximum number of results per second; 0 means no limit.
    pub const fn max_hz(self) -> f64 {
        self.max_hz
    }

    /// Time between two results at the maximum rate; `None` if there is no limit.
    pub(super) fn min_interval(self) -> Option<Duration> {
        let to_interval = |max_hz: f64| Duration::try_from_secs_f64(max_hz.recip()).unwrap_or(MAX_INTERVAL);
        (self.max_hz > 0.0).then(|| to_interval(self.max_hz).min(MAX_INTERVAL))
    }
}

impl From<Delivery> for StreamDelivery {
    /// Without a limit.
    fn from(delivery: Delivery) -> Self {
        Self { delivery, max_hz: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_latest_streams_have_a_positive_finite_rate_limit() {
        for delivery in [Delivery::Lossless, Delivery::Latest] {
            assert_eq!(StreamDelivery::new(delivery, 0.0), Ok(delivery.into()));
            for max_hz in [-1.0, f64::NAN, f64::INFINITY] {
                assert!(StreamDelivery::new(delivery, max_hz).is_err(), "{delivery:?}, {max_hz}");
            }
        }
        let error = StreamDelivery::new(Delivery::Lossless, 10.0).expect_err("expected an error").to_string();
        assert!(error.contains("max_hz") && error.contains("lossless"), "{error}");
        let interval = |max_hz| StreamDelivery::new(Delivery::Latest, max_hz).expect("expected a limit").min_interval();
        assert_eq!(interval(0.0), None);
        assert_eq!(interval(8.0), Some(Duration::from_millis(125)));
        assert_eq!(interval(1e300), Some(Duration::ZERO));
        for max_hz in [1e-12, f64::MIN_POSITIVE, f64::from_bits(1)] {
            assert_eq!(interval(max_hz), Some(MAX_INTERVAL), "{max_hz}");
        }
    }
}
