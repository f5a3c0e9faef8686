//! The size of a frame, and its text format.

use std::fmt;
use std::str::FromStr;

use crate::error::{Error, Result, invalid};

/// Width and height of a frame in pixels. Any value is valid here, because each renderer has its own limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameSize {
    pub width: u32,
    pub height: u32,
}

impl FrameSize {
    /// A size of `width` by `height` pixels.
    pub const fn new(width: u32, height: u32) -> Self {
        Self { width, height }
    }

    /// Width and height as an array.
    pub const fn to_array(self) -> [u32; 2] {
        [self.width, self.height]
    }
}

/// Parses `WIDTHxHEIGHT`, such as `1280x720`.
impl FromStr for FrameSize {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let parse = || {
            let (width, height) = text.split_once('x')?;
            Some(Self { width: width.parse().ok()?, height: height.parse().ok()? })
        };
        parse().ok_or_else(|| invalid("size", "WIDTHxHEIGHT, such as 1280x720", text))
    }
}

impl fmt::Display for FrameSize {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}x{}", self.width, self.height)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_two_numbers_separated_by_an_x() {
        assert_eq!("1280x720".parse::<FrameSize>(), Ok(FrameSize::new(1280, 720)));
        assert_eq!(FrameSize::new(1280, 720).to_string(), "1280x720");
        for text in ["1280", "1280x", "x720", "1280x-1", "1280 x 720", "1x2x3"] {
            assert!(text.parse::<FrameSize>().is_err(), "expected {text} to be rejected");
        }
    }
}
