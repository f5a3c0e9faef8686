//! Encodes pictures for viewing: references, strips of rendered, reference and difference image, and sheets.

use super::harness::Size;
use super::metrics::differences;
use modalcast_model::error::{Result, fault_in};

/// An encoded picture file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageFile {
    /// File name with extension.
    pub name: String,
    pub png: Vec<u8>,
}

/// Amplification of differences.
const LOUD: f32 = 4.0;

/// A reference picture. `colors`: sRGB of 255, top row first.
pub(super) fn picture(name: &str, size: Size, colors: &[[f32; 3]]) -> Result<ImageFile> {
    let rgb = colors.iter().flat_map(|color| color.map(byte)).collect();
    encode(name, (size.width, size.height), rgb)
}

/// Rendered, reference and difference image (amplified by [`LOUD`], on black) side by side.
pub(super) fn strip(name: &str, size: Size, (rendered, reference): (&[u8], &[[f32; 3]])) -> Result<ImageFile> {
    let width = size.width as usize;
    let loud: Vec<u8> = differences(rendered, reference).map(|difference| byte(LOUD * difference)).collect();
    let mut rgb = Vec::with_capacity(9 * reference.len());
    for row in 0..size.height as usize {
        let (first, last) = (row * width, (row + 1) * width);
        rgb.extend(rendered[4 * first..4 * last].chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]));
        rgb.extend(reference[first..last].iter().flat_map(|color| color.map(byte)));
        rgb.extend(loud[first..last].iter().flat_map(|level| [*level; 3]));
    }
    encode(name, (3 * size.width, size.height), rgb)
}

/// Pixels between the pictures of a sheet.
const GUTTER: usize = 8;

/// RGBA pictures of one size in rows of `columns` with white between them.
pub(super) fn sheet(name: &str, size: Size, columns: usize, drawn: &[Vec<u8>]) -> Result<ImageFile> {
    let (width, height) = (size.width as usize, size.height as usize);
    let along = |count: usize, side: usize| count * side + count.saturating_sub(1) * GUTTER;
    let [wide, tall] = [along(columns, width), along(drawn.len().div_ceil(columns), height)];
    let mut rgb = vec![255; 3 * wide * tall];
    for (index, rgba) in drawn.iter().enumerate() {
        let (left, top) = (index % columns * (width + GUTTER), index / columns * (height + GUTTER));
        for (row, pixels) in rgba.chunks_exact(4 * width).enumerate() {
            let into = &mut rgb[3 * ((top + row) * wide + left)..][..3 * width];
            for (to, from) in into.chunks_exact_mut(3).zip(pixels.chunks_exact(4)) {
                to.copy_from_slice(&from[..3]);
            }
        }
    }
    encode(name, (wide as u32, tall as u32), rgb)
}

fn byte(level: f32) -> u8 {
    level.round().clamp(0.0, 255.0) as u8
}

fn encode(name: &str, (width, height): (u32, u32), rgb: Vec<u8>) -> Result<ImageFile> {
    let fault = || fault_in("pictures")("pixels do not fill the picture");
    let image = image::RgbImage::from_raw(width, height, rgb).ok_or_else(fault)?;
    let mut png = std::io::Cursor::new(Vec::new());
    image::DynamicImage::from(image).write_to(&mut png, image::ImageFormat::Png).map_err(fault_in("pictures"))?;
    Ok(ImageFile { name: format!("{name}.png"), png: png.into_inner() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sheet_has_pictures_in_rows_with_white_gutters() {
        let size = Size { width: 2, height: 1 };
        let drawn = [10, 20, 30].map(|level| [level, level, level, 255].repeat(2));
        let file = sheet("three", size, 2, &drawn).expect("made");
        let image = image::load_from_memory(&file.png).expect("reads").into_rgb8();
        assert_eq!(image.dimensions(), (2 * 2 + 8, 2 + 8));
        let at = |x, y| image.get_pixel(x, y).0[0];
        assert_eq!([at(0, 0), at(10, 0), at(1, 9), at(11, 9)], [10, 20, 30, 255]);
        assert_eq!([at(5, 0), at(0, 4)], [255, 255]);
    }
}
