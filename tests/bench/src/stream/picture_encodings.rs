//! Encodings of pictures: time, bytes and error of the server's encoders and of alternatives, on one frame of a scene.

use std::cell::RefCell;
use std::num::NonZero;
use std::time::Instant;

use modalcast::frame::{self, EncodedStrip, JpegBuffers, JpegLayout, PngLayout, StripBuffers};
use modalcast_client::FrameRequest;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::{Device, DevicePicture, EncodedPng, PngChannels, PngEncoder};
use rayon::prelude::*;
use serde::Serialize;

use super::SCENE;
use super::StreamReportOptions;
use super::peers::viewer::{self, Content};
use super::session::Session;
use crate::timing::quantile;
use crate::workloads::Size;
use modalcast_model::error::{Result, fault, fault_in};

/// One encoder.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PictureEncodingRow {
    /// Filter and compression level of a PNG, or quality of a JPEG.
    pub encoder: String,
    /// Whether the server uses this encoder. The time of its PNG includes the removal of the opaque alpha channel.
    pub is_used_by_server: bool,
    pub bytes: usize,
    /// Median time of one thread, or of the device.
    pub ms: f64,
    /// Median time of one picture on all threads. `None` if the encoder uses one thread per picture.
    pub all_threads_ms: Option<f64>,
    /// Errors of a channel after decoding, in levels of 255; 0 for a lossless encoding.
    pub largest_error: f64,
    pub rms_error: f64,
}

/// Pixels of a frame, 8-bit sRGB.
struct Pixels {
    width: u32,
    height: u32,
    rgba: Vec<u8>,
    rgb: Vec<u8>,
}

/// An encoder to measure.
#[derive(Debug, Clone, Copy)]
enum Encoder {
    /// The PNG encoder that the server uses.
    ServerPng,
    /// The JPEG encoder that the server uses, with a quality.
    ServerJpeg(u8),
    /// The crate `png`.
    Png(png::Filter, png::Compression),
    /// The crate `jpeg-encoder`, with a quality.
    Jpeg(u8),
}

impl Encoder {
    fn name(self) -> String {
        match self {
            Self::ServerPng => "PNG of the server".into(),
            Self::ServerJpeg(quality) => format!("JPEG of quality {quality}"),
            Self::Png(filter, level) => format!("PNG {filter:?} {level:?}"),
            Self::Jpeg(quality) => format!("JPEG of quality {quality} by the crate `jpeg-encoder`"),
        }
    }

    fn encode(self, pixels: &Pixels) -> Result<Vec<u8>> {
        match self {
            Self::ServerPng => frame::encode_png(pixels.width, pixels.height, &pixels.rgba),
            Self::ServerJpeg(quality) => frame::encode_jpeg(pixels.width, pixels.height, &pixels.rgba, quality),
            Self::Png(filter, level) => encode_png(pixels, filter, level),
            Self::Jpeg(quality) => encode_jpeg(pixels, quality),
        }
    }

    const fn is_used_by_server(self) -> bool {
        matches!(self, Self::ServerPng | Self::ServerJpeg(_))
    }
}

/// Measures all encoders on a frame of the scene.
///
/// # Errors
/// `Fault` when the frame cannot be drawn, or an encoder fails.
pub(super) fn measure(
    session: &Session,
    content: Content,
    options: &StreamReportOptions,
) -> Result<Vec<PictureEncodingRow>> {
    let pixels = session.runtime.block_on(draw(session, content))?;
    let repetitions = match options.size {
        Size::Full => 7,
        Size::Quick => 3,
    };
    let rows = encoders().into_iter().map(|encoder| measure_encoder(encoder, &pixels, repetitions));
    let mut rows: Vec<PictureEncodingRow> = rows.collect::<Result<_>>()?;
    rows.extend(measure_cuda(&pixels, repetitions)?);
    Ok(rows)
}

async fn draw(session: &Session, content: Content) -> Result<Pixels> {
    let picture = viewer::picture(&session.client, SCENE, content, 0).await?;
    let picture = picture.ok_or_else(|| fault("report", "expected a picture"))?;
    let frame = session.client.render_frame(&FrameRequest::new(SCENE, picture)).await.map_err(fault_in("report"))?;
    let rgb = frame.bytes.as_chunks::<4>().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
    Ok(Pixels { width: frame.width, height: frame.height, rgba: frame.bytes.to_vec(), rgb })
}

/// The server's encoders; then the crate `jpeg-encoder`, and the crate `png` with all filters at one compression level, and all levels with one
/// filter.
fn encoders() -> Vec<Encoder> {
    use png::{Compression, Filter};
    let filters = [Filter::NoFilter, Filter::Sub, Filter::Up, Filter::Avg, Filter::Paeth, Filter::Adaptive];
    let levels = [Compression::NoCompression, Compression::Fastest, Compression::Balanced, Compression::High];
    let with_filters = filters.into_iter().map(|filter| (filter, Compression::Fast));
    let with_levels = levels.into_iter().map(|level| (Filter::Sub, level));
    let png = |(filter, level)| Encoder::Png(filter, level);
    let jpegs = [50, 75, 90, 100].map(Encoder::ServerJpeg).into_iter().chain([75, 90].map(Encoder::Jpeg));
    std::iter::once(Encoder::ServerPng).chain(jpegs).chain(with_filters.chain(with_levels).map(png)).collect()
}

/// The PNG of the server, whose strips are encoded on all threads.
fn encode_png_on_all_threads(pixels: &Pixels) -> Result<Vec<u8>> {
    let layout = PngLayout::opaque(pixels.width, pixels.height)?;
    let encode_strip = |buffers: &mut StripBuffers, index| layout.encode_strip(&pixels.rgba, index, buffers);
    let strips = (0..layout.strip_count()).into_par_iter().map_init(StripBuffers::default, encode_strip);
    let strips: Option<Vec<EncodedStrip>> = strips.collect::<Result<Vec<_>>>()?.into_iter().collect();
    Ok(layout.assemble(&strips.ok_or_else(|| fault("report", "expected an opaque picture"))?))
}

/// The JPEG of the server, whose strips are encoded on all threads.
fn encode_jpeg_on_all_threads(pixels: &Pixels, quality: u8) -> Result<Vec<u8>> {
    let layout = JpegLayout::new(pixels.width, pixels.height, quality)?;
    let encode_strip = |buffers: &mut JpegBuffers, index| layout.encode_strip(&pixels.rgba, index, buffers);
    let strips = (0..layout.strip_count()).into_par_iter().map_init(JpegBuffers::default, encode_strip);
    Ok(layout.assemble(&strips.collect::<Result<Vec<_>>>()?))
}

fn encode_jpeg(pixels: &Pixels, quality: u8) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, quality);
    encoder.set_chroma_subsampling_method(jpeg_encoder::ChromaSubsamplingMethod::Average);
    let [width, height] = [pixels.width as u16, pixels.height as u16];
    encoder.encode(&pixels.rgba, width, height, jpeg_encoder::ColorType::Rgba).map_err(fault_in("report"))?;
    Ok(bytes)
}

fn encode_png(pixels: &Pixels, filter: png::Filter, level: png::Compression) -> Result<Vec<u8>> {
    let to_fault = fault_in::<png::EncodingError>("report");
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, pixels.width, pixels.height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    // `set_compression` also sets a filter, so `set_filter` must come after it.
    encoder.set_compression(level);
    encoder.set_filter(filter);
    let mut writer = encoder.write_header().map_err(&to_fault)?;
    writer.write_image_data(&pixels.rgb).map_err(&to_fault)?;
    writer.finish().map_err(&to_fault)?;
    Ok(bytes)
}

fn measure_encoder(encoder: Encoder, pixels: &Pixels, repetitions: usize) -> Result<PictureEncodingRow> {
    let (bytes, ms) = time_median(repetitions, || encoder.encode(pixels))?;
    let all_threads_ms = match encoder {
        Encoder::ServerPng => Some(time_median(repetitions, || encode_png_on_all_threads(pixels))?.1),
        Encoder::ServerJpeg(quality) => {
            Some(time_median(repetitions, || encode_jpeg_on_all_threads(pixels, quality))?.1)
        }
        Encoder::Png(..) | Encoder::Jpeg(_) => None,
    };
    let [largest_error, rms_error] = decoding_errors(&bytes, &pixels.rgb)?;
    Ok(PictureEncodingRow {
        encoder: encoder.name(),
        is_used_by_server: encoder.is_used_by_server(),
        bytes: bytes.len(),
        ms,
        all_threads_ms,
        largest_error,
        rms_error,
    })
}

/// Measures the PNG encoder in CUDA, from pixels in device memory to a file in host memory. `None` on a machine without
/// a CUDA device.
fn measure_cuda(pixels: &Pixels, repetitions: usize) -> Result<Option<PictureEncodingRow>> {
    let Ok(device) = Device::open(0) else { return Ok(None) };
    let Pixels { width, height, .. } = *pixels;
    // `time_median` holds one file while it encodes others.
    let slot_count = NonZero::<usize>::MIN.saturating_add(1);
    let encoder = RefCell::new(PngEncoder::new(&device, [width, height], PngChannels::Rgb, slot_count)?);
    let memory = DeviceBuffer::upload(&device, &pixels.rgba)?;
    let picture = DevicePicture { address: memory.address(), pitch: 4 * i64::from(width), width, height };
    let encode = || -> Result<EncodedPng> {
        // SAFETY: the memory of the picture outlives the encoding, and nothing writes it.
        let pending = unsafe { encoder.borrow_mut().encode(&picture) }?;
        let file = pending.ok_or_else(|| fault("report", "expected a free slot"))?.wait()?;
        file.ok_or_else(|| fault("report", "expected an opaque picture"))
    };
    let (file, ms) = time_median(repetitions, encode)?;
    let [largest_error, rms_error] = decoding_errors(file.as_ref(), &pixels.rgb)?;
    Ok(Some(PictureEncodingRow {
        encoder: "PNG in CUDA, of pixels on the device".into(),
        is_used_by_server: false,
        bytes: file.as_ref().len(),
        ms,
        all_threads_ms: None,
        largest_error,
        rms_error,
    }))
}

/// The result of `encode` and its median time in milliseconds. The first run is not timed.
fn time_median<T>(repetitions: usize, encode: impl Fn() -> Result<T>) -> Result<(T, f64)> {
    let bytes = encode()?;
    let mut times_ms = Vec::new();
    for _ in 0..repetitions {
        let start = Instant::now();
        encode()?;
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok((bytes, quantile(&mut times_ms, 0.5).unwrap_or(0.0)))
}

/// The largest and the RMS error of a channel of an encoded picture, in levels.
fn decoding_errors(encoded: &[u8], rgb: &[u8]) -> Result<[f64; 2]> {
    let decoded = image::load_from_memory(encoded).map_err(fault_in("report"))?.into_rgb8().into_raw();
    if decoded.len() != rgb.len() {
        return Err(fault("report", format!("expected {} bytes of pixels, got {}", rgb.len(), decoded.len())));
    }
    let differences = || decoded.iter().zip(rgb).map(|(given, expected)| f64::from(given.abs_diff(*expected)));
    let mean_square = differences().map(|difference| difference * difference).sum::<f64>() / decoded.len() as f64;
    Ok([differences().fold(0.0, f64::max), mean_square.sqrt()])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixels() -> Pixels {
        let mut random = fastrand::Rng::with_seed(1);
        let rgb: Vec<u8> = (0..3 * 16 * 8).map(|_| random.u8(..)).collect();
        let rgba = rgb.as_chunks::<3>().0.iter().flat_map(|[r, g, b]| [*r, *g, *b, 255]).collect();
        Pixels { width: 16, height: 8, rgba, rgb }
    }

    #[test]
    fn every_png_is_lossless_and_jpeg_is_not() {
        let rows: Vec<PictureEncodingRow> = encoders()
            .into_iter()
            .map(|encoder| measure_encoder(encoder, &pixels(), 2).expect("expected a picture"))
            .collect();
        let (pngs, jpegs): (Vec<_>, Vec<_>) = rows.iter().partition(|row| row.encoder.starts_with("PNG"));
        assert!(pngs.iter().all(|row| (row.largest_error, row.rms_error) == (0.0, 0.0) && row.bytes > 100), "{rows:?}");
        assert!(jpegs.len() > 2 && jpegs.iter().all(|row| row.rms_error > 0.0), "{rows:?}");
        let used: Vec<&str> = pngs.iter().filter(|row| row.is_used_by_server).map(|row| row.encoder.as_str()).collect();
        assert_eq!(used, ["PNG of the server"]);
        assert_eq!(jpegs.iter().filter(|row| row.is_used_by_server).count(), 4, "{rows:?}");
        assert!(rows.iter().all(|row| row.all_threads_ms.is_some() == row.is_used_by_server), "{rows:?}");
    }

    #[test]
    #[ignore = "needs an NVIDIA GPU"]
    fn gpu_png_has_the_bytes_of_the_server() {
        let row = measure_cuda(&pixels(), 2).expect("expected a picture").expect("expected a CUDA device");
        let file = Encoder::ServerPng.encode(&pixels()).expect("expected a PNG");
        assert_eq!((row.bytes, row.largest_error), (file.len(), 0.0));
    }

    #[test]
    fn all_threads_write_the_same_file() {
        let file = Encoder::ServerPng.encode(&pixels()).expect("expected a PNG");
        assert_eq!(encode_png_on_all_threads(&pixels()).expect("expected a PNG"), file);
        let file = Encoder::ServerJpeg(90).encode(&pixels()).expect("expected a JPEG");
        assert_eq!(encode_jpeg_on_all_threads(&pixels(), 90).expect("expected a JPEG"), file);
    }

    #[test]
    fn error_of_a_changed_channel_is_measured() {
        let Pixels { width, height, mut rgba, rgb } = pixels();
        rgba[0] ^= 8;
        let changed = frame::encode_png(width, height, &rgba).expect("expected a PNG");
        let [largest, rms] = decoding_errors(&changed, &rgb).expect("expected pixels");
        assert_eq!(largest, 8.0);
        assert!((rms - 8.0 / 384.0_f64.sqrt()).abs() < 1e-12, "{rms}");
        assert!(decoding_errors(&changed, &rgb[3..]).is_err());
    }
}
