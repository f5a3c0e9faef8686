//! Option types and helpers that several commands share.

use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// Runs `work`. Shows a spinner meanwhile if standard error is a terminal.
pub fn with_spinner<T>(message: &'static str, work: impl FnOnce() -> T) -> T {
    let spinner = indicatif::ProgressBar::new_spinner().with_message(message);
    spinner.enable_steady_tick(std::time::Duration::from_millis(120));
    let result = work();
    spinner.finish_and_clear();
    result
}

/// Lines with the remarks of a scene's loader, such as parts of the files that are not used.
pub fn remark_lines(scene: &Scene) -> impl Iterator<Item = String> {
    scene.remarks.iter().map(|remark| format!("remark: {remark}"))
}

/// Parses a point in the format X,Y,Z.
pub fn parse_point(text: &str) -> Result<[f64; 3]> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let point = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    let finite_point = point.filter(|point| point.iter().all(|number| number.is_finite()));
    finite_point.ok_or_else(|| invalid("point", "three finite numbers X,Y,Z", text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn point_has_three_finite_numbers() {
        assert_eq!(parse_point("4, -1,.5"), Ok([4.0, -1.0, 0.5]));
        assert!(parse_point("1,2").is_err() && parse_point("a,b,c").is_err() && parse_point("0,nan,0").is_err());
    }
}
