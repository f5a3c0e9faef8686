//! A small rectangle of pixels inside an image.

use crate::error::{Result, invalid};

/// A rectangle of pixels inside an image, at most [`Self::MAX_SIDE`] pixels per side. (0, 0) is the top left pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PixelRect {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

impl PixelRect {
    /// The largest width and height in pixels.
    pub const MAX_SIDE: u32 = 64;

    /// The rectangle of `size` whose top left pixel is `corner`. `image` and `size` are (width, height) in pixels.
    ///
    /// # Errors
    /// `Invalid` if a side is 0 or above [`Self::MAX_SIDE`], or if the rectangle exceeds the image.
    pub fn within(image: [u32; 2], corner: [u32; 2], size: [u32; 2]) -> Result<Self> {
        let ([x, y], [width, height]) = (corner, size);
        if !size.iter().all(|side| (1..=Self::MAX_SIDE).contains(side)) {
            let expected = format!("1 to {} pixels a side", Self::MAX_SIDE);
            return Err(invalid("width", expected, format!("{width} x {height}")));
        }
        let end = |axis: usize| u64::from(corner[axis]) + u64::from(size[axis]);
        if (0..2).any(|axis| end(axis) > u64::from(image[axis])) {
            let expected = format!("pixels inside the image of {} x {}", image[0], image[1]);
            return Err(invalid("x", expected, format!("{width} x {height} pixels at ({x}, {y})")));
        }
        Ok(Self { x, y, width, height })
    }

    /// Column of the leftmost pixels.
    pub const fn x(&self) -> u32 {
        self.x
    }

    /// Row of the topmost pixels.
    pub const fn y(&self) -> u32 {
        self.y
    }

    /// Width and height in pixels.
    pub const fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangle_is_limited_to_the_image_and_64_pixels_a_side() {
        let create = |corner, size| PixelRect::within([100, 80], corner, size).map_err(|error| error.to_string());
        for (corner, size) in [([0, 0], [1, 1]), ([99, 79], [1, 1]), ([36, 16], [64, 64])] {
            assert_eq!(create(corner, size).map(|rect| rect.size()), Ok(size));
        }
        for (corner, size, field) in [
            ([99, 79], [2, 1], "x:"),
            ([0, 80], [1, 1], "x:"),
            ([u32::MAX, 0], [1, 1], "x:"),
            ([0, 0], [0, 1], "width:"),
            ([0, 0], [1, 65], "width:"),
        ] {
            let message = create(corner, size).expect_err(field);
            assert!(message.starts_with(field), "expected an error about {field}, got {message}");
        }
    }
}
