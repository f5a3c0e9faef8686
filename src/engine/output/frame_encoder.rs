//! Encodes frames for the wire as PNG or raw pixels. All streams share one encoder, which uses at most one thread per
//! core.

use std::num::NonZero;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use tokio::sync::Semaphore;

use super::color_frame::ColorFrame;
use super::step_output::{OutputBody, StepId, StepOutput};
use crate::engine::blocking::run_blocking;
use crate::frame::{self, Legend};
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_render::{AovImage, RasterBackends};

/// Wire format of pixels. Multi-byte values are little-endian; the top row comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameFormat {
    Png,
    /// RGBA8 sRGB.
    Rgba,
    /// One f32 per pixel: depth.
    F32,
    /// One u32 per pixel: domain indices.
    U32,
    /// Three f32 per pixel: normals.
    F32x3,
}

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

    /// Encodes a color frame or an AOV.
    ///
    /// # Errors
    /// `Fault` when the PNG encoder fails, or when `output` is neither a color frame nor an AOV.
    pub async fn encode(&self, output: StepOutput, format: FrameFormat) -> Result<EncodedOutput> {
        let mut stages = output.stages;
        let mut raster_backends = RasterBackends::default();
        let (bytes, ms) = match output.body {
            OutputBody::Frame(frame) => {
                raster_backends = frame.raster_backends;
                match format {
                    FrameFormat::Png => self.encode_png_once(&frame).await.map(|(bytes, ms)| (bytes, Some(ms)))?,
                    _ => (frame.rgba.clone(), None),
                }
            }
            OutputBody::Aov(image, Some(legend)) => {
                let encode_map = move || encode_color_map(&image, &legend, format);
                self.run(encode_map).await.map(|(bytes, ms)| (bytes, Some(ms)))?
            }
            OutputBody::Aov(image, None) => (image.bytes.into(), None),
            OutputBody::Vertices(_) | OutputBody::Pick(_) | OutputBody::State(_) => {
                return Err(fault("encode", "expected a frame, got another output"));
            }
        };
        stages.extend(ms.map(|ms| (Stage::Encode, ms)));
        Ok(EncodedOutput { step: output.step, skipped: output.skipped, stages, raster_backends, bytes })
    }

    /// Returns the PNG of a frame and the milliseconds that encoding took. The first caller encodes the frame. If this
    /// caller is cancelled, the next caller encodes the frame.
    async fn encode_png_once(&self, frame: &Arc<ColorFrame>) -> Result<(Bytes, f64)> {
        let encode_png = || {
            let frame = Arc::clone(frame);
            self.run(move || frame::encode_png(frame.width, frame.height, &frame.rgba))
        };
        frame.png.get_or_try_init(encode_png).await.cloned()
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

/// Draws a color map with its legend and encodes it.
fn encode_color_map(image: &AovImage, legend: &Legend, format: FrameFormat) -> Result<Vec<u8>> {
    let size = [image.width, image.height];
    // `samples` is the number of samples per pixel.
    let rgba = frame::draw_color_map(&image.bytes, image.samples, size, legend)?;
    if format == FrameFormat::Png { frame::encode_png(size[0], size[1], &rgba) } else { Ok(rgba) }
}

#[cfg(test)]
pub(in crate::engine) mod tests {
    use super::*;
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
        StepOutput { step, skipped: 0, stages: vec![], origins: None, body: OutputBody::Frame(Arc::new(image.into())) }
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
            let first = encoder.encode(output.clone(), format);
            let second = encoder.encode(output.clone(), format);
            let (first, second) = tokio::join!(first, second);
            (first.expect("expected an encoded frame"), second.expect("expected an encoded frame"))
        };
        for format in [FrameFormat::Png, FrameFormat::Rgba] {
            let (first, second) = encode_twice(format).await;
            assert_eq!(first.bytes.as_ptr(), second.bytes.as_ptr(), "{format:?}: expected shared bytes");
            assert_eq!(first.bytes.len(), second.bytes.len(), "{format:?}");
            assert_eq!(first.stages, second.stages, "{format:?}");
        }
        let other_frame = encoder.encode(noise_frame(1, 16), FrameFormat::Png).await.expect("expected a PNG");
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
        let first = encoder.encode(output.clone(), FrameFormat::Png);
        let timeout = std::time::Duration::from_millis(20);
        tokio::time::timeout(timeout, first).await.expect_err("expected no PNG without a thread");
        thread_permits.add_permits(1);
        let second = encoder.encode(output, FrameFormat::Png).await.expect("expected a PNG");
        assert!(image::load_from_memory(&second.bytes).is_ok());
    }
}
