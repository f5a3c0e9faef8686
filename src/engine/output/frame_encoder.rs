//! Encodes frames for the wire as PNG, JPEG or raw pixels. All streams share one encoder, which uses at most one thread per
//! core.

use std::borrow::Cow;
use std::num::NonZero;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::Semaphore;

use super::frame_format::FrameFormat;
use super::rendered_picture::{Pixels, RenderedPicture};
use super::step_output::{OutputBody, StepFrames, StepId, StepOutput};
use crate::engine::blocking::run_blocking;
use crate::frame;
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_render::RasterBackends;

/// An encoded result of one step.
#[derive(Debug, Clone)]
pub struct EncodedOutput {
    pub step: StepId,
    /// Steps that the subscriber skipped since its last output.
    pub skipped: u64,
    pub stages: StageTimes,
    /// The rasterizers that drew a color frame; default for other results.
    pub raster_backends: RasterBackends,
    pub bytes: Bytes,
}

/// Encodes frames off the device thread. Clones share one limit on threads.
#[derive(Debug, Clone)]
pub struct FrameEncoder {
    /// One permit per thread that may encode.
    thread_permits: Arc<Semaphore>,
    cores: usize,
}

/// A picture of a step that is not encoded yet.
#[derive(Debug)]
pub struct StepPicture {
    pub step: StepId,
    /// Steps that the subscriber skipped since its last output; 0 for all pictures of a step but the first.
    pub skipped: u64,
    /// Stage times of the step, without those of the picture.
    pub stages: StageTimes,
    /// Index of the picture in the request.
    pub index: u32,
    /// Number of updates of the cameras that the picture shows.
    pub camera_version: u64,
    pub picture: Arc<RenderedPicture>,
}

impl StepPicture {
    /// Separates the pictures of an output.
    ///
    /// # Errors
    /// `Fault` when `output` has no frames.
    pub fn of_output(output: StepOutput) -> Result<impl Iterator<Item = Self>> {
        let StepOutput { step, skipped, stages, body: OutputBody::Frames(frames), .. } = output else {
            return Err(fault("encode", "expected frames, got another output"));
        };
        let StepFrames { pictures, camera_version } = frames;
        let separate = move |(picture, index)| Self {
            step,
            skipped: if index == 0 { skipped } else { 0 },
            stages: stages.clone(),
            index,
            camera_version,
            picture,
        };
        Ok(pictures.into_iter().zip(0..).map(separate))
    }
}

/// An encoded picture of a step.
#[derive(Debug, Clone)]
pub struct EncodedFrame {
    /// Index of the picture in the request.
    pub picture: u32,
    /// Number of updates of the cameras that the frame shows.
    pub camera_version: u64,
    pub output: EncodedOutput,
}

impl FrameEncoder {
    /// An encoder for this machine: one thread per core.
    pub(in crate::engine) fn per_core() -> Self {
        Self::new(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    fn new(cores: usize) -> Self {
        Self { thread_permits: Arc::new(Semaphore::new(cores)), cores }
    }

    /// Maximum number of frames that are encoded concurrently.
    pub(in crate::engine) const fn cores(&self) -> usize {
        self.cores
    }

    /// Encodes a picture.
    ///
    /// # Errors
    /// `Fault` when the encoder fails.
    pub async fn encode(&self, step_picture: StepPicture, format: FrameFormat) -> Result<EncodedFrame> {
        let StepPicture { step, skipped, mut stages, index, camera_version, picture } = step_picture;
        stages.extend(picture.stages.iter().copied());
        let bytes = match (&picture.pixels, format) {
            (Pixels::Color(rgba), FrameFormat::Rgba) => rgba.clone(),
            (Pixels::Values(bytes), _) => bytes.clone(),
            (Pixels::Color(_) | Pixels::ColorMap(..), _) => {
                let (bytes, ms) = self.encode_once(&picture, format).await?;
                stages.push((Stage::Encode, ms));
                bytes
            }
        };
        let output = EncodedOutput { step, skipped, stages, raster_backends: picture.raster_backends, bytes };
        Ok(EncodedFrame { picture: index, camera_version, output })
    }

    /// Returns the encoding of a picture and the milliseconds that encoding took. The first caller encodes the picture.
    /// If this caller is cancelled, the next caller encodes the picture.
    async fn encode_once(&self, picture: &Arc<RenderedPicture>, format: FrameFormat) -> Result<(Bytes, f64)> {
        let encode = || {
            let picture = Arc::clone(picture);
            self.run(move || encode_pixels(&picture, format))
        };
        picture.encoding(format).get_or_try_init(encode).await.cloned()
    }

    /// Runs work on a blocking thread as soon as the thread limit permits. Returns the bytes and the run time in
    /// milliseconds, without the wait.
    async fn run(&self, work: impl FnOnce() -> Result<Vec<u8>> + Send + 'static) -> Result<(Bytes, f64)> {
        let permit = Arc::clone(&self.thread_permits).acquire_owned().await.map_err(fault_in("encode"))?;
        run_blocking("encode", move || {
            let _permit = permit;
            let begin = Instant::now();
            work().map(|bytes| (bytes.into(), ms_since(begin)))
        })
        .await
    }
}

/// Encodes a picture; draws a color map with its legend first.
fn encode_pixels(picture: &RenderedPicture, format: FrameFormat) -> Result<Vec<u8>> {
    let (width, height) = (picture.width, picture.height);
    let rgba = match &picture.pixels {
        Pixels::Color(rgba) => Cow::Borrowed(&rgba[..]),
        // `samples` is the number of samples per pixel.
        Pixels::ColorMap(image, legend) => {
            Cow::Owned(frame::draw_color_map(&image.bytes, image.samples, [width, height], legend)?)
        }
        Pixels::Values(_) => return Err(fault("encode", "expected colors, got values")),
    };
    match format {
        FrameFormat::Png => frame::encode_png(width, height, &rgba),
        FrameFormat::Jpeg(quality) => frame::encode_jpeg(width, height, &rgba, quality.get()),
        FrameFormat::Rgba => Ok(rgba.into_owned()),
        FrameFormat::F32 | FrameFormat::U32 | FrameFormat::F32x3 => {
            Err(fault("encode", "expected a format of colors, got a format of numbers"))
        }
    }
}

#[cfg(test)]
pub(in crate::engine) mod tests {
    use super::*;
    use crate::engine::output::frame_format::JpegQuality;
    use modalcast_render::FrameImage;

    /// A frame of noise, so that encoding its PNG takes time. `number` is the step number and the seed.
    pub(in crate::engine) fn noise_frame(number: u64, side: u32) -> StepOutput {
        let mut random = fastrand::Rng::with_seed(number);
        let rgba = (0..side * side).flat_map(|_| [random.u8(..), random.u8(..), random.u8(..), 255]).collect();
        let image = FrameImage {
            width: side,
            height: side,
            rgba,
            times: modalcast_render::FrameTimes::default(),
            raster_backends: RasterBackends::default(),
        };
        let step = StepId { run: 1, number, time: 0.0 };
        let body = OutputBody::Frames(StepFrames { pictures: vec![Arc::new(image.into())], camera_version: 0 });
        StepOutput { step, skipped: 0, stages: vec![], origins: None, body }
    }

    /// The first picture of an output.
    fn first_picture(output: &StepOutput) -> StepPicture {
        StepPicture::of_output(output.clone()).expect("expected frames").next().expect("expected a picture")
    }

    /// An encoder without thread permits. It encodes once the test adds permits to the semaphore.
    pub(in crate::engine) fn paused_encoder(cores: usize) -> (FrameEncoder, Arc<Semaphore>) {
        let thread_permits = Arc::new(Semaphore::new(0));
        (FrameEncoder { thread_permits: Arc::clone(&thread_permits), cores }, thread_permits)
    }

    #[tokio::test]
    async fn subscribers_share_one_png_and_raw_pixels() {
        let encoder = FrameEncoder::new(2);
        let output = noise_frame(1, 16);
        let encode_twice = async |format| {
            let first = encoder.encode(first_picture(&output), format);
            let second = encoder.encode(first_picture(&output), format);
            let (first, second) = tokio::join!(first, second);
            (first.expect("expected an encoded frame").output, second.expect("expected an encoded frame").output)
        };
        let jpeg = |quality| FrameFormat::Jpeg(JpegQuality::parse("quality", quality).expect("expected a quality"));
        for format in [FrameFormat::Png, FrameFormat::Rgba, jpeg(50), jpeg(90)] {
            let (first, second) = encode_twice(format).await;
            assert_eq!(first.bytes.as_ptr(), second.bytes.as_ptr(), "{format:?}: expected shared bytes");
            assert_eq!(first.bytes.len(), second.bytes.len(), "{format:?}");
            assert_eq!(first.stages, second.stages, "{format:?}");
        }
        let other_frame = encoder.encode(first_picture(&noise_frame(1, 16)), FrameFormat::Png).await;
        let other_frame = other_frame.expect("expected a PNG").output;
        let ((small, _), (large, _)) = (encode_twice(jpeg(50)).await, encode_twice(jpeg(90)).await);
        assert!(small.bytes.len() < large.bytes.len(), "expected one encoding per quality");
        assert_eq!(large.bytes, encode_twice(jpeg(0)).await.0.bytes, "expected the default quality of 90");
        let (shared, _) = encode_twice(FrameFormat::Png).await;
        assert_eq!(other_frame.bytes, shared.bytes);
        assert_ne!(
            other_frame.bytes.as_ptr(),
            shared.bytes.as_ptr(),
            "control: expected separate bytes for another frame"
        );
    }

    #[tokio::test]
    async fn next_subscriber_encodes_after_a_cancelled_one() {
        let (encoder, thread_permits) = paused_encoder(1);
        let output = noise_frame(2, 8);
        let first = encoder.encode(first_picture(&output), FrameFormat::Png);
        let timeout = std::time::Duration::from_millis(20);
        tokio::time::timeout(timeout, first).await.expect_err("expected no PNG without a thread");
        thread_permits.add_permits(1);
        let second = encoder.encode(first_picture(&output), FrameFormat::Png).await.expect("expected a PNG");
        assert!(image::load_from_memory(&second.output.bytes).is_ok());
    }
}
