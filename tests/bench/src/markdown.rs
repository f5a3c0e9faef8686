//! Formats a report as Markdown tables (`report.md`).

use super::markdown_table::{dash, table};
use super::table::DeformRow;
use super::{DeformReport, WorkloadSummary};
use crate::kernels::Overlap;

/// The complete report.
pub(super) fn markdown(report: &DeformReport) -> String {
    let mut text = format!("# Error against run time\n\n{}\n", report.provenance.line());
    let commit = report.provenance.commit.as_deref().unwrap_or("unknown");
    text.push_str(&format!("\nCommit {commit}; {} random states per load.\n", report.seeds));
    for remark in &report.remarks {
        text.push_str(&format!("\n{remark}\n"));
    }
    if !report.missing.is_empty() {
        text.push_str(&format!("\nNot measured yet: {}.\n", report.missing.join(", ")));
    }
    let failures = match report.failed.is_empty() {
        true => "\nEvery variant stays within its a-priori bound.\n".to_owned(),
        false => format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")),
    };
    text.push_str(&failures);
    for workload in &report.loads {
        text.push_str(&workload_section(workload, report.rows.iter().filter(|row| row.load == workload.name)));
    }
    text.push('\n');
    text.push_str(&report.thesis.markdown());
    text
}

/// Headings of the table of variants. "of ..." is a fraction: of the peak copy or read bandwidth, of the scene's
/// diagonal, or of the a-priori bound.
const COLUMNS: [&str; 13] = [
    "variant",
    "cache",
    "median us",
    "quartiles us",
    "bytes",
    "GB/s",
    "of copy",
    "of read",
    "largest error m",
    "of diagonal",
    "px",
    "of bound",
    "passed",
];

/// The section of a workload: its sizes, the table of its variants, and the overlap benchmark.
fn workload_section<'a>(workload: &WorkloadSummary, rows: impl Iterator<Item = &'a DeformRow>) -> String {
    let WorkloadSummary {
        name, vertices, corners, triangles, domains, coordinates, condition, steps, is_recorded, ..
    } = workload;
    let trajectory = if *is_recorded { "recorded" } else { "synthetic" };
    let mut text = format!(
        "\n## {name}\n\n{vertices} vertices, {corners} corners, {triangles} triangles, {domains} domains, \
         {coordinates} coordinates; {steps} {trajectory} steps; sum \\|U q\\| / \\|u\\|: median {:.3e}, largest {:.3e}.\n",
        condition.median, condition.largest
    );
    if !workload.remarks.is_empty() {
        text.push_str(&format!("\n- {}\n", workload.remarks.join("\n- ")));
    }
    text.push('\n');
    text.push_str(&table(&COLUMNS, rows.map(row_cells)));
    if let Some(overlap) = &workload.overlap {
        text.push_str(&overlap_paragraph(overlap));
    }
    text
}

/// The times per step when the host reads every step back.
fn overlap_paragraph(overlap: &Overlap) -> String {
    let Overlap { write_one_core_us, write_us, cores, graph_us, copy_out_us, step_us, .. } = overlap;
    let Overlap { serial_us, pipelined_us, overlapped_us, gain, ideal_us, differing, .. } = overlap;
    format!(
        "\nThe host reads every step. Microseconds per step: {serial_us:.1} serially, {pipelined_us:.1} with the readback during \
         the next step, {overlapped_us:.1} with two steps in flight ({gain:.2} times as fast as serially). The lower \
         limit is {ideal_us:.1}, the longest part alone. Parts: host write {write_us:.1} on {cores} cores ({write_one_core_us:.1} on one), \
         upload and kernels {graph_us:.1}, readback {copy_out_us:.1}; a step without readback {step_us:.1}. Steps that \
         differ in a bit: {differing}.\n"
    )
}

/// The cells of a row, in the order of [`COLUMNS`].
fn row_cells(row: &DeformRow) -> [String; 13] {
    let format_number = |value: Option<f64>| value.map_or_else(dash, |value| format!("{value:.3}"));
    let format_small_number = |value: Option<f64>| value.map_or_else(dash, |value| format!("{value:.2e}"));
    let errors = row.validation.as_ref().map(|validation| validation.errors);
    [
        row.name.clone(),
        row.cache.name().into(),
        format_number(row.timing.map(|timing| timing.median_us)),
        row.timing.map_or_else(dash, |timing| format!("{:.3} to {:.3}", timing.q1_us, timing.q3_us)),
        row.bytes.to_string(),
        format_number(row.gbs),
        format_number(row.of_copy),
        format_number(row.of_read),
        format_small_number(errors.map(|errors| errors.meters.largest)),
        format_small_number(errors.map(|errors| errors.of_diagonal.largest)),
        format_small_number(errors.and_then(|errors| Some(errors.pixels?.largest))),
        format_number(errors.map(|errors| errors.of_bound)),
        match (row.passed, row.is_skipped) {
            (true, _) => "yes".into(),
            (false, true) => format!("skipped: {}", row.faults.join("; ")),
            (false, false) => format!("no: {}", row.faults.join("; ")),
        },
    ]
}
