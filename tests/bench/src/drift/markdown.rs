//! Formats a report as Markdown (`report.md`).

use super::{DriftReport, DriftResult};
use crate::markdown_table::table;

/// How the numbers are defined.
const NOTE: &str = "Errors are the largest ones of up to 100 consecutive steps, over all vertices. `position` is the \
distance from the exact motion in f64. `deformer` is the distance from f64 positions for the same rounded state. \
`path` is the distance from a server that has received only this step. Growth is the largest error of later steps \
divided by that of the first 100 steps. A step is rejected if the scene declares rigid transforms.";

/// The complete report.
pub(super) fn markdown(report: &DriftReport) -> String {
    let commit = report.provenance.commit.as_deref().unwrap_or("unknown");
    let (machine, command) = (report.provenance.line(), report.provenance.command.join(" "));
    let failures = match report.failed.is_empty() {
        true => String::new(),
        false => format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")),
    };
    let summaries: Vec<String> = report.cases.iter().map(DriftResult::summary).collect();
    let head = ["case", "steps", "position m", "deformer m", "path m", "det A - 1", "A^T A - I"];
    format!(
        "# Drift over {} steps\n\n{machine}\n\nCommit {commit}. Command: `{command}`\n{failures}\n- {}\n\n{NOTE}\n\n{}",
        report.steps,
        summaries.join("\n- "),
        table(&head, report.cases.iter().flat_map(window_rows))
    )
}

fn window_rows(case: &DriftResult) -> impl Iterator<Item = Vec<String>> {
    case.windows.iter().map(|window| {
        let errors = &window.errors;
        let meters = [errors.position_meters, errors.deformer_meters, errors.path_meters];
        let numbers = meters.into_iter().chain([errors.determinant, errors.orthogonality]);
        let steps = format!("{} to {}", window.first_step, window.last_step);
        [case.name.into(), steps].into_iter().chain(numbers.map(|number| format!("{number:.2e}"))).collect()
    })
}
