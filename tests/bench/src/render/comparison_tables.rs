//! Sections of `report.md` that cover all workloads: antialiasing, ambient occlusion, minimal passes, rasterizers,
//! blurs, and the plants of the thesis.

use super::blur_comparison::{BlurComparison, MAX_COMPUTE_US, MIN_SPEEDUP};
use super::minimal_passes::{MAX_EXCESS_US, MinimalPasses};
use super::plants::PlantResult;
use super::raster_comparison::{MAX_DIFFERING_FRACTION, RasterComparison, TimingPair, TriangleCounts};
use super::{RenderReport, RenderRow};
use crate::markdown_table::{dash, table};

/// All sections for which the report has data.
pub(super) fn markdown(report: &RenderReport) -> String {
    [
        antialias_section(&report.rows),
        occlusion_section(&report.rows),
        minimal_passes_section(&report.minimal_passes),
        raster_section(&report.raster),
        blur_section(&report.blurs),
        plant_section(&report.plants),
    ]
    .concat()
}

/// The antialiasing methods of each load. Nothing has a shadow, and the reference has no shadow either.
fn antialias_section(rows: &[RenderRow]) -> String {
    let mut rows = rows.iter().filter(|row| row.name.starts_with("antialias ")).peekable();
    if rows.peek().is_none() {
        return String::new();
    }
    let header = ["load", "method", "frame us", "color mean", "p99", "largest", "flicker mean", "MB"];
    let cells = |row: &RenderRow| {
        let errors = row.intended_color_errors;
        [
            row.load.clone(),
            row.name.trim_start_matches("antialias ").into(),
            row.median_us().map_or_else(dash, |us| format!("{us:.1}")),
            format!("{:.3}", errors.mean),
            format!("{:.1}", errors.p99),
            format!("{:.1}", errors.max),
            row.flicker.map_or_else(dash, |flicker| format!("{:.3}", flicker.mean)),
            format!("{:.1}", row.bytes as f64 / 1e6),
        ]
    };
    let table = table(&header, rows.map(cells));
    format!("\n## Antialiasing\n\nWithout shadows; color errors against the ray-cast reference, of 255.\n\n{table}")
}

/// Images with and without ambient occlusion. Only images within their limits are timed.
fn occlusion_section(rows: &[RenderRow]) -> String {
    let mut rows = rows.iter().filter(|row| row.error_limits.mean_surface_color.is_some()).peekable();
    if rows.peek().is_none() {
        return String::new();
    }
    let header = ["load", "variant", "frame us", "occlusion us", "color mean", "p99", "largest", "flicker mean", "MB"];
    let cells = |row: &RenderRow| {
        let errors = row.surface_color_errors;
        let occlusion = row.passes.iter().find(|pass| pass.name == "ambient occlusion");
        [
            row.load.clone(),
            row.name.clone(),
            row.median_us().map_or_else(dash, |us| format!("{us:.1}")),
            occlusion.map_or_else(dash, |pass| format!("{:.1}", pass.timing.median_us)),
            format!("{:.3}", errors.mean),
            format!("{:.1}", errors.p99),
            format!("{:.1}", errors.max),
            row.flicker.map_or_else(dash, |flicker| format!("{:.3}", flicker.mean)),
            format!("{:.1}", row.bytes as f64 / 1e6),
        ]
    };
    let table = table(&header, rows.map(cells));
    format!(
        "\n## Ambient occlusion\n\nWithout shadows; color errors of the pixels that show triangles against rays over \
         the hemisphere, of 255.\n\n{table}"
    )
}

fn minimal_passes_section(rows: &[MinimalPasses]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let header = [
        "load",
        "triangles",
        "depth pass us",
        "map side",
        "visibility pass us",
        "samples",
        "frame without culling us",
        "excess us",
        "frame with the scene's culling us",
        "excess us",
    ];
    let mut text = format!(
        "\n## Minimal passes\n\nThe same scene in the same run, stripped to one opaque material without culling, \
         images and cut-outs. One draw of all triangles writes the depth of the shadow map; a second draw writes the \
         ids and depth of the frame. For comparison: frames with a variance map of the same size, and the excess of \
         their time over both passes. The target for the excess without culling is at most {MAX_EXCESS_US} us for \
         3,000,000 triangles and a map of 4096 on an H200 at 1920 x 1080. A frame with culling draws fewer triangles \
         than the passes.\n\n"
    );
    let row = |passes: &MinimalPasses| {
        let format_us = |us: f64| format!("{us:.1}");
        [
            passes.load.clone(),
            passes.triangles.to_string(),
            format_us(passes.depth.median_us),
            passes.map_size.to_string(),
            format_us(passes.visibility.median_us),
            passes.samples.to_string(),
            format_us(passes.without_culling.frame_us),
            format_us(passes.without_culling.excess_us),
            format_us(passes.with_scene_culling.frame_us),
            format_us(passes.with_scene_culling.excess_us),
        ]
    };
    text.push_str(&table(&header, rows.iter().map(row)));
    text
}

/// The section that compares the CUDA rasterizer with OpenGL.
pub(super) fn raster_section(comparisons: &[RasterComparison]) -> String {
    if comparisons.is_empty() {
        return String::new();
    }
    let header = [
        "load",
        "triangles",
        "differing ids",
        "depth us: OpenGL",
        "CUDA",
        "speedup",
        "map side",
        "ids us: OpenGL",
        "CUDA",
        "speedup",
        "triangles in the map",
        "triangles in the frame",
    ];
    let mut text = format!(
        "\n## Raster\n\nThe minimal passes with one sample per pixel, by OpenGL and by the CUDA kernels, in the same \
         run. Passes are not timed if more than {} % of the ids differ. Triangles: drawn by a thread + by a warp + \
         tile by tile; dropped because they cover no sample; dropped for another reason.\n\n",
        100.0 * MAX_DIFFERING_FRACTION
    );
    let row = |raster: &RasterComparison| {
        let format_counts = |counts: TriangleCounts| {
            let TriangleCounts { small, medium, large, missed, dropped } = counts;
            format!("{small} + {medium} + {large}; {missed}; {dropped}")
        };
        let pair_cells = |pair: Option<TimingPair>| match pair {
            Some(pair) => {
                [pair.opengl.median_us, pair.cuda.median_us, pair.ratio()].map(|number| format!("{number:.1}"))
            }
            None => std::array::from_fn(|_| dash()),
        };
        let differing_ids = format!("{} of {}", raster.differing_ids, raster.samples);
        let cells = [raster.load.clone(), raster.triangles.to_string(), differing_ids].into_iter();
        let cells = cells.chain(pair_cells(raster.passes.map(|passes| passes.depth)));
        let cells = cells.chain([raster.map_size.to_string()]);
        let cells = cells.chain(pair_cells(raster.passes.map(|passes| passes.visibility)));
        cells.chain([format_counts(raster.in_map), format_counts(raster.in_frame)])
    };
    text.push_str(&table(&header, comparisons.iter().map(row)));
    text
}

fn blur_section(comparisons: &[BlurComparison]) -> String {
    if comparisons.is_empty() {
        return String::new();
    }
    let header = ["load", "map", "taps", "compute us", "fragments us", "speedup"];
    let mut text = format!(
        "\n## Moments and blur\n\nThe same moment map from the same depth, by the fastest compute shader and by two passes \
         of fragment shaders. Targets for compute at 4096 on an H200: at most {MAX_COMPUTE_US} us, and at least \
         {MIN_SPEEDUP} times as fast.\n\n"
    );
    let row = |blur: &BlurComparison| {
        let [compute, fragments, ratio] =
            [blur.compute_us, blur.fragments_us, blur.ratio].map(|number| format!("{number:.1}"));
        let [size, taps] = [blur.size, blur.taps].map(|number| number.to_string());
        [blur.load.clone(), size, taps, compute, fragments, ratio]
    };
    text.push_str(&table(&header, comparisons.iter().map(row)));
    text
}

fn plant_section(plants: &[PlantResult]) -> String {
    let Some(first_plant) = plants.first() else { return String::new() };
    let header = [
        "species",
        "shadow map",
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
    let vertex_transfer =
        if first_plant.fills_gl_buffers { "vertices stay on the device" } else { "vertices are uploaded" };
    let mut text = format!(
        "\n## The plants of table 4.5, deformed and drawn\n\nDeformed by {}, {vertex_transfer}; a variance shadow map, fitted \
         to the corners of a box as in the thesis, or to the vertices; 4 samples a pixel, or FXAA with the CUDA rasterizer. \
         The thesis states neither the size of its images nor that of its maps. t_vbr: deforming, uploading and rendering; FPS: whole frames with readback of the pixels; s: device memory of \
         the scene; O_vbr: fraction of the frame that is t_vbr. Thesis: GeForce GTX 680, the GPU columns of tables 4.6 and \
         4.7. The thesis's frame includes the simulation, ours does not.{}\n\n",
        first_plant.backend.name(),
        if first_plant.is_full_size {
            ""
        } else {
            " These plants are smaller than those of the thesis, so the numbers are not comparable."
        }
    );
    text.push_str(&table(&header, plants.iter().map(plant_cells)));
    text
}

fn plant_cells(plant: &PlantResult) -> [String; 15] {
    let format_ms = |us: f64| format!("{:.3}", us / 1e3);
    let format_percent = |fraction: f64| format!("{:.2} %", 100.0 * fraction);
    let thesis = plant.thesis.drawn;
    [
        plant.thesis.name.into(),
        plant.setting.to_string(),
        plant.triangles.to_string(),
        plant.domains.to_string(),
        format_ms(plant.deform.median_us),
        if plant.fills_gl_buffers { dash() } else { format_ms(plant.upload.median_us) },
        format_ms(plant.render.median_us),
        format_ms(plant.vbr.median_us),
        thesis.gpu_vbr_ms.to_string(),
        format!("{:.1}", plant.fps),
        thesis.gpu_fps.to_string(),
        format!("{:.1}", plant.bytes as f64 / 1e6),
        thesis.gpu_mb.to_string(),
        format_percent(plant.occupation),
        format_percent(thesis.gpu_vbr_occupation),
    ]
}
