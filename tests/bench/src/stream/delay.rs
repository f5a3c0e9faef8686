//! Rates over a connection with a round trip of 50 ms, beside those without delay.

use modalcast_client::Client;
use serde::Serialize;

use super::StreamReportOptions;
use super::motion;
use super::peers::proxy::DelayProxy;
use super::peers::viewer::Content;
use super::rates::{self, Viewers};
use super::session::Session;
use modalcast_model::error::{Result, fault_in};

/// Delay of each direction in milliseconds.
const ONE_WAY_MS: u64 = 25;

/// What crosses the delayed connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DelayedStream {
    /// Lossless steps from a distant physics process.
    Steps,
    /// Replies for a distant viewer.
    Replies(Content),
}

/// Rates with and without delay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DelayResult {
    /// What crosses the connection.
    pub content: String,
    pub round_trip_ms: u64,
    pub steps: u64,
    /// Bytes of a step or of a reply, on average.
    pub bytes: f64,
    /// Rate without a proxy.
    pub direct_per_second: f64,
    /// Rate through a proxy without delay: the limit that the proxy itself sets.
    pub undelayed_per_second: f64,
    pub delayed_per_second: f64,
    /// `delayed_per_second` divided by `undelayed_per_second`.
    pub of_undelayed: f64,
}

/// The rate and the mean size of one measurement.
struct Measured {
    per_second: f64,
    bytes: f64,
}

/// Measures a stream directly, through a proxy without delay, and through a proxy with delay.
///
/// # Errors
/// `Fault` when a process fails.
pub(super) fn measure(session: &Session, stream: DelayedStream, options: &StreamReportOptions) -> Result<DelayResult> {
    let steps = match stream {
        // Steps are fast, so many are sent: the wait for the last acknowledgment is then a small part of the time.
        DelayedStream::Steps => 10 * options.steps,
        DelayedStream::Replies(content) => rates::steps_of_run(Some(content), options),
    };
    let measure_at = |url: &str| measure_stream(session, stream, steps, url);
    let direct = measure_at(&session.url())?;
    let undelayed = measure_at(&DelayProxy::start(session.address, 0)?.url)?;
    let delayed = measure_at(&DelayProxy::start(session.address, ONE_WAY_MS)?.url)?;
    Ok(DelayResult {
        content: match stream {
            DelayedStream::Steps => "steps from memory".into(),
            DelayedStream::Replies(content) => content.name(),
        },
        round_trip_ms: 2 * ONE_WAY_MS,
        steps,
        bytes: direct.bytes,
        direct_per_second: direct.per_second,
        undelayed_per_second: undelayed.per_second,
        delayed_per_second: delayed.per_second,
        of_undelayed: delayed.per_second / undelayed.per_second,
    })
}

fn measure_stream(session: &Session, stream: DelayedStream, steps: u64, url: &str) -> Result<Measured> {
    match stream {
        DelayedStream::Replies(content) => {
            let run = rates::run(session, Some(Viewers::one(content)), steps, url)?;
            let bytes: u64 = run.viewers.iter().map(|viewer| viewer.bytes).sum();
            Ok(Measured { per_second: run.per_second(), bytes: bytes as f64 / steps as f64 })
        }
        DelayedStream::Steps => {
            let motion = session.motion(steps.min(super::RECORDED_STEPS))?;
            session.runtime.block_on(async {
                let client = Client::connect(url).await.map_err(fault_in("report"))?;
                let per_second = motion::measure_rate(&client, motion, steps).await?;
                Ok(Measured { per_second, bytes: motion.mean_bytes() })
            })
        }
    }
}
