//! Formats a report as Markdown tables (`report.md`).

use super::{RenderReport, RenderRow, RenderWorkloadSummary, ShadowTexelSize, comparison_tables};
use crate::markdown_table::{dash, table};
use modalcast_render::CullStats;

/// The whole page.
pub(super) fn markdown(report: &RenderReport) -> String {
    let (provenance, size) = (&report.provenance, report.size);
    let mut text = format!("# Rendering: error against run time\n\n{}\n", provenance.line());
    let commit = provenance.commit.as_deref().unwrap_or("unknown");
    text.push_str(&format!(
        "\n{}; {} x {} pixels. Commit {commit}.\n\n",
        report.renderer.renderer, size.width, size.height
    ));
    text.push_str(EXPLANATION);
    let bounds = report.bounds;
    text.push_str(&match report.failed.is_empty() {
        true => format!(
            "\nEvery variant is within its bounds against its intended result: mean color error {} of 255, mean sun \
             visibility error {}; mean sun visibility {} in the umbra (rows may have a lower bound); {} lost outside of shadows. \
             that are stated to fail do.\n",
            bounds.mean_color, bounds.mean_light, bounds.bleeding, bounds.lost
        ),
        false => format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")),
    });
    for load in &report.loads {
        text.push_str(&load_section(load, report.rows.iter().filter(|row| row.load == load.name)));
    }
    text.push_str(&super::readback::readback_section(&report.readback));
    text + &comparison_tables::markdown(report)
}

const EXPLANATION: &str = "Colors are compared in sRGB, of 255, by the largest difference of the three channels: \
against hard shadow rays, and against the intended result (no shadow, or the hard shadow filtered by the blur's \
footprint). Light is the sun visibility, compared with the same two references. Bleeding is the mean sun visibility \
in the umbra of the filtered reference. Flicker is the change of the error from step to step. `frame` is all passes \
except the readback. Of the triangles tested by culling for the camera, `listed` are passed to the rasterizer, and \
behind what the last frame saw.\n";

const HEAD: [&str; 25] = [
    "variant",
    "frame us",
    "quartiles us",
    "shadow us",
    "of it blur us",
    "draw us",
    "of it cull us",
    "visibility us",
    "blended us",
    "shade us",
    "bloom us",
    "encode us",
    "triangles listed",
    "hidden",
    "MB",
    "shadow MB",
    "colour mean",
    "p99",
    "largest",
    "colour of aim mean",
    "light of aim mean",
    "penumbra",
    "bleeding",
    "flicker mean",
    "passed",
];

fn load_section<'a>(load: &RenderWorkloadSummary, rows: impl Iterator<Item = &'a RenderRow>) -> String {
    let RenderWorkloadSummary {
        name, vertices, triangles, domains, samples, taps, reference_ms, steps, texels, ..
    } = load;
    let mut text = format!(
        "\n## {name}\n\n{vertices} vertices, {triangles} triangles, {domains} domains. References: {samples} samples a \
         pixel, {taps} rays each over a footprint, {:.1} s; {}.{}\n\n",
        reference_ms / 1e3,
        load.no_flicker
            .as_ref()
            .map_or_else(|| format!("flicker over {steps} steps"), |reason| format!("no flicker: {reason}")),
        texels.map_or_else(String::new, |ShadowTexelSize { size, side, by_corners }| format!(
            " A texel of a map of {size} is {side:.5} long, {by_corners:.5} if it were fitted to the corners of the bounds."
        ))
    );
    text.push_str(&table(&HEAD, rows.map(row_cells)));
    text
}

fn row_cells(row: &RenderRow) -> [String; 25] {
    let timing = |name: &str| row.passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
    let median = |name: &str| timing(name).map_or_else(dash, |timing| format!("{:.1}", timing.median_us));
    let four_decimals = |value: f64| format!("{value:.4}");
    let count = |field: fn(&CullStats) -> u32| row.culled.map_or_else(dash, |culled| field(&culled.camera).to_string());
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
        count(|camera| camera.visible),
        count(|camera| camera.occluded),
        megabytes(row.bytes),
        megabytes(row.shadow_bytes),
        format!("{:.3}", row.color.mean),
        format!("{:.1}", row.color.p99),
        format!("{:.1}", row.color.largest),
        format!("{:.3}", row.color_of_reference.mean),
        four_decimals(row.light_of_aim.all.mean),
        four_decimals(row.light_of_aim.penumbra.mean),
        row.light_of_aim.in_umbra.map_or_else(dash, four_decimals),
        match (row.flicker, &row.no_flicker) {
            (Some(flicker), _) => format!("{:.3}", flicker.mean),
            (None, Some(reason)) => format!("skipped: {reason}"),
            (None, None) => dash(),
        },
        match (row.passed, row.to_fail) {
            (true, _) => "yes".into(),
            (false, true) => format!("no, as expected: {}", row.faults.join("; ")),
            (false, false) => format!("no: {}", row.faults.join("; ")),
        },
    ]
}
