//! Sections of `report.md` that do not belong to one load: bare passes, rasterizers, blurs, and the plants of the
//! thesis.

use super::RenderReport;
use super::blur_comparison::{BlurComparison, MOST_US, TIMES_AS_FAST};
use super::minimal_passes::{BEYOND_US, MinimalPasses};
use super::plants::PlantResult;
use super::raster_comparison::{MOST_DIFFERING, RasterComparison, TimingPair, TriangleCounts};
use crate::markdown_table::{dash, table};

/// All sections for which the report has data.
pub(super) fn markdown(report: &RenderReport) -> String {
    [bare(&report.bare), raster(&report.raster), blurs(&report.blurs), plants(&report.plants)].concat()
}

fn bare(list: &[MinimalPasses]) -> String {
    if list.is_empty() {
        return String::new();
    }
    let head = [
        "load",
        "triangles",
        "depth pass us",
        "of",
        "visibility pass us",
        "samples",
        "frame without culling us",
        "beyond us",
        "frame as the load culls us",
        "beyond us",
    ];
    let mut text = format!(
        "\n## Bare passes\n\nThe same scene in the same run, stripped to one opaque material: all triangles in one draw into \
         the depth of the map, and in one draw into ids and depth of the frame; no culling, no images, no holes. Beside them \
         frames with a variance map of the same side. What the frame without culling takes beyond both passes is to be \
         {BEYOND_US} us at most for 3,000,000 triangles and a map of 4096 on an H200 at 1920 x 1080; the other has fewer \
         triangles to draw than the passes have.\n\n"
    );
    let row = |own: &MinimalPasses| {
        let us = |us: f64| format!("{us:.1}");
        [
            own.load.clone(),
            own.triangles.to_string(),
            us(own.depth.median_us),
            own.map.to_string(),
            us(own.visibility.median_us),
            own.samples.to_string(),
            us(own.unculled.frame_us),
            us(own.unculled.beyond_us),
            us(own.usual.frame_us),
            us(own.usual.beyond_us),
        ]
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}

/// The section that compares the CUDA rasterizer with OpenGL.
pub(super) fn raster(list: &[RasterComparison]) -> String {
    if list.is_empty() {
        return String::new();
    }
    let head = [
        "load",
        "triangles",
        "ids that differ",
        "depth us: OpenGL",
        "CUDA",
        "times as fast",
        "of",
        "ids us: OpenGL",
        "CUDA",
        "times as fast",
        "in the map",
        "in the frame",
    ];
    let mut text = format!(
        "\n## Raster\n\nThe bare passes at one sample a pixel, by OpenGL and by CUDA's own kernels, in the same run. Where \
         more than {} % of the ids differ nothing is timed. Triangles: drawn by a thread + a warp + tile by tile; between \
         the samples; dropped for another reason.\n\n",
        100.0 * MOST_DIFFERING
    );
    let row = |own: &RasterComparison| {
        let count = |own: TriangleCounts| {
            format!("{} + {} + {}; {}; {}", own.small, own.medium, own.large, own.missed, own.dropped)
        };
        let pair = |pair: Option<TimingPair>| match pair {
            Some(pair) => [pair.opengl.median_us, pair.cuda.median_us, pair.ratio()].map(|own| format!("{own:.1}")),
            None => [(); 3].map(|()| dash()),
        };
        let first = [own.load.clone(), own.triangles.to_string(), format!("{} of {}", own.differing, own.samples)];
        let cells = first.into_iter().chain(pair(own.passes.map(|passes| passes.depth))).chain([own.map.to_string()]);
        let cells = cells.chain(pair(own.passes.map(|passes| passes.visibility)));
        cells.chain([count(own.in_map), count(own.in_frame)])
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}

fn blurs(list: &[BlurComparison]) -> String {
    if list.is_empty() {
        return String::new();
    }
    let head = ["load", "map", "taps", "compute us", "fragments us", "times as fast"];
    let mut text = format!(
        "\n## Moments and blur\n\nThe same map from the same depth, by compute shaders (the fastest of ours) and by two \
         passes of fragments. At 4096 on an H200 compute is to take {MOST_US} us at most and to be {TIMES_AS_FAST} times as \
         fast.\n\n"
    );
    let row = |own: &BlurComparison| {
        let [compute, fragments, ratio] = [own.compute_us, own.fragments_us, own.ratio].map(|us| format!("{us:.1}"));
        let [size, taps] = [own.size, own.taps].map(|number| number.to_string());
        [own.load.clone(), size, taps, compute, fragments, ratio]
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}

fn plants(list: &[PlantResult]) -> String {
    let Some(first) = list.first() else { return String::new() };
    let head = [
        "species",
        "triangles",
        "domains",
        "deform ms",
        "upload ms",
        "render ms",
        "t_vbr ms",
        "thesis",
        "FPS",
        "thesis",
        "s MB",
        "thesis",
        "O_vbr",
        "thesis",
    ];
    let vertices = if first.shared { "vertices stay on the device" } else { "vertices are uploaded" };
    let mut text = format!(
        "\n## The plants of table 4.5, deformed and drawn\n\nDeformed by {}, {vertices}; a variance shadow map of {}. t_vbr: \
         deforming, uploading and rendering; FPS: whole frames with their pixels in host memory; s: device memory of the \
         scene; O_vbr: t_vbr of the frame. Thesis: GeForce GTX 680, its GPU columns of tables 4.6 and 4.7; its frame has \
         the simulation in it, ours has none.{}\n\n",
        first.backend.name(),
        first.map,
        if first.full {
            ""
        } else {
            " These plants are smaller than the thesis's: its figures are not to be compared."
        }
    );
    text.push_str(&table(&head, list.iter().map(plant)));
    text
}

fn plant(own: &PlantResult) -> [String; 14] {
    let ms = |us: f64| format!("{:.3}", us / 1e3);
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let printed = own.thesis.drawn;
    [
        own.thesis.name.into(),
        own.triangles.to_string(),
        own.domains.to_string(),
        ms(own.deform.median_us),
        if own.shared { dash() } else { ms(own.upload.median_us) },
        ms(own.render.median_us),
        ms(own.vbr.median_us),
        printed.gpu_vbr_ms.to_string(),
        format!("{:.1}", own.fps),
        printed.gpu_fps.to_string(),
        format!("{:.1}", own.bytes as f64 / 1e6),
        printed.gpu_mb.to_string(),
        percent(own.occupation),
        percent(printed.gpu_vbr_occupation),
    ]
}
