//! Sections of `report.md` that cover all loads: minimal passes, rasterizers, blurs, and the plants of the thesis.

use super::RenderReport;
use super::blur_comparison::{BlurComparison, MAX_COMPUTE_US, MIN_SPEEDUP};
use super::minimal_passes::{MAX_EXCESS_US, MinimalPasses};
use super::plants::PlantResult;
use super::raster_comparison::{MAX_DIFFERING, RasterComparison, TimingPair, TriangleCounts};
use crate::markdown_table::{dash, table};

/// All sections for which the report has data.
pub(super) fn markdown(report: &RenderReport) -> String {
    [
        minimal_passes_section(&report.minimal_passes),
        raster_section(&report.raster),
        blur_section(&report.blurs),
        plant_section(&report.plants),
    ]
    .concat()
}

fn minimal_passes_section(list: &[MinimalPasses]) -> String {
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
         {MAX_EXCESS_US} us at most for 3,000,000 triangles and a map of 4096 on an H200 at 1920 x 1080; the other has fewer \
         triangles to draw than the passes have.\n\n"
    );
    let row = |passes: &MinimalPasses| {
        let us = |us: f64| format!("{us:.1}");
        [
            passes.load.clone(),
            passes.triangles.to_string(),
            us(passes.depth.median_us),
            passes.map.to_string(),
            us(passes.visibility.median_us),
            passes.samples.to_string(),
            us(passes.unculled.frame_us),
            us(passes.unculled.beyond_us),
            us(passes.default_culling.frame_us),
            us(passes.default_culling.beyond_us),
        ]
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}

/// The section that compares the CUDA rasterizer with OpenGL.
pub(super) fn raster_section(list: &[RasterComparison]) -> String {
    if list.is_empty() {
        return String::new();
    }
    let head = [
        "load",
        "triangles",
        "differing ids",
        "depth us: OpenGL",
        "CUDA",
        "speedup",
        "of",
        "ids us: OpenGL",
        "CUDA",
        "speedup",
        "in the map",
        "in the frame",
    ];
    let mut text = format!(
        "\n## Raster\n\nThe bare passes at one sample a pixel, by OpenGL and by our CUDA kernels, in the same run. Where \
         more than {} % of the ids differ nothing is timed. Triangles: drawn by a thread + a warp + tile by tile; between \
         the samples; dropped for another reason.\n\n",
        100.0 * MAX_DIFFERING
    );
    let row = |raster: &RasterComparison| {
        let triangle_counts = |counts: TriangleCounts| {
            let TriangleCounts { small, medium, large, missed, dropped } = counts;
            format!("{small} + {medium} + {large}; {missed}; {dropped}")
        };
        let pair_cells = |pair: Option<TimingPair>| match pair {
            Some(pair) => {
                [pair.opengl.median_us, pair.cuda.median_us, pair.ratio()].map(|number| format!("{number:.1}"))
            }
            None => [(); 3].map(|()| dash()),
        };
        let sizes =
            [raster.load.clone(), raster.triangles.to_string(), format!("{} of {}", raster.differing, raster.samples)];
        let cells = sizes
            .into_iter()
            .chain(pair_cells(raster.passes.map(|passes| passes.depth)))
            .chain([raster.map.to_string()]);
        let cells = cells.chain(pair_cells(raster.passes.map(|passes| passes.visibility)));
        cells.chain([triangle_counts(raster.in_map), triangle_counts(raster.in_frame)])
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}

fn blur_section(list: &[BlurComparison]) -> String {
    if list.is_empty() {
        return String::new();
    }
    let head = ["load", "map", "taps", "compute us", "fragments us", "speedup"];
    let mut text = format!(
        "\n## Moments and blur\n\nThe same map from the same depth, by compute shaders (the fastest of ours) and by two \
         passes of fragments. At 4096 on an H200 compute is to take {MAX_COMPUTE_US} us at most and to be {MIN_SPEEDUP} times as \
         fast.\n\n"
    );
    let row = |blur: &BlurComparison| {
        let [compute, fragments, ratio] =
            [blur.compute_us, blur.fragments_us, blur.ratio].map(|number| format!("{number:.1}"));
        let [size, taps] = [blur.size, blur.taps].map(|number| number.to_string());
        [blur.load.clone(), size, taps, compute, fragments, ratio]
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}

fn plant_section(list: &[PlantResult]) -> String {
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
    text.push_str(&table(&head, list.iter().map(plant_cells)));
    text
}

fn plant_cells(plant: &PlantResult) -> [String; 14] {
    let ms = |us: f64| format!("{:.3}", us / 1e3);
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let thesis = plant.thesis.drawn;
    [
        plant.thesis.name.into(),
        plant.triangles.to_string(),
        plant.domains.to_string(),
        ms(plant.deform.median_us),
        if plant.shared { dash() } else { ms(plant.upload.median_us) },
        ms(plant.render.median_us),
        ms(plant.vbr.median_us),
        thesis.gpu_vbr_ms.to_string(),
        format!("{:.1}", plant.fps),
        thesis.gpu_fps.to_string(),
        format!("{:.1}", plant.bytes as f64 / 1e6),
        thesis.gpu_mb.to_string(),
        percent(plant.occupation),
        percent(thesis.gpu_vbr_occupation),
    ]
}
