//! A small rectangle of an image's pixels.

use crate::error::{Result, invalid};

/// A rectangle inside an image, at most [`Self::MAX_SIDE`] pixels per side. (0, 0) is the top left pixel.
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

    /// The rectangle with the top left pixel `corner` in an image of the size `picture` (width, height).
    ///
    /// # Errors
    /// `Invalid` if a side is 0 or above [`Self::MAX_SIDE`], or if the rectangle exceeds the image.
    pub fn within(picture: [u32; 2], corner: [u32; 2], size: [u32; 2]) -> Result<Self> {
        let ([x, y], [width, height]) = (corner, size);
        if !size.iter().all(|side| (1..=Self::MAX_SIDE).contains(side)) {
            let expected = format!("1 to {} pixels a side", Self::MAX_SIDE);
            return Err(invalid("rectangle.size", expected, format!("{width} x {height}")));
        }
        let ends = |axis: usize| u64::from(corner[axis]) + u64::from(size[axis]);
        if (0..2).any(|axis| ends(axis) > u64::from(picture[axis])) {
            let expected = format!("pixels inside the picture of {} x {}", picture[0], picture[1]);
            return Err(invalid("rectangle", expected, format!("{width} x {height} from ({x}, {y}) on")));
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
    fn a_rectangle_up_to_the_border_is_taken_and_one_beyond_it_empty_or_too_large_is_refused() {
        let of = |corner, size| PixelRect::within([100, 80], corner, size).map_err(|error| error.to_string());
        for (corner, size) in [([0, 0], [1, 1]), ([99, 79], [1, 1]), ([36, 16], [64, 64])] {
            assert_eq!(of(corner, size).map(|taken| taken.size()), Ok(size));
        }
        for (corner, size, field) in [
            ([99, 79], [2, 1], "rectangle:"),
            ([0, 80], [1, 1], "rectangle:"),
            ([u32::MAX, 0], [1, 1], "rectangle:"),
            ([0, 0], [0, 1], "rectangle.size:"),
            ([0, 0], [1, 65], "rectangle.size:"),
        ] {
            let refusal = of(corner, size).expect_err(field);
            assert!(refusal.starts_with(field), "{refusal}");
        }
    }
}
