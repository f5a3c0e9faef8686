//! Converts AOVs of values to color maps and encodes pixels as PNG or JPEG. All functions are pure, so they run off the
//! device thread.

mod colormap;
mod jpeg;
mod legend;
mod png;
mod rgb;

pub use colormap::{apply_colormap, viridis};
pub use jpeg::{JpegBuffers, JpegLayout};
pub use legend::{Legend, draw as draw_legend, round_up_scale};
pub use png::{EncodedStrip, PngLayout, StripBuffers};
pub use rgb::drop_alpha;

use modalcast_model::error::Result;

/// Converts an AOV of values to RGBA8 sRGB pixels with a legend. `word_bytes` contains native-endian u32 words with the
/// layout of [`apply_colormap`], `samples` words per pixel. `size` is the width and height in pixels.
///
/// # Errors
/// `Fault` when the legend cannot be drawn.
pub fn draw_color_map(word_bytes: &[u8], samples: u32, size: [u32; 2], legend: &Legend) -> Result<Vec<u8>> {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(word_bytes);
    let mut rgba = apply_colormap(&words, samples as usize);
    draw_legend(&mut rgba, size, legend)?;
    Ok(rgba)
}

/// Encodes RGBA8 sRGB pixels, top row first, as PNG on the calling thread. The file has no alpha channel if every pixel
/// is opaque. [`PngLayout`] divides the work for several threads, with the same result.
///
/// # Errors
/// `Fault` when a side is 0, the picture is too large for PNG, or `rgba` has too few pixels.
pub fn encode_png(width: u32, height: u32, rgba: &[u8]) -> Result<Vec<u8>> {
    png::encode(width, height, rgba)
}

/// Encodes RGBA8 sRGB pixels, top row first, as baseline JPEG without alpha, on the calling thread. `quality` is 1 to 100.
/// Below 90 the chroma has half the resolution in both directions. [`JpegLayout`] divides the work for several threads,
/// with the same result.
///
/// # Errors
/// `Fault` when a side is 0 or has more than 65,535 pixels, or `rgba` has too few pixels.
pub fn encode_jpeg(width: u32, height: u32, rgba: &[u8], quality: u8) -> Result<Vec<u8>> {
    jpeg::encode(width, height, rgba, quality)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean difference of the color channels, 0 to 255. Alpha is ignored.
    fn mean_error(rgb: &[u8], rgba: &[u8]) -> f64 {
        let channels = rgba.as_chunks::<4>().0.iter().flat_map(|pixel| &pixel[..3]);
        let sum: u64 = rgb.iter().zip(channels).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        sum as f64 / rgb.len() as f64
    }

    #[test]
    fn jpeg_error_is_small_and_decreases_with_quality() {
        let (width, height) = (61, 47);
        // Colored waves of different lengths, in both directions.
        let wave = |position: u32, length: f64| 128.0 + 100.0 * (f64::from(position) / length).sin();
        let pixel = |x: u32, y: u32| [wave(x, 3.0) as u8, wave(y, 5.0) as u8, wave(x + y, 4.0) as u8, 255];
        let rgba: Vec<u8> = (0..width * height).flat_map(|index| pixel(index % width, index / width)).collect();
        let error_at = |quality| {
            let bytes = encode_jpeg(width, height, &rgba, quality).expect("expected an encoded JPEG");
            let decoded = image::load_from_memory(&bytes).expect("expected a decodable JPEG").into_rgb8();
            assert_eq!(decoded.dimensions(), (width, height));
            mean_error(&decoded, &rgba)
        };
        let errors = [100, 95, 60, 1].map(error_at);
        assert!(errors[0] < 2.0 && errors.is_sorted_by(|a, b| a < b), "{errors:?}");
        assert!(encode_jpeg(65_536, 1, &[0; 4 * 65_536], 90).is_err());
    }
}
