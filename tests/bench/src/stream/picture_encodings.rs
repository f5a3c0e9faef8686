//! Encodings of pictures: time, bytes and error of the server's encoder and of alternatives, on one frame of a scene.

use std::time::Instant;

use modalcast_client::FrameRequest;
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
    /// Filter and compression level of a PNG.
    pub encoder: String,
    /// Whether the server uses this encoder. Its time includes the removal of the opaque alpha channel.
    pub is_used_by_server: bool,
    pub bytes: usize,
    /// Median time of one thread.
    pub ms: f64,
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

/// An encoder to measure. A lossy format would be a further variant.
#[derive(Debug, Clone, Copy)]
enum Encoder {
    /// The encoder that the server uses.
    Server,
    Png(png::Filter, png::Compression),
}

impl Encoder {
    fn name(self) -> String {
        match self {
            Self::Server => "PNG of the server".into(),
            Self::Png(filter, level) => format!("PNG {filter:?} {level:?}"),
        }
    }

    fn encode(self, pixels: &Pixels) -> Result<Vec<u8>> {
        match self {
            Self::Server => modalcast::frame::encode_png(pixels.width, pixels.height, &pixels.rgba),
            Self::Png(filter, level) => encode_png(pixels, filter, level),
        }
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
    encoders().into_iter().map(|encoder| measure_encoder(encoder, &pixels, repetitions)).collect()
}

async fn draw(session: &Session, content: Content) -> Result<Pixels> {
    let picture = viewer::picture(&session.client, SCENE, content, 0).await?;
    let picture = picture.ok_or_else(|| fault("report", "expected a picture"))?;
    let frame = session.client.render_frame(&FrameRequest::new(SCENE, picture)).await.map_err(fault_in("report"))?;
    let rgb = frame.bytes.as_chunks::<4>().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
    Ok(Pixels { width: frame.width, height: frame.height, rgba: frame.bytes.to_vec(), rgb })
}

/// The server's encoder; then all filters at its compression level, and all levels with its filter.
fn encoders() -> Vec<Encoder> {
    use png::{Compression, Filter};
    let filters = [Filter::NoFilter, Filter::Sub, Filter::Up, Filter::Avg, Filter::Paeth, Filter::Adaptive];
    let levels = [Compression::NoCompression, Compression::Fastest, Compression::Balanced, Compression::High];
    let with_filters = filters.into_iter().map(|filter| (filter, Compression::Fast));
    let with_levels = levels.into_iter().map(|level| (Filter::Sub, level));
    let png = |(filter, level)| Encoder::Png(filter, level);
    std::iter::once(Encoder::Server).chain(with_filters.chain(with_levels).map(png)).collect()
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
    // The first run is not timed.
    let bytes = encoder.encode(pixels)?;
    let mut times_ms = Vec::new();
    for _ in 0..repetitions {
        let start = Instant::now();
        encoder.encode(pixels)?;
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let [largest_error, rms_error] = decoding_errors(&bytes, &pixels.rgb)?;
    Ok(PictureEncodingRow {
        encoder: encoder.name(),
        is_used_by_server: matches!(encoder, Encoder::Server),
        bytes: bytes.len(),
        ms: quantile(&mut times_ms, 0.5).unwrap_or(0.0),
        largest_error,
        rms_error,
    })
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
    fn every_png_is_lossless_and_one_is_used_by_the_server() {
        let rows: Vec<PictureEncodingRow> = encoders()
            .into_iter()
            .map(|encoder| measure_encoder(encoder, &pixels(), 2).expect("expected a PNG"))
            .collect();
        assert!(rows.iter().all(|row| (row.largest_error, row.rms_error) == (0.0, 0.0) && row.bytes > 100), "{rows:?}");
        let used: Vec<usize> = rows.iter().filter(|row| row.is_used_by_server).map(|row| row.bytes).collect();
        let same = rows.iter().find(|row| row.encoder == "PNG Sub Fast").map(|row| row.bytes);
        // The server's PNG also has a chunk that states the color space.
        assert!(used.len() == 1 && same.is_some_and(|bytes| (bytes..bytes + 100).contains(&used[0])), "{rows:?}");
    }

    #[test]
    fn error_of_a_changed_channel_is_measured() {
        let Pixels { width, height, mut rgba, rgb } = pixels();
        rgba[0] ^= 8;
        let changed = modalcast::frame::encode_png(width, height, &rgba).expect("expected a PNG");
        let [largest, rms] = decoding_errors(&changed, &rgb).expect("expected pixels");
        assert_eq!(largest, 8.0);
        assert!((rms - 8.0 / 384.0_f64.sqrt()).abs() < 1e-12, "{rms}");
        assert!(decoding_errors(&changed, &rgb[3..]).is_err());
    }
}
