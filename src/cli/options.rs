//! Option types and helpers that several commands share.

use std::str::FromStr;

use modalcast_model::error::{Error, Result, invalid};

/// The size of an image in pixels, written as 1280x720.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    pub width: u32,
    pub height: u32,
}

impl FromStr for ImageSize {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let parse = || {
            let (width, height) = text.split_once('x')?;
            Some(Self { width: width.parse().ok()?, height: height.parse().ok()? })
        };
        parse().ok_or_else(|| invalid("size", "WIDTHxHEIGHT, such as 1280x720", text))
    }
}

impl std::fmt::Display for ImageSize {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "{}x{}", self.width, self.height)
    }
}

/// Runs `work` while a spinner is displayed; the spinner appears only on a terminal.
pub fn with_spinner<T>(what: &'static str, work: impl FnOnce() -> T) -> T {
    let spinner = indicatif::ProgressBar::new_spinner().with_message(what);
    spinner.enable_steady_tick(std::time::Duration::from_millis(120));
    let done = work();
    spinner.finish_and_clear();
    done
}

/// Parses a point written as X,Y,Z.
pub fn parse_point(text: &str) -> Result<[f64; 3]> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let parse_point = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    parse_point.ok_or_else(|| invalid("point", "three numbers X,Y,Z", text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_two_numbers_and_an_x() {
        assert_eq!("1280x720".parse::<ImageSize>(), Ok(ImageSize { width: 1280, height: 720 }));
        assert_eq!(parse_point("4, -1,.5"), Ok([4.0, -1.0, 0.5]));
        assert!(parse_point("1,2").is_err() && parse_point("a,b,c").is_err());
        for wrong in ["1280", "1280x", "x720", "1280x-1", "1280 x 720", "1x2x3"] {
            assert!(wrong.parse::<ImageSize>().is_err(), "{wrong}");
        }
    }
}
