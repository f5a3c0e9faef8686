//! Pixels to bytes, and numbers to colour maps: pure functions, run off the device thread.

mod legend;
mod map;

pub use legend::{Legend, draw as draw_legend, round_up};
pub use map::{paint, viridis};

use crate::error::Result;

/// RGBA8 pixels of a survey of values (little-endian words, `samples` of them a pixel), with their legend.
///
/// # Errors
/// `Fault` when the legend cannot be drawn.
pub fn colour_map(words: &[u8], samples: u32, size: [u32; 2], legend: &Legend) -> Result<Vec<u8>> {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(words);
    let mut rgba = paint(&words, samples as usize);
    draw_legend(&mut rgba, size, legend)?;
    Ok(rgba)
}

/// PNG of RGBA8 sRGB pixels, top row first.
///
/// # Errors
/// `Fault` when the encoder refuses.
pub fn png(width: u32, height: u32, rgba: &[u8]) -> Result<Vec<u8>> {
    let fail = crate::error::during::<png::EncodingError>("encode");
    let mut bytes = Vec::with_capacity(rgba.len() / 3);
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header().map_err(&fail)?;
    writer.write_image_data(rgba).map_err(&fail)?;
    writer.finish().map_err(&fail)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_decodes_to_the_same_pixels() {
        let pixels: Vec<u8> = (0..4 * 5 * 3).map(|byte| byte as u8 * 4).collect();
        let decoded = image::load_from_memory(&png(5, 3, &pixels).expect("encodes")).expect("decodes").into_rgba8();
        assert_eq!((decoded.dimensions(), decoded.into_raw()), ((5, 3), pixels));
    }
}
