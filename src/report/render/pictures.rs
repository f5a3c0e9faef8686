//! Pictures to look at: PNG files of references, and strips of rendered, reference and difference.

use super::metrics::differences;
use super::studio::Size;
use crate::error::{Result, during};

/// A file below `pictures/`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct File {
    /// With its ending.
    pub name: String,
    pub png: Vec<u8>,
}

/// Differences are shown this many times as large.
const LOUD: f32 = 4.0;

/// A reference.
pub(super) fn picture(name: &str, size: Size, colours: &[[f32; 3]]) -> Result<File> {
    let rgb = colours.iter().flat_map(|colour| colour.map(byte)).collect();
    encode(name, (size.width, size.height), rgb)
}

/// Rendered, reference and difference (four times as large, on black) side by side.
pub(super) fn strip(name: &str, size: Size, (rendered, reference): (&[u8], &[[f32; 3]])) -> Result<File> {
    let width = size.width as usize;
    let loud: Vec<u8> = differences(rendered, reference).map(|difference| byte(LOUD * difference)).collect();
    let mut rgb = Vec::with_capacity(9 * reference.len());
    for row in 0..size.height as usize {
        let (first, last) = (row * width, (row + 1) * width);
        rgb.extend(rendered[4 * first..4 * last].chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]));
        rgb.extend(reference[first..last].iter().flat_map(|colour| colour.map(byte)));
        rgb.extend(loud[first..last].iter().flat_map(|level| [*level; 3]));
    }
    encode(name, (3 * size.width, size.height), rgb)
}

fn byte(level: f32) -> u8 {
    level.round().clamp(0.0, 255.0) as u8
}

fn encode(name: &str, (width, height): (u32, u32), rgb: Vec<u8>) -> Result<File> {
    let fault = || during("pictures")("pixels do not fill the picture");
    let image = image::RgbImage::from_raw(width, height, rgb).ok_or_else(fault)?;
    let mut png = std::io::Cursor::new(Vec::new());
    image::DynamicImage::from(image).write_to(&mut png, image::ImageFormat::Png).map_err(during("pictures"))?;
    Ok(File { name: format!("{name}.png"), png: png.into_inner() })
}
