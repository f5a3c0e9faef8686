//! Encodes frames for the wire as PNG, JPEG or raw pixels. All streams share one encoder, which uses at most one thread
//! per core. The strips of a PNG or JPEG are encoded in parallel.

use std::num::NonZero;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::encoder_pool::EncoderPool;
use super::frame_format::{FrameFormat, JpegQuality};
use super::rendered_picture::{Pixels, RenderedPicture};
use crate::frame::{self, EncodedStrip, JpegBuffers, JpegLayout, PngLayout, StripBuffers};
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::error::{Result, fault, fault_in};

/// The bytes of a picture for the wire.
#[derive(Debug)]
pub(super) struct EncodedPicture {
    pub bytes: Bytes,
    /// Stage times of the picture.
    pub stages: StageTimes,
}

/// Encodes frames off the device thread. Clones share its threads.
#[derive(Debug, Clone)]
pub struct FrameEncoder {
    pool: EncoderPool,
    /// Each picture in the pool holds a permit, and there are as many permits as threads. A further picture waits for a
    /// permit, in the order of the requests.
    picture_permits: Arc<Semaphore>,
    cores: usize,
}

impl FrameEncoder {
    /// An encoder for this machine: one thread per core.
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(in crate::engine) fn per_core() -> Result<Self> {
        Self::new(std::thread::available_parallelism().map_or(1, NonZero::get))
    }

    fn new(cores: usize) -> Result<Self> {
        Ok(Self { pool: EncoderPool::new(cores)?, picture_permits: Arc::new(Semaphore::new(cores)), cores })
    }

    /// Maximum number of frames that are encoded concurrently.
    pub(in crate::engine) const fn cores(&self) -> usize {
        self.cores
    }

    /// Encodes a picture.
    ///
    /// # Errors
    /// `Fault` when the encoder fails.
    pub(super) async fn encode(&self, picture: &Arc<RenderedPicture>, format: FrameFormat) -> Result<EncodedPicture> {
        let mut stages = picture.stages.clone();
        let bytes = match (&picture.pixels, format) {
            (Pixels::Color(rgba), FrameFormat::Rgba) => rgba.clone(),
            (Pixels::Values(bytes), _) => bytes.clone(),
            (Pixels::Color(_) | Pixels::PngOnly | Pixels::ColorMap(..), _) => {
                let (bytes, ms) = self.encode_once(picture, format).await?;
                stages.push((Stage::Encode, ms));
                bytes
            }
        };
        Ok(EncodedPicture { bytes, stages })
    }

    /// Returns the encoding of a picture and the milliseconds that encoding took. The first caller encodes the picture.
    /// If this caller is cancelled, the next caller encodes the picture.
    async fn encode_once(&self, picture: &Arc<RenderedPicture>, format: FrameFormat) -> Result<(Bytes, f64)> {
        picture.encoding(format).get_or_try_init(|| self.encode_picture(picture, format)).await.cloned()
    }

    /// Encodes a picture as soon as the limit on pictures permits. Returns the encoding and its time in milliseconds,
    /// without the waits for a permit and for the first thread.
    async fn encode_picture(&self, picture: &Arc<RenderedPicture>, format: FrameFormat) -> Result<(Bytes, f64)> {
        let permit = Arc::clone(&self.picture_permits).acquire_owned().await.map_err(fault_in("encode"))?;
        let permit = Arc::new(permit);
        let (rgba, draw_ms) = self.pixels(picture, &permit).await?;
        let (width, height) = (picture.width, picture.height);
        let (bytes, encode_ms) = match format {
            FrameFormat::Png => self.encode_png([width, height], rgba, &permit).await?,
            FrameFormat::Jpeg(quality) => self.encode_jpeg([width, height], quality, rgba, &permit).await?,
            FrameFormat::Rgb => self.run(&permit, move || Ok(frame::drop_alpha(&rgba).into())).await?,
            FrameFormat::Rgba => (rgba, 0.0),
            FrameFormat::F32 | FrameFormat::U32 | FrameFormat::F32x3 => {
                return Err(fault("encode", "expected a format of colors, got a format of numbers"));
            }
        };
        Ok((bytes, draw_ms + encode_ms))
    }

    /// The colors of a picture. Draws a color map with its legend first.
    async fn pixels(&self, picture: &Arc<RenderedPicture>, permit: &Arc<OwnedSemaphorePermit>) -> Result<(Bytes, f64)> {
        match &picture.pixels {
            Pixels::Color(rgba) => Ok((rgba.clone(), 0.0)),
            Pixels::ColorMap(..) => {
                let picture = Arc::clone(picture);
                self.run(permit, move || draw_color_map(&picture)).await
            }
            Pixels::PngOnly => Err(fault("encode", "expected colors, got a PNG file")),
            Pixels::Values(_) => Err(fault("encode", "expected colors, got values")),
        }
    }

    /// Encodes the strips of a picture in parallel: first without alpha, and again with alpha if a strip turns out to
    /// be translucent. Frames are opaque, so reading all pixels in advance would only add latency.
    async fn encode_png(
        &self,
        [width, height]: [u32; 2],
        rgba: Bytes,
        permit: &Arc<OwnedSemaphorePermit>,
    ) -> Result<(Bytes, f64)> {
        let opaque = PngLayout::opaque(width, height)?;
        let (file, ms) = self.encode_png_strips(opaque, rgba.clone(), permit).await?;
        if let Some(file) = file {
            return Ok((file, ms));
        }
        let (file, translucent_ms) = self.encode_png_strips(opaque.translucent()?, rgba, permit).await?;
        Ok((file.ok_or_else(|| fault("encode", "expected a PNG with alpha"))?, ms + translucent_ms))
    }

    /// Encodes the strips of a picture. Returns `None` if a pixel is not opaque and the layout has no alpha channel.
    async fn encode_png_strips(
        &self,
        layout: PngLayout,
        rgba: Bytes,
        permit: &Arc<OwnedSemaphorePermit>,
    ) -> Result<(Option<Bytes>, f64)> {
        let is_translucent = AtomicBool::new(false);
        let encode_strip = move |index: usize, buffers: &mut StripBuffers| {
            // Once one strip is translucent, the others are not needed.
            if is_translucent.load(Ordering::Relaxed) {
                return Ok(None);
            }
            let strip = layout.encode_strip(&rgba, index, buffers);
            is_translucent.fetch_or(matches!(strip, Ok(None)), Ordering::Relaxed);
            strip
        };
        let permit = Arc::clone(permit);
        let assemble = move |strips: Vec<Result<Option<EncodedStrip>>>| {
            let _permit = permit;
            let strips: Option<Vec<EncodedStrip>> = strips.into_iter().collect::<Result<_>>()?;
            Ok(strips.map(|strips| Bytes::from(layout.assemble(&strips))))
        };
        let (file, ms) = self.pool.run(layout.strip_count(), encode_strip, assemble).await?;
        Ok((file?, ms))
    }

    /// Encodes the strips of a picture in parallel.
    async fn encode_jpeg(
        &self,
        [width, height]: [u32; 2],
        quality: JpegQuality,
        rgba: Bytes,
        permit: &Arc<OwnedSemaphorePermit>,
    ) -> Result<(Bytes, f64)> {
        let layout = Arc::new(JpegLayout::new(width, height, quality.get())?);
        let strip_layout = Arc::clone(&layout);
        let encode_strip =
            move |index: usize, buffers: &mut JpegBuffers| strip_layout.encode_strip(&rgba, index, buffers);
        let permit = Arc::clone(permit);
        let strip_count = layout.strip_count();
        let assemble = move |strips: Vec<Result<Vec<u8>>>| {
            let _permit = permit;
            let strips: Vec<Vec<u8>> = strips.into_iter().collect::<Result<_>>()?;
            Ok(Bytes::from(layout.assemble(&strips)))
        };
        let (file, ms) = self.pool.run(strip_count, encode_strip, assemble).await?;
        Ok((file?, ms))
    }

    /// Runs work that has no parallel parts. The work holds the permit, also after its caller is cancelled.
    async fn run(
        &self,
        permit: &Arc<OwnedSemaphorePermit>,
        work: impl Fn() -> Result<Bytes> + Send + Sync + 'static,
    ) -> Result<(Bytes, f64)> {
        let permit = Arc::clone(permit);
        let finish = move |results: Vec<Result<Bytes>>| {
            let _permit = permit;
            results.into_iter().next().unwrap_or_else(|| Err(fault("encode", "expected a result")))
        };
        let (bytes, ms) = self.pool.run(1, move |_, (): &mut ()| work(), finish).await?;
        Ok((bytes?, ms))
    }
}

/// Draws a color map with its legend.
fn draw_color_map(picture: &RenderedPicture) -> Result<Bytes> {
    let Pixels::ColorMap(image, legend) = &picture.pixels else {
        return Err(fault("encode", "expected values with a legend"));
    };
    // `samples` is the number of samples per pixel.
    let rgba = frame::draw_color_map(&image.bytes, image.samples, [picture.width, picture.height], legend)?;
    Ok(rgba.into())
}

#[cfg(test)]
pub(in crate::engine) mod tests {
    use super::*;
    use crate::engine::device::handle::PendingReply;
    use crate::engine::output::frame_format::JpegQuality;
    use crate::engine::output::step_output::{OutputBody, StepFrames, StepId, StepOutput};
    use modalcast_render::{FrameImage, FrameInfo};

    /// A picture of noise, so that encoding its PNG takes time.
    fn noise_picture(seed: u64, side: u32) -> Arc<RenderedPicture> {
        let mut random = fastrand::Rng::with_seed(seed);
        let rgba: Vec<u8> = (0..side * side).flat_map(|_| [random.u8(..), random.u8(..), random.u8(..), 255]).collect();
        let image = FrameImage {
            width: side,
            height: side,
            rgba: rgba.into(),
            times: modalcast_render::FrameTimes::default(),
            info: FrameInfo::default(),
        };
        Arc::new(image.into())
    }

    /// A frame of noise. `number` is the step number and the seed.
    pub(in crate::engine) fn noise_frame(number: u64, side: u32) -> StepOutput {
        let step = StepId { run: 1, number, time: 0.0 };
        let pictures = vec![Arc::new(PendingReply::answered(noise_picture(number, side)))];
        let body = OutputBody::Frames(StepFrames { pictures, camera_version: 0 });
        StepOutput { step, skipped: 0, stages: vec![], origins: None, body }
    }

    fn encoder(cores: usize) -> FrameEncoder {
        FrameEncoder::new(cores).expect("expected threads")
    }

    /// An encoder without permits. It encodes once the test adds permits to the semaphore.
    pub(in crate::engine) fn paused_encoder(cores: usize) -> (FrameEncoder, Arc<Semaphore>) {
        let picture_permits = Arc::new(Semaphore::new(0));
        (FrameEncoder { picture_permits: Arc::clone(&picture_permits), ..encoder(cores) }, picture_permits)
    }

    #[tokio::test]
    async fn subscribers_share_one_png_and_raw_pixels() {
        let encoder = encoder(2);
        let picture = noise_picture(1, 16);
        let encode_twice = async |format| {
            let first = encoder.encode(&picture, format);
            let second = encoder.encode(&picture, format);
            let (first, second) = tokio::join!(first, second);
            (first.expect("expected an encoded frame"), second.expect("expected an encoded frame"))
        };
        let jpeg = |quality| FrameFormat::Jpeg(JpegQuality::parse("quality", quality).expect("expected a quality"));
        for format in [FrameFormat::Png, FrameFormat::Rgb, FrameFormat::Rgba, jpeg(50), jpeg(90)] {
            let (first, second) = encode_twice(format).await;
            assert_eq!(first.bytes.as_ptr(), second.bytes.as_ptr(), "{format:?}: expected shared bytes");
            assert_eq!(first.bytes.len(), second.bytes.len(), "{format:?}");
            assert_eq!(first.stages, second.stages, "{format:?}");
        }
        let other_frame = encoder.encode(&noise_picture(1, 16), FrameFormat::Png).await.expect("expected a PNG");
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
    async fn all_threads_write_the_files_of_one_thread() {
        let encoder = encoder(3);
        let picture = noise_picture(5, 300);
        let encode = async |format| encoder.encode(&picture, format).await.expect("expected an encoded frame").bytes;
        let rgba = encode(FrameFormat::Rgba).await;
        let quality = JpegQuality::parse("quality", 70).expect("expected a quality");
        let jpeg = frame::encode_jpeg(300, 300, &rgba, 70).expect("expected a JPEG");
        let png = frame::encode_png(300, 300, &rgba).expect("expected a PNG");
        assert!(encode(FrameFormat::Jpeg(quality)).await == jpeg && encode(FrameFormat::Png).await == png);
    }

    #[tokio::test]
    async fn next_subscriber_encodes_after_a_cancelled_one() {
        let (encoder, picture_permits) = paused_encoder(1);
        let picture = noise_picture(2, 8);
        let first = encoder.encode(&picture, FrameFormat::Png);
        let timeout = std::time::Duration::from_millis(20);
        tokio::time::timeout(timeout, first).await.expect_err("expected no PNG without a thread");
        picture_permits.add_permits(1);
        let second = encoder.encode(&picture, FrameFormat::Png).await.expect("expected a PNG");
        assert!(image::load_from_memory(&second.bytes).is_ok());
    }

    /// Readers of PNG share the file that the device has encoded. Readers of pixels get them if they are there.
    #[tokio::test]
    async fn file_of_the_device_is_not_encoded_again() {
        let (encoder, _picture_permits) = paused_encoder(1);
        let rgba = vec![9_u8; 4 * 2 * 2];
        let picture = |has_pixels: bool| {
            let encoded = modalcast_render::EncodedPng {
                png: vec![1, 2, 3],
                ms: 0.5,
                rgba: has_pixels.then(|| Box::new(rgba.clone().into())),
            };
            let image = FrameImage {
                width: 2,
                height: 2,
                rgba: modalcast_render::FramePixels::Encoded(encoded),
                times: modalcast_render::FrameTimes::default(),
                info: FrameInfo::default(),
            };
            Arc::new(RenderedPicture::from(image))
        };
        for has_pixels in [false, true] {
            let picture = picture(has_pixels);
            let png = encoder.encode(&picture, FrameFormat::Png).await.expect("expected the file");
            assert_eq!((&png.bytes[..], png.stages), (&[1, 2, 3][..], vec![(Stage::Encode, 0.5)]));
            // Without pixels this fails only after a permit for the CPU, which the paused encoder does not give.
            let pixels = encoder.encode(&picture, FrameFormat::Rgba);
            let pixels = tokio::time::timeout(std::time::Duration::from_millis(20), pixels).await;
            assert_eq!(pixels.is_ok_and(|frame| frame.is_ok_and(|frame| frame.bytes == rgba)), has_pixels);
        }
    }
}
