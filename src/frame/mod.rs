//! Converts AOVs of values to color maps and encodes pixels as PNG. All functions are pure, so they run off the device
//! thread.

mod colormap;
mod legend;

pub use colormap::{apply_colormap, viridis};
pub use legend::{Legend, draw as draw_legend, round_up_scale};

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

/// Encodes RGBA8 sRGB pixels, top row first, as PNG. The file has no alpha channel if every pixel is opaque. Uses
/// filter Sub with fast compression. On rendered frames this takes a quarter of the time of adaptive filters and yields
/// smaller files.
///
/// # Errors
/// `Fault` when the encoder fails.
pub fn encode_png(width: u32, height: u32, rgba: &[u8]) -> Result<Vec<u8>> {
    match drop_opaque_alpha(rgba) {
        Some(rgb) => write_png(width, height, png::ColorType::Rgb, &rgb),
        None => write_png(width, height, png::ColorType::Rgba, rgba),
    }
}

/// The pixels without alpha; `None` unless every alpha is 255.
fn drop_opaque_alpha(rgba: &[u8]) -> Option<Vec<u8>> {
    let (pixels, _) = rgba.as_chunks::<4>();
    // The bitwise AND of all alphas is 255 only if every alpha is.
    if pixels.iter().fold(u8::MAX, |alpha_bits, pixel| alpha_bits & pixel[3]) != u8::MAX {
        return None;
    }
    let mut rgb = vec![0; 3 * pixels.len()];
    for (rgb_pixel, [r, g, b, _]) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(pixels) {
        *rgb_pixel = [*r, *g, *b];
    }
    Some(rgb)
}

fn write_png(width: u32, height: u32, color: png::ColorType, pixels: &[u8]) -> Result<Vec<u8>> {
    let encoding_fault = modalcast_model::error::fault_in::<png::EncodingError>("encode");
    let mut bytes = Vec::with_capacity(pixels.len() / 4);
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    // `set_compression` also sets a filter, so `set_filter` must come after it.
    encoder.set_compression(png::Compression::Fast);
    encoder.set_filter(png::Filter::Sub);
    let mut writer = encoder.write_header().map_err(&encoding_fault)?;
    writer.write_image_data(pixels).map_err(&encoding_fault)?;
    writer.finish().map_err(&encoding_fault)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_round_trip_keeps_pixels_and_drops_opaque_alpha() {
        // 5 x 3 pixels of four bytes.
        let translucent: Vec<u8> = (0..4 * 5 * 3).map(|byte| byte as u8 * 4).collect();
        let mut opaque = translucent.clone();
        opaque.chunks_exact_mut(4).for_each(|pixel| pixel[3] = 255);
        let mut translucent_at_end = opaque.clone();
        translucent_at_end[4 * 5 * 3 - 1] = 254;
        for (pixels, has_alpha) in [(translucent, true), (opaque, false), (translucent_at_end, true)] {
            let decoded = image::load_from_memory(&encode_png(5, 3, &pixels).expect("expected an encoded PNG"))
                .expect("expected a decodable PNG");
            assert_eq!(decoded.color().has_alpha(), has_alpha);
            let decoded = decoded.into_rgba8();
            assert_eq!((decoded.dimensions(), decoded.into_raw()), ((5, 3), pixels));
        }
    }
}
