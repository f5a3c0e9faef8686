//! Formats a report as Markdown tables (`report.md`).

use super::{RenderReport, RenderRow, RenderWorkloadSummary, ShadowTexelSize, comparison_tables};
use crate::markdown_table::{dash, table};
use modalcast_render::CullStats;

/// The whole page.
pub(super) fn markdown(report: &RenderReport) -> String {
    let (made, size) = (&report.made, report.size);
    let mut text = format!("# Rendering: error against run time\n\n{}\n", made.line());
    let commit = made.commit.as_deref().unwrap_or("unknown");
    text.push_str(&format!(
        "\n{}; {} x {} pixels. Commit {commit}.\n\n",
        report.renderer.renderer, size.width, size.height
    ));
    text.push_str(EXPLAINED);
    let bounds = report.bounds;
    text.push_str(&match report.failed.is_empty() {
        true => format!(
            "\nEvery variant stays within its bounds against what it means to show: a mean error of colour of {} of 255, \
             of light of {}; {} of light in the umbra, and less where its row says so; {} lost outside of shadows. Those \
             that are stated to fail do.\n",
            bounds.mean_color, bounds.mean_light, bounds.bleeding, bounds.lost
        ),
        false => format!("\nFailed:\n\n- {}\n", report.failed.join("\n- ")),
    });
    for load in &report.loads {
        text.push_str(&section(load, report.rows.iter().filter(|row| row.load == load.name)));
    }
    text.push_str(&super::readback::section(&report.readback));
    text + &comparison_tables::markdown(report)
}

const EXPLAINED: &str = "Colours are compared as a display shows them, of 255, the largest difference of three channels: \
against hard shadow rays, and against what the variant means to show (no shadow, or the hard shadow under the blur's own \
footprint). Light is the share of the unshadowed sunlight that arrives, against the same two. Bleeding is the mean light \
where the filtered reference has none. Flicker is the change of the error from step to step. `frame` is all passes but \
reading back. Of the triangles that culling looks at for the camera, `listed` are left to the rasteriser and `hidden` lie \
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

fn section<'a>(load: &RenderWorkloadSummary, rows: impl Iterator<Item = &'a RenderRow>) -> String {
    let RenderWorkloadSummary {
        name, vertices, triangles, domains, samples, taps, reference_ms, steps, texels, ..
    } = load;
    let mut text = format!(
        "\n## {name}\n\n{vertices} vertices, {triangles} triangles, {domains} domains. References: {samples} samples a \
         pixel, {taps} rays each over a footprint, {:.1} s; {}.{}\n\n",
        reference_ms / 1e3,
        load.no_flicker
            .as_ref()
            .map_or_else(|| format!("flicker over {steps} steps"), |why| format!("no flicker: {why}")),
        texels.map_or_else(String::new, |ShadowTexelSize { size, side, by_corners }| format!(
            " A texel of a map of {size} is {side:.5} long, {by_corners:.5} if it were fitted to the corners of the bounds."
        ))
    );
    text.push_str(&table(&HEAD, rows.map(cells)));
    text
}

fn cells(row: &RenderRow) -> [String; 25] {
    let timing = |name: &str| row.passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
    let median = |name: &str| timing(name).map_or_else(dash, |timing| format!("{:.1}", timing.median_us));
    let small = |value: f64| format!("{value:.4}");
    let count = |of: fn(&CullStats) -> u32| row.culled.map_or_else(dash, |culled| of(&culled.camera).to_string());
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
        small(row.light_of_aim.all.mean),
        small(row.light_of_aim.penumbra.mean),
        row.light_of_aim.in_umbra.map_or_else(dash, small),
        match (row.flicker, &row.no_flicker) {
            (Some(flicker), _) => format!("{:.3}", flicker.mean),
            (None, Some(why)) => format!("left out: {why}"),
            (None, None) => dash(),
        },
        match (row.passed, row.to_fail) {
            (true, _) => "yes".into(),
            (false, true) => format!("no, as stated: {}", row.faults.join("; ")),
            (false, false) => format!("no: {}", row.faults.join("; ")),
        },
    ]
}
