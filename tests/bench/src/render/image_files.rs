//! Encodes image files of a report: references, strips of rendered, reference and difference image, and image grids.

use super::harness::Size;
use super::metrics::differences;
use modalcast_model::error::{Result, fault, fault_in};

/// An encoded image file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageFile {
    /// File name with extension.
    pub name: String,
    pub png: Vec<u8>,
}

/// Factor by which difference images are amplified.
const DIFFERENCE_GAIN: f32 = 4.0;

/// Encodes a reference image. `colors` are sRGB, 0 to 255, top row first.
pub(super) fn encode_reference(name: &str, size: Size, colors: &[[f32; 3]]) -> Result<ImageFile> {
    let rgb = colors.iter().flat_map(|color| color.map(to_byte)).collect();
    encode_png(name, (size.width, size.height), rgb)
}

/// Encodes the rendered, the reference and the difference image (amplified by [`DIFFERENCE_GAIN`], on black) side by
/// side. `rendered` is RGBA.
pub(super) fn encode_strip(name: &str, size: Size, (rendered, reference): (&[u8], &[[f32; 3]])) -> Result<ImageFile> {
    let width = size.width as usize;
    let amplified: Vec<u8> =
        differences(rendered, reference).map(|difference| to_byte(DIFFERENCE_GAIN * difference)).collect();
    // Three images with three bytes per pixel.
    let mut rgb = Vec::with_capacity(9 * reference.len());
    for row in 0..size.height as usize {
        let (begin, end) = (row * width, (row + 1) * width);
        rgb.extend(rendered[4 * begin..4 * end].chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]));
        rgb.extend(reference[begin..end].iter().flat_map(|color| color.map(to_byte)));
        rgb.extend(amplified[begin..end].iter().flat_map(|level| [*level; 3]));
    }
    encode_png(name, (3 * size.width, size.height), rgb)
}

/// Pixels between the images of a grid.
const GUTTER: usize = 8;

/// Encodes a grid of RGBA images of one size, with white gutters.
pub(super) fn encode_grid(name: &str, size: Size, columns: usize, images: &[Vec<u8>]) -> Result<ImageFile> {
    let (width, height) = (size.width as usize, size.height as usize);
    let grid_side = |count: usize, side: usize| count * side + count.saturating_sub(1) * GUTTER;
    let [grid_width, grid_height] = [grid_side(columns, width), grid_side(images.len().div_ceil(columns), height)];
    let mut rgb = vec![255; 3 * grid_width * grid_height];
    for (index, rgba) in images.iter().enumerate() {
        let (left, top) = (index % columns * (width + GUTTER), index / columns * (height + GUTTER));
        for (row, pixels) in rgba.chunks_exact(4 * width).enumerate() {
            let destination = &mut rgb[3 * ((top + row) * grid_width + left)..][..3 * width];
            for (rgb_pixel, rgba_pixel) in destination.chunks_exact_mut(3).zip(pixels.chunks_exact(4)) {
                rgb_pixel.copy_from_slice(&rgba_pixel[..3]);
            }
        }
    }
    encode_png(name, (grid_width as u32, grid_height as u32), rgb)
}

fn to_byte(level: f32) -> u8 {
    level.round().clamp(0.0, 255.0) as u8
}

fn encode_png(name: &str, (width, height): (u32, u32), rgb: Vec<u8>) -> Result<ImageFile> {
    let size_fault = || fault("pictures", "expected three bytes per pixel of the image");
    let image = image::RgbImage::from_raw(width, height, rgb).ok_or_else(size_fault)?;
    let mut png = std::io::Cursor::new(Vec::new());
    image::DynamicImage::from(image).write_to(&mut png, image::ImageFormat::Png).map_err(fault_in("pictures"))?;
    Ok(ImageFile { name: format!("{name}.png"), png: png.into_inner() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_has_images_in_rows_with_white_gutters() {
        let size = Size { width: 2, height: 1 };
        let images = [10, 20, 30].map(|level| [level, level, level, 255].repeat(2));
        let file = encode_grid("three", size, 2, &images).expect("a grid");
        let image = image::load_from_memory(&file.png).expect("a PNG").into_rgb8();
        // Two columns of 2 pixels and two rows of 1 pixel, with gutters of 8 pixels.
        assert_eq!(image.dimensions(), (2 * 2 + 8, 2 + 8));
        let level = |x, y| image.get_pixel(x, y).0[0];
        assert_eq!([level(0, 0), level(10, 0), level(1, 9), level(11, 9)], [10, 20, 30, 255]);
        assert_eq!([level(5, 0), level(0, 4)], [255, 255]);
    }
}
