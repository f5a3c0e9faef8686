//! A frame subscription with parallel encoding: encodes several frames concurrently and delivers them in order.

use std::collections::VecDeque;

use tokio::task::JoinHandle;

use super::subscriber::{Delivery, Subscription};
use crate::engine::output::frame_encoder::{EncodedOutput, FrameEncoder, FrameFormat};
use crate::engine::output::step_output::{OutputBody, StepOutput};
use modalcast_model::error::{Error, Result, fault_in};

/// Budget of pixel bytes that one stream may hold before it accepts no further frame. A single larger frame is encoded
/// alone.
const IN_FLIGHT_BYTES: usize = 128 << 20;
/// Frames in flight of a [`Delivery::Latest`] stream. The next frame is encoded while the previous one is sent; further
/// frames would only add latency.
const LATEST_IN_FLIGHT: usize = 2;

/// Encoded frames of a [`Subscription`], in its order. A lossless subscription has at most one frame in flight per core.
/// If the client does not read them, the subscription is not read either and exerts back-pressure on the writer.
#[derive(Debug)]
pub struct EncodedSubscription {
    subscription: Subscription,
    encoder: FrameEncoder,
    format: FrameFormat,
    /// Number of frames that are still to be taken from the subscription.
    remaining: u64,
    /// Oldest first.
    in_flight: VecDeque<Encoding>,
    /// The error that ended the subscription; reported after the frames in flight.
    ended: Option<Error>,
}

/// A frame that is being encoded. Dropping it cancels the encoding unless a thread has already started it.
#[derive(Debug)]
struct Encoding {
    task: JoinHandle<Result<EncodedOutput>>,
    bytes: usize,
}

impl Drop for Encoding {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl EncodedSubscription {
    /// Encodes the first `frames` frames of a subscription; 0 means all.
    pub fn new(subscription: Subscription, encoder: FrameEncoder, format: FrameFormat, frames: u64) -> Self {
        let remaining = if frames == 0 { u64::MAX } else { frames };
        Self { subscription, encoder, format, remaining, in_flight: VecDeque::new(), ended: None }
    }

    /// The next frame; `None` after the requested number of frames. Cancel-safe.
    ///
    /// # Errors
    /// The error that ended the subscription, after the frames in flight; `Fault` when a frame cannot be encoded.
    pub async fn next(&mut self) -> Result<Option<EncodedOutput>> {
        loop {
            let has_capacity = self.has_capacity();
            let Self { subscription, in_flight, .. } = self;
            tokio::select! {
                biased;
                encoded = finish_oldest(in_flight), if !in_flight.is_empty() => return encoded.map(Some),
                output = subscription.next(), if has_capacity => match output {
                    Ok(output) => self.begin(output),
                    Err(error) => self.ended = Some(error),
                },
                else => return self.ended.clone().map_or(Ok(None), Err),
            }
        }
    }

    /// Waits until the subscription is cut off; see [`Subscription::disconnected`].
    pub async fn disconnected(&self) -> Error {
        self.subscription.disconnected().await
    }

    fn has_capacity(&self) -> bool {
        let most = match self.subscription.delivery() {
            Delivery::Lossless => self.encoder.cores(),
            Delivery::Latest => LATEST_IN_FLIGHT,
        };
        let bytes: usize = self.in_flight.iter().map(|encoding| encoding.bytes).sum();
        let is_within_budget = self.in_flight.is_empty() || (self.in_flight.len() < most && bytes < IN_FLIGHT_BYTES);
        is_within_budget && self.remaining > 0 && self.ended.is_none()
    }

    fn begin(&mut self, output: StepOutput) {
        let bytes = match &output.body {
            OutputBody::Frame(frame) => frame.rgba.len(),
            OutputBody::Aov(image, _) => image.bytes.len(),
            OutputBody::Vertices(_) | OutputBody::Pick(_) => 0,
        };
        let (encoder, format) = (self.encoder.clone(), self.format);
        let task = tokio::spawn(async move { encoder.encode(output, format).await });
        self.in_flight.push_back(Encoding { task, bytes });
        self.remaining -= 1;
    }
}

/// Waits for the oldest frame in flight and removes it. Cancel-safe.
async fn finish_oldest(in_flight: &mut VecDeque<Encoding>) -> Result<EncodedOutput> {
    let Some(oldest) = in_flight.front_mut() else { return std::future::pending().await };
    let encoded = (&mut oldest.task).await;
    in_flight.pop_front();
    encoded.map_err(fault_in("encode"))?
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use tokio::time::timeout;

    use super::super::subscriber::Subscriber;
    use super::*;
    use crate::engine::output::frame_encoder::tests::{noise, paused};
    use crate::engine::output::step_output::OutputSpec;
    use modalcast_model::deform::VertexAttributes;

    fn subscription(delivery: Delivery) -> (Subscriber, Subscription) {
        Subscription::new(OutputSpec::Vertices(VertexAttributes::VERTICES), delivery, Arc::default())
    }

    /// Delivers frames of decreasing size for as long as the subscription accepts them. Returns how many it accepted.
    async fn fill(subscriber: &Subscriber, frames: &mut EncodedSubscription, numbers: std::ops::Range<u64>) -> usize {
        let mut taken = 0;
        for number in numbers {
            timeout(Duration::from_millis(20), frames.next()).await.expect_err("nothing is encoded yet");
            if !subscriber.has_credit() {
                break;
            }
            assert!(subscriber.take_permit().send(Ok(noise(number, 64 - number as u32))));
            taken += 1;
        }
        taken
    }

    #[tokio::test]
    async fn frames_in_flight_are_bounded_and_arrive_in_order() {
        for (delivery, cores, most) in [(Delivery::Lossless, 3, 3), (Delivery::Latest, 3, LATEST_IN_FLIGHT)] {
            let (encoder, threads) = paused(cores);
            let (subscriber, subscription) = subscription(delivery);
            let mut frames = EncodedSubscription::new(subscription, encoder, FrameFormat::Png, 0);
            let taken = fill(&subscriber, &mut frames, 0..20).await;
            // A lossless feed buffers two more frames, which the encoder has not taken.
            let held = if delivery == Delivery::Lossless { 2 } else { 0 };
            assert_eq!((frames.in_flight.len(), taken), (most, most + held), "{delivery:?}");
            threads.add_permits(cores);
            for number in 0..taken as u64 {
                let frame = frames.next().await.expect("encodes").expect("a frame");
                assert_eq!(frame.step.number, number);
            }
        }
    }

    #[tokio::test]
    async fn a_frame_above_the_byte_budget_is_encoded_alone() {
        let (encoder, _threads) = paused(4);
        let (subscriber, subscription) = subscription(Delivery::Lossless);
        let mut frames = EncodedSubscription::new(subscription, encoder, FrameFormat::Png, 0);
        let large = |number| {
            let mut output = noise(number, 1);
            let image = modalcast_render::FrameImage {
                width: 1,
                height: 1,
                rgba: vec![0; IN_FLIGHT_BYTES],
                times: modalcast_render::FrameTimes::default(),
                raster_backends: modalcast_render::RasterBackends::default(),
            };
            output.body = OutputBody::Frame(Arc::new(image.into()));
            output
        };
        assert!(subscriber.take_permit().send(Ok(large(0))) && subscriber.take_permit().send(Ok(noise(1, 4))));
        timeout(Duration::from_millis(20), frames.next()).await.expect_err("nothing is encoded yet");
        assert_eq!(frames.in_flight.len(), 1);
        drop(frames);
        assert!(subscriber.is_closed());
    }

    #[tokio::test]
    async fn the_end_is_reported_after_the_frames_in_flight() {
        let (encoder, threads) = paused(4);
        let (subscriber, subscription) = subscription(Delivery::Lossless);
        let mut frames = EncodedSubscription::new(subscription, encoder, FrameFormat::Png, 0);
        assert!(subscriber.take_permit().send(Ok(noise(0, 32))) && subscriber.take_permit().send(Ok(noise(1, 4))));
        let end = Error::NotFound { what: "scene", given: "gone".into() };
        subscriber.end(end.clone());
        drop(subscriber);
        timeout(Duration::from_millis(20), frames.next()).await.expect_err("nothing is encoded yet");
        threads.add_permits(1);
        for number in 0..2 {
            assert_eq!(frames.next().await.expect("encodes").expect("a frame").step.number, number);
        }
        assert_eq!(frames.next().await.expect_err("the end"), end);
    }

    #[tokio::test]
    async fn no_more_frames_are_taken_than_were_asked_for() {
        let (encoder, threads) = paused(4);
        threads.add_permits(4);
        let (subscriber, subscription) = subscription(Delivery::Lossless);
        let mut frames = EncodedSubscription::new(subscription, encoder, FrameFormat::Rgba, 1);
        assert!(subscriber.take_permit().send(Ok(noise(0, 4))) && subscriber.take_permit().send(Ok(noise(1, 4))));
        assert!(frames.next().await.expect("encodes").is_some());
        assert!(frames.next().await.expect("the end").is_none());
        let kept = frames.subscription.next().await.expect("the second frame stays in the subscription");
        assert_eq!(kept.step.number, 1);
    }
}
