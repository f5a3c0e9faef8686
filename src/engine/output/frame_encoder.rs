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
use modalcast_model::error::{Result, fault_in};
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
    pub skipped: u64,
    pub stages: StageTimes,
    /// The rasterizers that drew a color frame; default for other results.
    pub raster_backends: RasterBackends,
    pub bytes: Bytes,
}

/// Encodes frames off the device thread. Clones share one limit on threads.
#[derive(Debug, Clone)]
pub struct FrameEncoder {
    threads: Arc<Semaphore>,
    cores: usize,
}

impl FrameEncoder {
    /// An encoder for this machine: one thread per core.
    pub(in crate::engine) fn per_core() -> Self {
        Self::new(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    fn new(cores: usize) -> Self {
        Self { threads: Arc::new(Semaphore::new(cores)), cores }
    }

    /// Number of frames that are encoded concurrently.
    pub(in crate::engine) const fn cores(&self) -> usize {
        self.cores
    }

    /// Encodes a color frame or an AOV.
    ///
    /// # Errors
    /// `Fault` when the PNG encoder fails, or when `output` is not a picture.
    pub async fn encode(&self, output: StepOutput, format: FrameFormat) -> Result<EncodedOutput> {
        let mut stages = output.stages;
        let mut raster_backends = RasterBackends::default();
        let (bytes, ms) = match output.body {
            OutputBody::Frame(frame) => {
                raster_backends = frame.raster_backends;
                match format {
                    FrameFormat::Png => self.png(&frame).await.map(|(bytes, ms)| (bytes, Some(ms)))?,
                    _ => (frame.rgba.clone(), None),
                }
            }
            OutputBody::Aov(image, Some(legend)) => {
                let map = move || color_map(&image, &legend, format);
                self.run(map).await.map(|(bytes, ms)| (bytes, Some(ms)))?
            }
            OutputBody::Aov(image, None) => (image.bytes.into(), None),
            OutputBody::Vertices(_) | OutputBody::Pick(_) => return Err(fault_in("encode")("it is not a picture")),
        };
        stages.extend(ms.map(|ms| (Stage::Encode, ms)));
        Ok(EncodedOutput { step: output.step, skipped: output.skipped, stages, raster_backends, bytes })
    }

    /// The PNG of a frame and the milliseconds that encoding took. The first caller encodes it; if that caller is
    /// cancelled, the next one does.
    async fn png(&self, frame: &Arc<ColorFrame>) -> Result<(Bytes, f64)> {
        let encode = || {
            let frame = Arc::clone(frame);
            self.run(move || frame::encode_png(frame.width, frame.height, &frame.rgba))
        };
        frame.png.get_or_try_init(encode).await.cloned()
    }

    /// Runs work on a blocking thread as soon as the thread limit permits. Returns the bytes and the run time in
    /// milliseconds, without the wait.
    async fn run(&self, work: impl FnOnce() -> Result<Vec<u8>> + Send + 'static) -> Result<(Bytes, f64)> {
        let permit = Arc::clone(&self.threads).acquire_owned().await.map_err(fault_in("encode"))?;
        run_blocking("encode", move || {
            let _permit = permit;
            let begin = Instant::now();
            work().map(|bytes| (bytes.into(), ms_since(begin)))
        })
        .await
    }
}

fn color_map(image: &AovImage, legend: &Legend, format: FrameFormat) -> Result<Vec<u8>> {
    let size = [image.width, image.height];
    let rgba = frame::draw_color_map(&image.bytes, image.samples, size, legend)?;
    if format == FrameFormat::Png { frame::encode_png(size[0], size[1], &rgba) } else { Ok(rgba) }
}

#[cfg(test)]
pub(in crate::engine) mod tests {
    use super::*;
    use modalcast_render::FrameImage;

    /// A frame of noise, so that its PNG takes time.
    pub(in crate::engine) fn noise(number: u64, side: u32) -> StepOutput {
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

    /// An encoder without threads. It starts to work when the test adds permits to the semaphore.
    pub(in crate::engine) fn paused(cores: usize) -> (FrameEncoder, Arc<Semaphore>) {
        let encoder = FrameEncoder { threads: Arc::new(Semaphore::new(0)), cores };
        let threads = Arc::clone(&encoder.threads);
        (encoder, threads)
    }

    #[tokio::test]
    async fn subscribers_share_one_png_and_raw_pixels() {
        let encoder = FrameEncoder::new(2);
        let output = noise(1, 16);
        let both = async |format| {
            let (one, other) = (encoder.encode(output.clone(), format), encoder.encode(output.clone(), format));
            let (one, other) = tokio::join!(one, other);
            (one.expect("encodes"), other.expect("encodes"))
        };
        for format in [FrameFormat::Png, FrameFormat::Rgba] {
            let (one, other) = both(format).await;
            assert_eq!((one.bytes.as_ptr(), one.bytes.len()), (other.bytes.as_ptr(), other.bytes.len()), "{format:?}");
            assert_eq!(one.stages, other.stages, "{format:?}");
        }
        let separate = encoder.encode(noise(1, 16), FrameFormat::Png).await.expect("encodes");
        let (shared, _) = both(FrameFormat::Png).await;
        assert_eq!(separate.bytes, shared.bytes);
        assert_ne!(separate.bytes.as_ptr(), shared.bytes.as_ptr(), "control: another drawing has its own PNG");
    }

    #[tokio::test]
    async fn cancelled_encoding_is_taken_over_by_the_next_subscriber() {
        let (encoder, threads) = paused(1);
        let output = noise(2, 8);
        let first = encoder.encode(output.clone(), FrameFormat::Png);
        tokio::time::timeout(std::time::Duration::from_millis(20), first).await.expect_err("no thread is free");
        threads.add_permits(1);
        let second = encoder.encode(output, FrameFormat::Png).await.expect("encodes");
        assert!(image::load_from_memory(&second.bytes).is_ok());
    }
}
