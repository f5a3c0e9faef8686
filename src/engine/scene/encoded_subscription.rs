//! A frame subscription whose frames are encoded. Frames, also those of one step, are drawn and encoded concurrently and
//! delivered in order.

use std::collections::VecDeque;
use std::sync::Arc;

use super::delivery::Delivery;
use super::subscriber::Subscription;
use crate::engine::output::frame_encoder::FrameEncoder;
use crate::engine::output::frame_format::FrameFormat;
use crate::engine::output::frame_queue::{EncodedFrame, FrameQueue};
use crate::engine::output::output_spec::PictureContent;
use modalcast_model::error::{Error, Result};

/// A stream that holds at least this many bytes of pixels accepts no further step.
const MAX_PIXEL_BYTES: u64 = 128 << 20;
/// Size of a pixel. Normals have 12 bytes, but most pictures are colors.
const PIXEL_BYTES: u64 = 4;
/// Maximum number of steps whose frames a [`Delivery::Latest`] stream holds. The next step is encoded while the
/// previous one is sent. Further steps would only add latency.
const MAX_LATEST_STEPS: usize = 2;

/// The encoded frames of a [`Subscription`], in the same order. A lossless stream holds the frames of at most as many
/// steps as there are cores. While the client does not read frames, the subscription is not read either and applies
/// back-pressure to the writer.
pub struct EncodedSubscription {
    subscription: Subscription,
    /// Number of steps that will still be taken from the subscription.
    remaining_steps: u64,
    /// Size of the pixels of a step.
    step_bytes: u64,
    queue: FrameQueue,
    /// Frames that were encoded while an earlier one was sent.
    encoded: VecDeque<Result<EncodedFrame>>,
    /// Number of frames that were returned and are being sent: 0 or 1.
    sending: usize,
    /// The error that ended the subscription. It is reported after the frames that are held.
    end_error: Option<Error>,
}

impl EncodedSubscription {
    /// Encodes the frames of the first `max_steps` steps of a subscription; 0 means all. `formats` has the format of
    /// each picture of the subscription.
    pub fn new(subscription: Subscription, encoder: FrameEncoder, formats: Vec<FrameFormat>, max_steps: u64) -> Self {
        subscription.set_content(PictureContent::of_formats(&formats));
        let pixels = subscription.cameras().map_or(0, |cameras| {
            cameras
                .pictures()
                .iter()
                .map(|picture| u64::from(picture.size.width) * u64::from(picture.size.height))
                .sum()
        });
        Self {
            subscription,
            remaining_steps: if max_steps == 0 { u64::MAX } else { max_steps },
            step_bytes: PIXEL_BYTES * pixels,
            queue: FrameQueue::new(encoder, formats),
            encoded: VecDeque::new(),
            sending: 0,
            end_error: None,
        }
    }

    /// Waits for the next frame: the pictures of a step in order, then those of the next step. Returns `None` after the
    /// requested number of steps. Cancel-safe.
    ///
    /// # Errors
    /// The errors of drawing; `Fault` when a frame cannot be encoded; the error that ended the subscription, after the
    /// frames that are held.
    pub async fn next(&mut self) -> Result<Option<EncodedFrame>> {
        let work_timer = Arc::clone(self.subscription.work_timer());
        work_timer.measure(self.next_encoded()).await
    }

    async fn next_encoded(&mut self) -> Result<Option<EncodedFrame>> {
        self.sending = 0;
        loop {
            if let Some(frame) = self.encoded.pop_front() {
                self.sending = 1;
                return frame.map(Some);
            }
            if !self.advance().await? {
                return self.end_error.clone().map_or(Ok(None), Err);
            }
        }
    }

    /// Takes and encodes further steps while a frame is sent. Returns the error with which the scene disconnects the
    /// subscriber; see [`Subscription::disconnected`]. Cancel-safe.
    pub async fn encode_until_disconnected(&mut self) -> Error {
        let disconnected = self.subscription.disconnected();
        let encode = async {
            loop {
                match self.advance().await {
                    Ok(true) => {}
                    // The frames that are held end with the stream.
                    Ok(false) => return std::future::pending().await,
                    Err(error) => return error,
                }
            }
        };
        tokio::select! {
            error = disconnected => error,
            error = encode => error,
        }
    }

    /// Waits until a frame is encoded, or until a step was taken from the subscription. Returns false if neither will
    /// happen before frames are sent. Cancel-safe.
    async fn advance(&mut self) -> Result<bool> {
        let has_capacity = self.has_capacity();
        let Self { subscription, queue, .. } = self;
        tokio::select! {
            biased;
            Some(frame) = queue.next(), if !queue.is_empty() => self.encoded.push_back(frame),
            output = subscription.next(), if has_capacity => match output {
                Ok(output) => {
                    self.queue.push(output)?;
                    self.remaining_steps -= 1;
                }
                Err(error) => self.end_error = Some(error),
            },
            else => return Ok(false),
        }
        Ok(true)
    }

    fn has_capacity(&self) -> bool {
        let held_frames = self.queue.len() + self.encoded.len();
        let (held_frames, max_steps) = match self.subscription.delivery().delivery() {
            Delivery::Lossless => (held_frames, self.queue.encoder().cores()),
            Delivery::Latest => (held_frames + self.sending, MAX_LATEST_STEPS),
        };
        let held_steps = held_frames.div_ceil(self.queue.pictures_per_step());
        let is_within_limits = held_steps < max_steps && held_steps as u64 * self.step_bytes < MAX_PIXEL_BYTES;
        is_within_limits && self.remaining_steps > 0 && self.end_error.is_none()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::time::timeout;

    use super::super::subscriber::Subscriber;
    use super::*;
    use crate::admission::{Limit, Permit};
    use crate::engine::output::frame_encoder::tests::{noise_frame, paused_encoder};
    use crate::engine::output::output_spec::{FrameOutput, OutputSpec, PictureSpec};
    use crate::engine::output::step_output::{OutputBody, StepOutput};
    use crate::engine::testing;
    use modalcast_model::scene::{CameraSource, FrameSize, FrameStyle};

    /// Limit of an [`EncodedSubscription`] that takes all steps.
    const ALL_STEPS: u64 = 0;

    fn subscribe(delivery: Delivery) -> (Subscriber, Subscription) {
        subscribe_to(FrameSize::new(64, 64), delivery)
    }

    /// Subscribes to one picture of this size.
    fn subscribe_to(size: FrameSize, delivery: Delivery) -> (Subscriber, Subscription) {
        let camera = CameraSource::framing(&testing::two_strips(), size);
        let picture = PictureSpec { camera, size, output: FrameOutput::Color, style: FrameStyle::default() };
        let permit = Permit::for_test(Limit::SUBSCRIPTIONS);
        Subscription::new(permit, OutputSpec::Frames([picture].into()), delivery.into(), Arc::default())
    }

    fn send_frame(subscriber: &Subscriber, frame: StepOutput) {
        assert!(subscriber.send(frame), "expected an open subscription");
    }

    /// Number of frames that are being encoded.
    fn encoding_count(frames: &EncodedSubscription) -> usize {
        frames.queue.len()
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
        next_frame(frames).await.step.number
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
            assert_eq!(encoding_count(&frames), max_encodings, "{delivery:?}");
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
        assert!(encoding_count(&frames) == 2 * MAX_LATEST_STEPS && !subscriber.has_credit());
        thread_permits.add_permits(3);
        for (number, picture, skipped) in [(0, 0, 5), (0, 1, 0), (1, 0, 5), (1, 1, 0)] {
            let frame = next_frame(&mut frames).await;
            assert_eq!((frame.step.number, frame.picture, frame.skipped), (number, picture, skipped));
            let raw_bytes = 16 * 16 * 4;
            assert_eq!(frame.bytes.len() == raw_bytes, picture == 1, "expected raw pixels as the second picture");
        }
    }

    #[tokio::test]
    async fn frame_that_reaches_the_byte_limit_is_encoded_alone() {
        let (encoder, _thread_permits) = paused_encoder(4);
        // 128 MiB of pixels.
        let (subscriber, subscription) = subscribe_to(FrameSize::new(8192, 4096), Delivery::Lossless);
        let mut frames = png_frames(subscription, encoder);
        send_frame(&subscriber, noise_frame(0, 8));
        send_frame(&subscriber, noise_frame(1, 4));
        poll_without_frame(&mut frames).await;
        assert_eq!(encoding_count(&frames), 1);
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
