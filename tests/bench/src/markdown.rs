//! Formats a report as Markdown tables (`report.md`).

use super::cuda_variants::{TRIANGLE_VERTICES, is_partial_step};
use super::markdown_table::{dash, table};
use super::recommendation;
use super::table::DeformRow;
use super::{DeformReport, WorkloadSummary};
use crate::kernels::Overlap;

/// The complete report.
pub(super) fn markdown(report: &DeformReport) -> String {
    let mut text = format!("# Error against run time\n\n{}\n", report.provenance.line());
    let commit = report.provenance.commit.as_deref().unwrap_or("unknown");
    text.push_str(&format!("\nCommit {commit}; at most {} random states per load.\n", report.seeds));
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
        let rows: Vec<&DeformRow> = report.rows.iter().filter(|row| row.load == workload.name).collect();
        text.push_str(&workload_section(workload, &rows));
    }
    text.push_str(&report.thesis.markdown());
    let recommendations =
        report.loads.iter().map(|workload| (workload.name.as_str(), workload.recommendations.as_slice()));
    text.push_str(&recommendation::markdown(recommendations));
    text
}

/// Headings of the table of variants. "of ..." is a fraction: of the peak copy or read bandwidth, of the scene's
/// diagonal, or of the a-priori bound. "time of f32" is the time divided by that of the same work with all modes in f32.
/// A column without values is omitted.
const COLUMNS: [&str; 15] = [
    "variant",
    "cache",
    "median us",
    "quartiles us",
    "time of f32",
    "bytes",
    "GB/s",
    "of copy",
    "of read",
    "largest error m",
    "of diagonal",
    "px",
    "normals deg",
    "of bound",
    "passed",
];

/// The section of a workload: its sizes, the table of its variants, and the overlap benchmark.
fn workload_section(workload: &WorkloadSummary, rows: &[&DeformRow]) -> String {
    let WorkloadSummary {
        name, vertices, corners, triangles, domains, coordinates, condition, steps, is_recorded, ..
    } = workload;
    let trajectory = if *is_recorded { "recorded" } else { "synthetic" };
    let states = rows.iter().filter_map(|row| Some(row.validation.as_ref()?.errors.states)).max().unwrap_or(0);
    let mut text = format!(
        "\n## {name}\n\n{vertices} vertices, {corners} corners, {triangles} triangles, {domains} domains, \
         {coordinates} coordinates; {steps} {trajectory} steps; {states} validated states; sum \\|U q\\| / \\|u\\|: median {:.3e}, largest {:.3e}.\n",
        condition.median, condition.largest
    );
    if !workload.remarks.is_empty() {
        text.push_str(&format!("\n- {}\n", workload.remarks.join("\n- ")));
    }
    text.push('\n');
    text.push_str(&variants_table(rows));
    if let Some(overlap) = &workload.overlap {
        text.push_str(&overlap_paragraph(overlap));
    }
    text
}

/// The table of variants, without the columns that have no value, and an explanation of a name.
fn variants_table(rows: &[&DeformRow]) -> String {
    let cells: Vec<[String; 15]> = rows.iter().map(|row| row_cells(row, rows)).collect();
    let columns: Vec<usize> =
        (0..COLUMNS.len()).filter(|column| cells.iter().any(|row| row[*column] != dash())).collect();
    let head: Vec<&str> = columns.iter().map(|column| COLUMNS[*column]).collect();
    let select = |row: &[String; 15]| columns.iter().map(|column| row[*column].clone()).collect::<Vec<String>>();
    let mut text = table(&head, cells.iter().map(select));
    if rows.iter().any(|row| row.name.ends_with(TRIANGLE_VERTICES)) {
        text.push_str(
            "\nA variant of `triangle vertices` computes only the vertices that triangles refer to. Its errors are those \
             of these vertices.\n",
        );
    }
    text
}

/// The time divided by that of the variant that does the same work with all modes in f32, and whether the quartiles of
/// both overlap. A dash for a row without such a variant, and for that variant itself.
fn relative_time(row: &DeformRow, rows: &[&DeformRow]) -> String {
    let Some(name) = exact_variant(&row.name).filter(|name| *name != row.name) else { return dash() };
    let exact = rows.iter().find(|other| other.name == name && other.cache == row.cache);
    let Some((value, exact)) = row.time_and_error().zip(exact.and_then(|exact| exact.time_and_error())) else {
        return dash();
    };
    let note = if value.has_time_of(&exact) { " (within noise)" } else { "" };
    format!("{:.3}{note}", value.time_us / exact.time_us)
}

/// Name of the variant that does the same work as this one with all modes in f32; `None` for kernels of the thesis, of
/// cuBLAS and of the reference.
fn exact_variant(name: &str) -> Option<String> {
    if name.starts_with("cpu ") {
        return Some("cpu f32".into());
    }
    if !name.starts_with("cuda ") {
        return None;
    }
    let kind = [" step", " positions"].into_iter().find(|kind| name.contains(kind)).unwrap_or_default();
    // u = U q alone, and steps that change few domains, are other work.
    (!is_partial_step(name) && !name.starts_with("cuda batch")).then(|| format!("cuda f32{kind}"))
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
fn row_cells(row: &DeformRow, rows: &[&DeformRow]) -> [String; 15] {
    let format_number = |value: Option<f64>| value.map_or_else(dash, |value| format!("{value:.3}"));
    let format_small_number = |value: Option<f64>| value.map_or_else(dash, |value| format!("{value:.2e}"));
    let errors = row.validation.as_ref().map(|validation| validation.errors);
    // Against the deformed surface where that was measured, because rigid normals define their own error away.
    let normals = row.validation.as_ref().and_then(|validation| {
        validation.orientation.normals_to_surface_degrees.or(validation.orientation.normals_degrees)
    });
    [
        row.name.clone(),
        row.cache.name().into(),
        format_number(row.timing.map(|timing| timing.median_us)),
        row.timing.map_or_else(dash, |timing| format!("{:.3} to {:.3}", timing.q1_us, timing.q3_us)),
        relative_time(row, rows),
        row.bytes.to_string(),
        format_number(row.gbs),
        format_number(row.of_copy),
        format_number(row.of_read),
        format_small_number(errors.map(|errors| errors.meters.largest)),
        format_small_number(errors.map(|errors| errors.of_diagonal.largest)),
        format_small_number(errors.and_then(|errors| Some(errors.pixels?.largest))),
        format_small_number(normals.map(|normals| normals.largest)),
        format_number(errors.map(|errors| errors.of_bound)),
        match (row.passed, row.is_skipped) {
            (true, _) => "yes".into(),
            (false, true) => format!("skipped: {}", row.faults.join("; ")),
            (false, false) => format!("no: {}", row.faults.join("; ")),
        },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::tests::row;
    use crate::timing::CacheState;

    #[test]
    fn marks_times_within_noise_and_omits_columns_without_values() {
        let mut noisy = row("a", "cpu f32 compensated", CacheState::Warm, (101.0, 1e-7));
        if let Some(timing) = &mut noisy.timing {
            (timing.q1_us, timing.q3_us) = (99.0, 103.0);
        }
        let rows = [
            row("a", "cpu f32", CacheState::Warm, (100.0, 1e-7)),
            noisy,
            row("a", "cpu f16", CacheState::Warm, (50.0, 1e-5)),
        ];
        let text = variants_table(&rows.iter().collect::<Vec<_>>());
        assert!(text.contains("| 1.010 (within noise) |") && text.contains("| 0.500 |"), "{text}");
        // These rows have neither pixel errors nor bandwidths of a machine.
        assert!(!text.contains("px") && !text.contains("of copy"), "{text}");
        assert!(variants_table(&rows.iter().take(1).collect::<Vec<_>>()).lines().all(|line| !line.contains("| - |")));
        let partial = row("a", "thesis 2 kernels, triangle vertices", CacheState::Warm, (10.0, 1e-7));
        assert!(!text.contains("triangles") && variants_table(&[&partial]).contains("triangles refer to"));
    }

    #[test]
    fn compares_a_variant_with_the_same_work_in_f32() {
        for (name, expected) in [
            ("cuda int8 step", Some("cuda f32 step")),
            ("cuda f32 step, exact normals", Some("cuda f32 step")),
            ("cuda f16 positions", Some("cuda f32 positions")),
            ("cuda f16", Some("cuda f32")),
            ("cpu f32 compensated", Some("cpu f32")),
            ("cuda f32 positions, 1 % changed", None),
            ("cuda f32 Uq", None),
            ("thesis single", None),
        ] {
            assert_eq!(exact_variant(name).as_deref(), expected, "{name}");
        }
    }
}
