//! Option types and helpers that several commands share.

use modalcast_model::error::{Result, invalid};

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
    let point = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    let finite = point.filter(|point| point.iter().all(|number| number.is_finite()));
    finite.ok_or_else(|| invalid("point", "three finite numbers X,Y,Z", text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_three_numbers_and_two_commas() {
        assert_eq!(parse_point("4, -1,.5"), Ok([4.0, -1.0, 0.5]));
        assert!(parse_point("1,2").is_err() && parse_point("a,b,c").is_err() && parse_point("0,nan,0").is_err());
    }
}
