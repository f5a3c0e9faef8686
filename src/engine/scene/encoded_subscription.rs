//! A frame subscription with parallel encoding. Frames, also those of one step, are encoded concurrently and delivered
//! in order.

use std::collections::VecDeque;

use super::delivery::Delivery;
use super::subscriber::Subscription;
use crate::engine::output::encoding_task::EncodingTask;
use crate::engine::output::frame_encoder::{EncodedFrame, FrameEncoder, StepPicture};
use crate::engine::output::frame_format::FrameFormat;
use crate::engine::output::step_output::{PictureContent, StepOutput};
use modalcast_model::error::{Error, Result};

/// A stream that holds at least this many bytes of pixels accepts no further step.
const MAX_PIXEL_BYTES: usize = 128 << 20;
/// Maximum number of steps whose frames a [`Delivery::Latest`] stream holds. The next step is encoded while the
/// previous one is sent. Further steps would only add latency.
const MAX_LATEST_STEPS: usize = 2;

/// The encoded frames of a [`Subscription`], in the same order. A lossless stream holds the frames of at most as many
/// steps as there are cores. While the client does not read frames, the subscription is not read either and applies
/// back-pressure to the writer.
#[derive(Debug)]
pub struct EncodedSubscription {
    subscription: Subscription,
    encoder: FrameEncoder,
    /// The format of each picture.
    formats: Vec<FrameFormat>,
    /// Number of steps that will still be taken from the subscription.
    remaining_steps: u64,
    /// Oldest first.
    encodings: VecDeque<EncodingTask>,
    /// The error that ended the subscription. It is reported after the frames in `encodings`.
    end_error: Option<Error>,
}

impl EncodedSubscription {
    /// Encodes the frames of the first `max_steps` steps of a subscription; 0 means all. `formats` has the format of
    /// each picture of the subscription.
    pub fn new(subscription: Subscription, encoder: FrameEncoder, formats: Vec<FrameFormat>, max_steps: u64) -> Self {
        subscription.set_content(PictureContent::of_formats(&formats));
        let remaining_steps = if max_steps == 0 { u64::MAX } else { max_steps };
        Self { subscription, encoder, formats, remaining_steps, encodings: VecDeque::new(), end_error: None }
    }

    /// Waits for the next frame: the pictures of a step in order, then those of the next step. Returns `None` after the
    /// requested number of steps. Cancel-safe.
    ///
    /// # Errors
    /// `Fault` when a frame cannot be encoded; the error that ended the subscription, after the frames that are held.
    pub async fn next(&mut self) -> Result<Option<EncodedFrame>> {
        loop {
            let has_capacity = self.has_capacity();
            let Self { subscription, encodings, .. } = self;
            tokio::select! {
                biased;
                encoded = finish_oldest(encodings), if !encodings.is_empty() => return encoded.map(Some),
                output = subscription.next(), if has_capacity => match output {
                    Ok(output) => self.start_encoding(output)?,
                    Err(error) => self.end_error = Some(error),
                },
                else => return self.end_error.clone().map_or(Ok(None), Err),
            }
        }
    }

    /// Waits until the scene disconnects the subscriber; see [`Subscription::disconnected`].
    pub async fn disconnected(&self) -> Error {
        self.subscription.disconnected().await
    }

    fn has_capacity(&self) -> bool {
        let max_steps = match self.subscription.delivery().delivery() {
            Delivery::Lossless => self.encoder.cores(),
            Delivery::Latest => MAX_LATEST_STEPS,
        };
        let pixel_bytes: usize = self.encodings.iter().map(EncodingTask::pixel_bytes).sum();
        let held_steps = self.encodings.len().div_ceil(self.formats.len().max(1));
        let is_within_limits = held_steps < max_steps && pixel_bytes < MAX_PIXEL_BYTES;
        is_within_limits && self.remaining_steps > 0 && self.end_error.is_none()
    }

    fn start_encoding(&mut self, output: StepOutput) -> Result<()> {
        for (picture, format) in StepPicture::of_output(output)?.zip(&self.formats) {
            self.encodings.push_back(EncodingTask::start(&self.encoder, picture, *format));
        }
        self.remaining_steps -= 1;
        Ok(())
    }
}

/// Waits for the oldest encoding and removes it. Cancel-safe.
async fn finish_oldest(encodings: &mut VecDeque<EncodingTask>) -> Result<EncodedFrame> {
    let Some(oldest) = encodings.front_mut() else { return std::future::pending().await };
    let encoded = oldest.finish().await;
    encodings.pop_front();
    encoded
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::Duration;

    use tokio::time::timeout;

    use super::super::subscriber::Subscriber;
    use super::*;
    use crate::engine::output::frame_encoder::tests::{noise_frame, paused_encoder};
    use crate::engine::output::step_output::{OutputBody, OutputSpec, StepFrames};
    use modalcast_model::deform::VertexAttributes;

    /// Limit of an [`EncodedSubscription`] that takes all steps.
    const ALL_STEPS: u64 = 0;

    fn subscribe(delivery: Delivery) -> (Subscriber, Subscription) {
        let spec = OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
        Subscription::new(spec, delivery.into(), Arc::default())
    }

    fn send_frame(subscriber: &Subscriber, frame: StepOutput) {
        assert!(subscriber.take_permit().send(Ok(frame)), "expected an open subscription");
    }

    /// Polls for a frame while the encoder is paused.
    async fn poll_without_frame(frames: &mut EncodedSubscription) {
        timeout(Duration::from_millis(20), frames.next()).await.expect_err("expected no encoded frame yet");
    }

    async fn next_frame(frames: &mut EncodedSubscription) -> EncodedFrame {
        frames.next().await.expect("expected an encoded frame").expect("expected a frame before the end")
    }

    /// The step number of the next frame.
    async fn next_step(frames: &mut EncodedSubscription) -> u64 {
        next_frame(frames).await.output.step.number
    }

    fn png_frames(subscription: Subscription, encoder: FrameEncoder) -> EncodedSubscription {
        EncodedSubscription::new(subscription, encoder, vec![FrameFormat::Png], ALL_STEPS)
    }

    /// Sends frames while the subscriber has credits, each of which permits one frame. Returns how many were sent. The
    /// size of the frames decreases, so that later frames could be encoded before earlier ones.
    async fn send_until_full(subscriber: &Subscriber, frames: &mut EncodedSubscription) -> usize {
        for number in 0..20 {
            poll_without_frame(frames).await;
            if !subscriber.has_credit() {
                return number;
            }
            send_frame(subscriber, noise_frame(number as u64, 64 - number as u32));
        }
        panic!("expected a limit on the frames that are held");
    }

    #[tokio::test]
    async fn held_frames_are_bounded_and_arrive_in_order() {
        let cores = 3;
        // A lossless subscription itself buffers two more frames, which are not being encoded yet.
        for (delivery, max_encodings, buffered) in
            [(Delivery::Lossless, cores, 2), (Delivery::Latest, MAX_LATEST_STEPS, 0)]
        {
            let (encoder, thread_permits) = paused_encoder(cores);
            let (subscriber, subscription) = subscribe(delivery);
            let mut frames = png_frames(subscription, encoder);
            let sent = send_until_full(&subscriber, &mut frames).await;
            assert_eq!(frames.encodings.len(), max_encodings, "{delivery:?}");
            assert_eq!(sent, max_encodings + buffered, "{delivery:?}");
            thread_permits.add_permits(cores);
            for number in 0..sent as u64 {
                assert_eq!(next_step(&mut frames).await, number);
            }
        }
    }

    /// Every step has two pictures, so twice as many frames are held.
    #[tokio::test]
    async fn pictures_of_a_step_arrive_in_order_before_the_next_step() {
        let (encoder, thread_permits) = paused_encoder(3);
        let (subscriber, subscription) = subscribe(Delivery::Latest);
        let formats = vec![FrameFormat::Png, FrameFormat::Rgba];
        let mut frames = EncodedSubscription::new(subscription, encoder, formats, ALL_STEPS);
        for number in 0..MAX_LATEST_STEPS as u64 {
            poll_without_frame(&mut frames).await;
            let output = noise_frame(number, 16);
            let OutputBody::Frames(mut frames) = output.body else { panic!("expected frames") };
            frames.pictures.push(Arc::clone(&frames.pictures[0]));
            send_frame(&subscriber, StepOutput { skipped: 5, body: OutputBody::Frames(frames), ..output });
        }
        poll_without_frame(&mut frames).await;
        assert!(frames.encodings.len() == 2 * MAX_LATEST_STEPS && !subscriber.has_credit());
        thread_permits.add_permits(3);
        for (number, picture, skipped) in [(0, 0, 5), (0, 1, 0), (1, 0, 5), (1, 1, 0)] {
            let frame = next_frame(&mut frames).await;
            assert_eq!((frame.output.step.number, frame.picture, frame.output.skipped), (number, picture, skipped));
            let raw_bytes = 16 * 16 * 4;
            assert_eq!(
                frame.output.bytes.len() == raw_bytes,
                picture == 1,
                "expected raw pixels as the second picture"
            );
        }
    }

    #[tokio::test]
    async fn frame_that_reaches_the_byte_limit_is_encoded_alone() {
        let (encoder, _thread_permits) = paused_encoder(4);
        let (subscriber, subscription) = subscribe(Delivery::Lossless);
        let mut frames = png_frames(subscription, encoder);
        let large_image = modalcast_render::FrameImage {
            width: 1,
            height: 1,
            rgba: vec![0; MAX_PIXEL_BYTES].into(),
            times: modalcast_render::FrameTimes::default(),
            info: modalcast_render::FrameInfo::default(),
        };
        let body = OutputBody::Frames(StepFrames { pictures: vec![Arc::new(large_image.into())], camera_version: 0 });
        let large_frame = StepOutput { body, ..noise_frame(0, 1) };
        send_frame(&subscriber, large_frame);
        send_frame(&subscriber, noise_frame(1, 4));
        poll_without_frame(&mut frames).await;
        assert_eq!(frames.encodings.len(), 1);
        drop(frames);
        assert!(subscriber.is_closed());
    }

    #[tokio::test]
    async fn end_is_reported_after_the_held_frames() {
        let (encoder, thread_permits) = paused_encoder(4);
        let (subscriber, subscription) = subscribe(Delivery::Lossless);
        let mut frames = png_frames(subscription, encoder);
        send_frame(&subscriber, noise_frame(0, 32));
        send_frame(&subscriber, noise_frame(1, 4));
        let end_error = Error::NotFound { what: "scene", given: "'closed'".into() };
        subscriber.end(end_error.clone());
        drop(subscriber);
        poll_without_frame(&mut frames).await;
        thread_permits.add_permits(1);
        for number in 0..2 {
            assert_eq!(next_step(&mut frames).await, number);
        }
        assert_eq!(frames.next().await.expect_err("expected the end"), end_error);
    }

    #[tokio::test]
    async fn takes_only_the_requested_number_of_steps() {
        let (encoder, thread_permits) = paused_encoder(4);
        thread_permits.add_permits(4);
        let (subscriber, subscription) = subscribe(Delivery::Lossless);
        let mut frames = EncodedSubscription::new(subscription, encoder, vec![FrameFormat::Rgba], 1);
        send_frame(&subscriber, noise_frame(0, 4));
        send_frame(&subscriber, noise_frame(1, 4));
        next_frame(&mut frames).await;
        assert!(frames.next().await.expect("expected no error").is_none());
        let second_frame = frames.subscription.next().await.expect("expected the second frame in the subscription");
        assert_eq!(second_frame.step.number, 1);
    }
}
