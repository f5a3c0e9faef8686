//! Formats a report as Markdown tables (`report.md`).

use super::{DefaultShadow, RenderReport, RenderRow, RenderWorkloadSummary, ShadowTexelSize, comparison_tables};
use crate::markdown_table::{dash, table};
use modalcast_render::CullStats;

/// Formats the report.
pub(super) fn markdown(report: &RenderReport) -> String {
    let (provenance, size) = (&report.provenance, report.size);
    let mut text = format!("# Rendering: error against run time\n\n{}\n", provenance.line());
    let commit = provenance.commit.as_deref().unwrap_or("unknown");
    text.push_str(&format!(
        "\n{}; {} x {} pixels. Commit {commit}.\n\n",
        report.renderer.renderer, size.width, size.height
    ));
    text.push_str(EXPLANATION);
    if !report.missing.is_empty() {
        text.push_str(&format!("\nNot measured yet: {}.\n", report.missing.join(", ")));
    }
    text.push_str(&match report.failed.is_empty() {
        true => {
            "\nEvery variant is within its error limits against its intended result, except for the variants that are \
                 expected to exceed them. The limits depend on the scene; `error_limits` in `report.json` are those of each row.\n"
                .to_owned()
        }
        false => format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")),
    });
    for workload in &report.loads {
        let rows = report.rows.iter().filter(|row| row.load == workload.name);
        text.push_str(&workload_section(workload, rows));
    }
    text.push_str(&super::readback::readback_section(&report.readback));
    text.push_str(&comparison_tables::markdown(report));
    let lines = report.default_shadow.iter().flat_map(DefaultShadow::lines);
    let default_section = lines.map(|line| format!("    {line}\n")).collect::<String>();
    if default_section.is_empty() { text } else { text + "\n## Default shadow map\n\n" + &default_section }
}

/// Meaning of the columns of [`HEADER`].
const EXPLANATION: &str = "Color errors are the largest difference of the three sRGB channels, 0 to 255. `color` \
columns compare with hard shadow rays, `intended color` with the intended result of the variant: no shadow, a hard \
shadow, or the hard shadow filtered by the blur's footprint. `intended light`, `penumbra` and `bleeding` compare the \
sun visibility with the intended result; `bleeding` is the mean sun visibility in the umbra, `leak` the largest sun \
visibility above the intended one. `flicker` is the change \
of the color error from step to step. `frame` is the time of all passes except the readback. `encode` converts linear \
colors to sRGB bytes. Culling passes the `listed` triangles to the rasterizer; `hidden` triangles are occluded by the \
triangles that were visible in the last frame.\n";

const HEADER: [&str; 26] = [
    "variant",
    "frame us",
    "quartiles us",
    "shadow us",
    "of which blur us",
    "draw us",
    "of which cull us",
    "visibility us",
    "blended us",
    "shade us",
    "bloom us",
    "encode us",
    "triangles listed",
    "hidden",
    "MB",
    "shadow MB",
    "color mean",
    "p99",
    "largest",
    "intended color mean",
    "intended light mean",
    "penumbra",
    "bleeding",
    "leak",
    "flicker mean",
    "passed",
];

fn workload_section<'a>(workload: &RenderWorkloadSummary, rows: impl Iterator<Item = &'a RenderRow>) -> String {
    let RenderWorkloadSummary {
        name,
        vertices,
        triangles,
        domains,
        samples,
        taps,
        reference_ms,
        steps,
        texel_size,
        ..
    } = workload;
    let mut text = format!(
        "\n## {name}\n\n{vertices} vertices, {triangles} triangles, {domains} domains. References: {samples} samples per \
         pixel, {taps} rays per sample of a filtered shadow, {:.1} s; {}.{}\n\n",
        reference_ms / 1e3,
        workload.flicker_skip_reason
            .as_ref()
            .map_or_else(|| format!("flicker over {steps} steps"), |reason| format!("no flicker: {reason}")),
        texel_size.map_or_else(String::new, |ShadowTexelSize { map_size, vertex_fit_side, corner_fit_side }| format!(
            " A texel of the shadow map of {map_size} is {vertex_fit_side:.5} long; if the map were fitted to the corners \
             of the bounding box, it would be {corner_fit_side:.5} long."
        ))
    );
    text.push_str(&table(&HEADER, rows.map(row_cells)));
    text
}

fn row_cells(row: &RenderRow) -> [String; 26] {
    let timing = |name: &str| row.passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
    let median = |name: &str| timing(name).map_or_else(dash, |timing| format!("{:.1}", timing.median_us));
    let format_four_decimals = |value: f64| format!("{value:.4}");
    let culling_count =
        |field: fn(&CullStats) -> u32| row.cull_stats.map_or_else(dash, |stats| field(&stats.camera).to_string());
    let megabytes = |bytes: u64| format!("{:.1}", bytes as f64 / 1e6);
    [
        row.name.clone(),
        median("frame"),
        timing("frame").map_or_else(dash, |timing| format!("{:.1} to {:.1}", timing.q1_us, timing.q3_us)),
        median("shadow"),
        median("blur"),
        median("draw"),
        median("cull"),
        median("visibility"),
        median("blended"),
        median("shade"),
        median("bloom"),
        median("encode"),
        culling_count(|camera| camera.visible),
        culling_count(|camera| camera.occluded),
        megabytes(row.bytes),
        megabytes(row.shadow_bytes),
        format!("{:.3}", row.color_errors.mean),
        format!("{:.1}", row.color_errors.p99),
        format!("{:.1}", row.color_errors.max),
        format!("{:.3}", row.intended_color_errors.mean),
        format_four_decimals(row.intended_light_errors.all_pixels.mean),
        format_four_decimals(row.intended_light_errors.penumbra.mean),
        row.intended_light_errors.umbra_visibility.map_or_else(dash, format_four_decimals),
        format_four_decimals(row.intended_light_errors.max_leak),
        match (row.flicker, &row.flicker_skip_reason) {
            (Some(flicker), _) => format!("{:.3}", flicker.mean),
            (None, Some(reason)) => format!("skipped: {reason}"),
            (None, None) => dash(),
        },
        match (row.passed, row.is_expected_to_fail) {
            (true, _) => "yes".into(),
            (false, true) => format!("no, as expected: {}", row.faults.join("; ")),
            (false, false) => format!("no: {}", row.faults.join("; ")),
        },
    ]
}
