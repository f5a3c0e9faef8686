//! Output files of a report: JSON, CSV, Markdown, the plot as SVG and PNG, and the images.

use std::path::Path;

use serde_json::Value;

use super::plants::PlantResult;
use super::{RenderReport, RenderRow, markdown, plot};
use crate::csv_table;
use crate::plot::render_png;
use crate::timing::Timing;
use modalcast_model::error::{Result, fault_in};

/// Columns of `report.csv`: the name, and the source of the value. The source is a JSON pointer into a row of
/// `report.json`, or the name of a pass whose time the column contains. It is empty for `faults`, which [`cell_text`]
/// joins. Names that do not explain themselves:
///
/// - `color`, `light`: errors against the reference with hard shadows; `light` is the sun visibility
/// - `of_surfaces`: errors against the intended result, only of the pixels that show triangles
/// - `of_aim`: errors against the intended result: no shadow, a hard shadow, or a hard shadow with the variant's blur
/// - `bleeding`, `penumbra`, `lost`: mean sun visibility in the umbra, errors in the penumbra, and mean missing sun
///   visibility where there is no shadow; all against the intended result
/// - `leak`: largest sun visibility above that of the intended result
/// - `to_fail`: whether the variant is expected to exceed its limits
/// - `no_flicker`: why flicker was not measured
/// - `listed`, `hidden`: triangles that are passed to the rasterizer, and triangles that are occluded
const COLUMNS: [(&str, &str); 59] = [
    ("load", "/load"),
    ("variant", "/name"),
    ("method", "/method"),
    ("map_size", "/shadow/size"),
    ("blur", "/shadow/blur"),
    ("moments", "/shadow/moments"),
    ("splits", "/shadow/splits"),
    ("bleeding_cut", "/shadow/bleeding"),
    ("passed", "/passed"),
    ("to_fail", "/to_fail"),
    ("bleeding_limit", "/error_limits/bleeding"),
    ("frame_us", "frame"),
    ("frame_q1_us", "frame"),
    ("frame_q3_us", "frame"),
    ("shadow_us", "shadow"),
    ("blur_us", "blur"),
    ("draw_us", "draw"),
    ("cull_us", "cull"),
    ("visibility_us", "visibility"),
    ("ambient_occlusion_us", "ambient occlusion"),
    ("blended_us", "blended"),
    ("shade_us", "shade"),
    ("bloom_us", "bloom"),
    ("encode_us", "encode"),
    ("read_us", "read"),
    ("bytes", "/bytes"),
    ("shadow_bytes", "/shadow_bytes"),
    ("image_bytes", "/image_bytes"),
    ("samples", "/samples"),
    ("draws", "/draws"),
    ("culling", "/culling"),
    ("listed", "/culled/camera/visible"),
    ("hidden", "/culled/camera/occluded"),
    ("color_mean", "/color/mean"),
    ("color_p99", "/color/p99"),
    ("color_largest", "/color/largest"),
    ("color_of_aim_mean", "/color_of_aim/mean"),
    ("color_of_aim_p99", "/color_of_aim/p99"),
    ("color_of_aim_largest", "/color_of_aim/largest"),
    ("color_of_surfaces_mean", "/color_of_surfaces/mean"),
    ("color_of_surfaces_p99", "/color_of_surfaces/p99"),
    ("light_mean", "/light/all/mean"),
    ("light_p99", "/light/all/p99"),
    ("light_largest", "/light/all/largest"),
    ("light_in_hard_umbra", "/light/in_umbra"),
    ("light_of_aim_mean", "/light_of_aim/all/mean"),
    ("light_of_aim_p99", "/light_of_aim/all/p99"),
    ("light_of_aim_largest", "/light_of_aim/all/largest"),
    ("light_of_aim_bias", "/light_of_aim/bias"),
    ("penumbra_mean", "/light_of_aim/penumbra/mean"),
    ("penumbra_p99", "/light_of_aim/penumbra/p99"),
    ("penumbra_pixels", "/light_of_aim/penumbra/count"),
    ("bleeding", "/light_of_aim/in_umbra"),
    ("leak", "/light_of_aim/leak"),
    ("lost", "/light_of_aim/lost"),
    ("flicker_mean", "/flicker/mean"),
    ("flicker_p99", "/flicker/p99"),
    ("no_flicker", "/no_flicker"),
    ("faults", ""),
];

impl RenderReport {
    /// Writes `report.json`, `report.csv`, `passes.csv` (minimal passes, rasterizers and blurs), `plants.csv`,
    /// `report.md`, `report.svg`, `report.png` and `pictures/` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let pictures = folder.join("pictures");
        std::fs::create_dir_all(&pictures).map_err(fault_in("report"))?;
        let svg = plot::draw_svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(fault_in("report"))?),
            ("report.csv", rows_csv(&self.rows)?),
            ("passes.csv", passes_csv(self)?),
            ("plants.csv", plants_csv(&self.plants)?),
            ("report.md", markdown::markdown(self).into_bytes()),
            ("report.png", render_png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        for (name, bytes) in files {
            std::fs::write(folder.join(name), bytes).map_err(fault_in("report"))?;
        }
        for file in &self.pictures {
            std::fs::write(pictures.join(&file.name), &file.png).map_err(fault_in("report"))?;
        }
        Ok(())
    }
}

fn rows_csv(rows: &[RenderRow]) -> Result<Vec<u8>> {
    let mut lines = Vec::new();
    for row in rows {
        let value = serde_json::to_value(row).map_err(fault_in("report"))?;
        lines.push(COLUMNS.map(|column| cell_text(row, &value, column)));
    }
    csv_table::encode(COLUMNS.map(|(name, _)| name.to_owned()), lines)
}

/// The CSV of minimal passes, rasterizers and blurs. Each line has the time of a pass, `median_us`. The columns
/// `beside` and `beside_us` are the name and the time of the frame or pass that it is compared with. The minimal passes
/// are named `bare` passes.
fn passes_csv(report: &RenderReport) -> Result<Vec<u8>> {
    let header =
        ["load", "what", "size", "samples_or_taps", "median_us", "beside", "beside_us", "difference_us", "ratio"];
    let mut lines = Vec::new();
    let frame_size = format!("{}x{}", report.size.width, report.size.height);
    for minimal_passes in &report.minimal_passes {
        let passes = [
            ("bare depth pass", minimal_passes.map_size.to_string(), 1, minimal_passes.depth),
            ("bare visibility pass", frame_size.clone(), minimal_passes.samples, minimal_passes.visibility),
        ];
        for (pass_name, size, sample_count, timing) in passes {
            let [sample_count, median_us] =
                [f64::from(sample_count), timing.median_us].map(|number| number.to_string());
            lines.push(
                [&minimal_passes.load, pass_name, &size, &sample_count, &median_us, "", "", "", ""].map(String::from),
            );
        }
        let sum_us = (minimal_passes.depth.median_us + minimal_passes.visibility.median_us).to_string();
        for frame in [&minimal_passes.without_culling, &minimal_passes.with_scene_culling] {
            let [frame_us, excess_us, size] =
                [frame.frame_us, frame.excess_us, f64::from(minimal_passes.map_size)].map(|number| number.to_string());
            let pass_name = "both bare passes";
            lines.push(
                [&minimal_passes.load, pass_name, &size, "", &sum_us, &frame.name, &frame_us, &excess_us, ""]
                    .map(String::from),
            );
        }
    }
    for (comparison, passes) in report.raster.iter().filter_map(|entry| entry.passes.map(|passes| (entry, passes))) {
        let pairs = [
            ("raster depth in CUDA", comparison.map_size.to_string(), passes.depth),
            ("raster ids in CUDA", frame_size.clone(), passes.visibility),
        ];
        for (pass_name, size, pair) in pairs {
            let [cuda, opengl, ratio] =
                [pair.cuda.median_us, pair.opengl.median_us, pair.ratio()].map(|number| number.to_string());
            lines.push(
                [&comparison.load, pass_name, &size, "1", &cuda, "in OpenGL", &opengl, "", &ratio].map(String::from),
            );
        }
    }
    for blur in &report.blurs {
        let [size, taps] = [blur.size, blur.taps].map(|number| number.to_string());
        let [compute_us, fragments_us, ratio] =
            [blur.compute_us, blur.fragments_us, blur.ratio].map(|number| number.to_string());
        let pass_name = "moments and blur in compute";
        lines.push(
            [&blur.load, pass_name, &size, &taps, &compute_us, "in fragments", &fragments_us, "", &ratio]
                .map(String::from),
        );
    }
    csv_table::encode(header.map(String::from), lines)
}

/// The CSV of plants, one plant and setting per line: our measurements, then the measurements of the thesis. `t_vbr`
/// and `o_vbr` are defined in [`super::plants`].
fn plants_csv(plants: &[PlantResult]) -> Result<Vec<u8>> {
    let header = ["load", "species", "full", "backend", "shared", "triangles", "domains", "map_size", "fit", "raster"];
    let header = header.into_iter().chain([
        "deform_ms",
        "upload_ms",
        "render_ms",
        "t_vbr_ms",
        "frame_ms",
        "fps",
        "memory_mb",
        "o_vbr",
    ]);
    let header = header.chain(["thesis_t_vbr_ms", "thesis_fps", "thesis_memory_mb", "thesis_o_vbr"]);
    let line = |plant: &PlantResult| {
        let median_ms = |timing: Timing| (timing.median_us / 1e3).to_string();
        let thesis = plant.thesis.drawn;
        let texts = [
            plant.load.clone(),
            plant.thesis.name.into(),
            plant.is_full_size.to_string(),
            plant.backend.name().into(),
            plant.fills_gl_buffers.to_string(),
        ];
        let sizes = [plant.triangles, plant.domains, plant.setting.map_size as usize].map(|number| number.to_string());
        let raster = if plant.setting.is_cuda_rasterized { "cuda" } else { "opengl" };
        let setting = [format!("{:?}", plant.setting.fit).to_lowercase(), raster.into()];
        let times = [plant.deform, plant.upload, plant.render, plant.vbr, plant.frame].map(median_ms);
        let rates = [plant.fps, plant.bytes as f64 / 1e6, plant.occupation];
        let thesis = [thesis.gpu_vbr_ms, thesis.gpu_fps, thesis.gpu_mb, thesis.gpu_vbr_occupation];
        let numbers = rates.iter().chain(&thesis).map(|number| number.to_string());
        texts.into_iter().chain(sizes).chain(setting).chain(times).chain(numbers).collect::<Vec<String>>()
    };
    csv_table::encode(header.map(String::from), plants.iter().map(line))
}

/// The text of a column in a row; `value` is the row as JSON.
fn cell_text(row: &RenderRow, value: &Value, (name, source): (&str, &str)) -> String {
    if name == "faults" {
        return row.faults.join("; ");
    }
    if !source.starts_with('/') {
        let timing = row.passes.iter().find(|pass| pass.name == source).map(|pass| pass.timing);
        let us = timing.map(|timing| match name {
            "frame_q1_us" => timing.q1_us,
            "frame_q3_us" => timing.q3_us,
            _ => timing.median_us,
        });
        return us.map_or_else(String::new, |us| us.to_string());
    }
    csv_table::cell_text(value, source)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::harness::{RenderHarness, Size};
    use crate::render::light_meter::with_settings;
    use crate::render::workloads::RenderWorkload;
    use modalcast_model::scene::{Bloom, Culling, RenderSettings};

    #[test]
    fn passes_have_columns_and_draw_is_the_sum_of_its_parts() {
        let animation = RenderWorkload::Triangles(2_000).build().expect("a workload");
        let look =
            RenderSettings { culling: Culling::Occlusion, bloom: Some(Bloom::default()), ..animation.scene.look };
        let mut harness = RenderHarness::open().expect("OpenGL");
        let mut loaded_scene =
            harness.load(&with_settings(&animation.scene, look).expect("valid settings")).expect("a loaded scene");
        harness.deform(&mut loaded_scene, &animation.state(0)).expect("deformed vertices");
        let size = Size { width: 64, height: 36 };
        let times = harness.draw(&loaded_scene, animation.camera(size), size).expect("a frame").times;
        let passes: Vec<(&str, f64)> = times.iter().map(|(key, ms)| (key.name(), ms)).collect();
        for (name, _) in &passes {
            assert!(COLUMNS.iter().any(|(_, source)| source == name), "expected a column for pass {name}");
        }
        let sum_of =
            |names: &[&str]| -> f64 { passes.iter().filter(|pass| names.contains(&pass.0)).map(|pass| pass.1).sum() };
        let parts = ["cull", "visibility", "ambient occlusion", "blended", "shade", "bloom", "encode"];
        let draw_ms = sum_of(&["draw"]);
        assert!((draw_ms - sum_of(&parts)).abs() < 1e-9 * draw_ms, "{passes:?}");
        assert!(
            sum_of(&parts[1..]) < draw_ms && sum_of(&["bloom"]) > 0.0,
            "expected times of culling and bloom above 0: {passes:?}"
        );
    }
}
