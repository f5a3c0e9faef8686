//! Benchmarks of error against run time for the renderer: compares the images of every variant with brute-force
//! ray-cast references.
//!
//! Each variant is validated before it is timed. Its intended result is a reference with the same kind of shadow: none,
//! hard or filtered. A variant whose error against its intended result exceeds a bound is not timed, and the report
//! names the variant and fails. Some variants are expected to fail; the report also fails if such a variant passes.
//!
//! - [`workloads`], [`variants`]: the scenes, and the ways to draw them.
//! - `ray_scene`, `reference_material`, `reference_texture`, `reference_view`, `shade`, `sample_pattern`,
//!   `ambient_occlusion`, `reference_image`: the references, with 64 samples per pixel, in f64 except for the boxes of
//!   the BVH. Each sample sees its nearest opaque or cut-out surface and the transparent surfaces in front of it,
//!   sorted by depth. Shadows are cast by one ray per sample to the sun, or by rays that are distributed over the
//!   footprint of the blur. Ambient occlusion is the mean over rays in the hemisphere above the surface.
//! - `harness`, `light_meter`: draw and time frames of the renderer, and measure their sun visibility.
//! - `readback`: frames per second when each frame is copied to the host.
//! - `pipeline`: steps per second with frames in flight, as in the server, and steps that are not drawn.
//! - [`metrics`]: errors, light bleeding, flicker.
//! - `minimal_passes`: times of two passes of the scene stripped to its mesh: the depth of the shadow map, and the
//!   visibility pass, which writes the depth and the id of the visible triangle of every sample.
//! - `blur_comparison`: the blurred moments of variance shadow maps, by compute shaders and by fragment shaders.
//! - `raster_comparison`: the minimal passes by the CUDA rasterizer and by OpenGL; `frame_comparison`: whole frames by
//!   both.
//! - `default_shadow`: the default shadow map by the measurements, and by the rule that its documentation states.
//! - [`packing`]: all images in one texture array as in equation 3.13 of the thesis, or in arrays by size.
//! - [`plants`]: the plants of table 4.5 of the thesis, deformed and drawn.
//! - [`frame_times`]: frame times of user-supplied scenes, for comparison with other programs.
//! - [`figures`]: reproduces figures of the thesis.
//! - `view_workloads`, `views_report`: batches of small views on a CUDA device, and their difference from single frames.
//! - `output`, `markdown`, `comparison_tables`, `raster_report`, `plot`, `image_files`: the files of a report.

mod ambient_occlusion;
mod blur_comparison;
mod bracket;
mod comparison_tables;
mod default_shadow;
pub mod error_limits;
pub mod figures;
mod frame_comparison;
pub mod frame_times;
mod harness;
mod image_files;
mod light_meter;
mod markdown;
mod measure;
pub mod metrics;
mod minimal_passes;
mod output;
pub mod packing;
mod pipeline;
pub mod plants;
mod plot;
mod raster_comparison;
mod raster_report;
mod ray_scene;
mod readback;
mod reference_image;
mod reference_material;
mod reference_texture;
mod reference_view;
mod rigid_domain;
mod sample_pattern;
mod shade;
#[cfg(test)]
mod tests;
mod texture_panels;
mod time_budget;
pub mod variants;
mod view_workloads;
mod views_report;
pub mod workloads;

use serde::Serialize;

pub use self::blur_comparison::BlurComparison;
pub use self::default_shadow::{DefaultCandidate, DefaultShadow};
use self::harness::RenderHarness;
pub use self::harness::{PassTime, Size};
pub use self::image_files::ImageFile;
pub use self::measure::RenderRow;
pub use self::minimal_passes::{FrameBaseline, MinimalPasses};
pub use self::pipeline::{PipelineReport, measure_pipelines};
use self::plants::PlantResult;
pub use self::raster_comparison::RasterComparison;
pub use self::raster_report::{RasterReport, compare_rasterizers};
pub use self::readback::ReadbackRates;
use self::variants::RenderVariant;
pub use self::views_report::{ViewsReport, ViewsRow, measure_views};
use self::workloads::RenderWorkload;
use super::is_selected;
use super::provenance::Provenance;
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;
use modalcast_render::{FrameParams, RendererInfo, shadow_texel_axes};

/// Settings of a report. Workloads are named `load` in records and on the command line.
#[derive(Debug, Clone)]
pub struct RenderReportOptions {
    pub loads: Vec<RenderWorkload>,
    /// Plants of the thesis's table 4.5 to deform and draw, as indices from 0.
    pub plants: Vec<usize>,
    /// Variants to measure: full names, or prefixes that end in `*`. An empty list selects all.
    pub variants: Vec<String>,
    pub size: Size,
    /// Whether to use fewer variants, samples and triangles, for machines with few cores.
    pub quick: bool,
    /// Frames per median.
    pub replays: usize,
}

impl RenderReportOptions {
    /// Texels per side of the shadow maps of rasterizer comparisons.
    fn shadow_map_size(&self) -> u32 {
        if self.quick { 1024 } else { 4096 }
    }

    /// The variants to measure. A quick run has fewer, but includes every variant that is named in full.
    pub fn selected_variants(&self) -> Vec<RenderVariant> {
        let (available_variants, mut selected_variants) = (variants::all(self.quick), variants::all(false));
        selected_variants.retain(|variant| {
            let is_named = self.variants.contains(&variant.name);
            let is_available = available_variants.iter().any(|candidate| candidate.name == variant.name);
            is_named || is_selected(&self.variants, &variant.name) && is_available
        });
        selected_variants
    }
}

/// Sizes, sample counts and reference times of one workload in a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderWorkloadSummary {
    pub name: String,
    pub vertices: usize,
    pub triangles: usize,
    pub domains: usize,
    /// Samples per pixel of the references.
    pub samples: usize,
    /// Rays to the sun per sample of a reference with filtered shadows.
    pub taps: usize,
    /// Time to trace all references of the still image.
    pub reference_ms: f64,
    /// Texel size of the shadow map with the scene's own settings; `None` without shadows.
    #[serde(rename = "texels")]
    pub texel_size: Option<ShadowTexelSize>,
    /// Steps over which flicker was measured.
    pub steps: usize,
    /// Size of the images of the moving scene.
    pub steps_size: Size,
    /// Reason why flicker was not measured.
    #[serde(rename = "no_flicker")]
    pub flicker_skip_reason: Option<String>,
}

/// Longer side of a texel of a shadow map, in scene units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ShadowTexelSize {
    /// Texels per side of the map.
    #[serde(rename = "size")]
    pub map_size: u32,
    /// For a map that is fitted to the extent of the vertices in light space, as in the renderer.
    #[serde(rename = "side")]
    pub vertex_fit_side: f64,
    /// For a map that is fitted to the corners of the bounding box.
    #[serde(rename = "by_corners")]
    pub corner_fit_side: f64,
}

impl ShadowTexelSize {
    fn measure(scene: &Scene, frame_params: &FrameParams) -> Option<Self> {
        let longer_side = |frame_params: &FrameParams| {
            shadow_texel_axes(scene, frame_params).map(|axes| axes[0].norm().max(axes[1].norm()))
        };
        let vertex_fit_side = longer_side(frame_params)?;
        // Without light bounds, the map is fitted to the corners of `bounds`.
        let corner_fit_side = longer_side(&FrameParams { light_bounds: None, ..*frame_params })?;
        scene.look.shadow.map(|shadow| Self { map_size: shadow.size, vertex_fit_side, corner_fit_side })
    }
}

/// All results of one run.
#[derive(Debug, Clone, Serialize)]
pub struct RenderReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    pub renderer: RendererInfo,
    pub size: Size,
    pub loads: Vec<RenderWorkloadSummary>,
    /// Names of the requested workloads and plants that are not measured yet. Empty when the report is complete.
    pub missing: Vec<String>,
    pub rows: Vec<RenderRow>,
    /// One entry per workload.
    pub readback: Vec<ReadbackRates>,
    /// Times of the minimal passes on each workload.
    #[serde(rename = "bare")]
    pub minimal_passes: Vec<MinimalPasses>,
    /// Times of the minimal passes by CUDA and by OpenGL; empty without a CUDA device.
    pub raster: Vec<RasterComparison>,
    /// Times to compute the same moment map by compute shaders and by fragment shaders.
    pub blurs: Vec<BlurComparison>,
    /// Plants of the thesis's table 4.5, deformed and drawn.
    pub plants: Vec<PlantResult>,
    /// The default shadow map by these measurements; `None` if no variant of the shadow map was timed.
    #[serde(rename = "default")]
    pub default_shadow: Option<DefaultShadow>,
    /// Unexpected results, as `workload: variant: reason`: variants that failed unexpectedly or passed although they
    /// are expected to fail, and rasterizer comparisons with too many differing ids.
    pub failed: Vec<String>,
    /// Reference images and comparison strips; in a progress event only the new ones.
    #[serde(skip)]
    pub pictures: Vec<ImageFile>,
}

/// Progress events of a running report.
#[derive(Debug)]
pub enum RenderProgress<'a> {
    /// Description of the stage that starts now.
    Started(&'a str),
    /// All results so far, with the pictures that are new since the previous event of this kind.
    Measured(&'a RenderReport),
}

/// Measures the selected variants on all workloads, then the rasterizers and the plants. `progress` is called before
/// each stage, and with the results after each workload, the rasterizers and each plant; the last results are complete.
///
/// # Errors
/// `Unavailable` without OpenGL; errors of loading and drawing a scene, and of `progress`.
pub fn render(
    options: &RenderReportOptions,
    mut progress: impl FnMut(RenderProgress<'_>) -> Result<()>,
) -> Result<RenderReport> {
    let mut harness = RenderHarness::open()?;
    let (mut measurements, mut pictures) = (Measurements::default(), Vec::new());
    for workload in &options.loads {
        progress(RenderProgress::Started(&format!("{}: building", workload.name())))?;
        // An error of `progress` ends the report after this stage.
        let mut stage_result = Ok(());
        let mut start_stage = |stage: &str| start(&mut stage_result, &mut progress, stage);
        let result = measure::measure_workload(&mut harness, options, *workload, &mut start_stage)?;
        start_stage(&format!("{}: measuring readback", workload.name()));
        stage_result?;
        measurements.loads.push(result.summary);
        measurements.rows.extend(result.rows);
        measurements.minimal_passes.extend(result.minimal_passes);
        measurements.readback.push(readback::measure(&mut harness, options, *workload)?);
        let report = measurements.assemble(options, harness.renderer.info(), result.files);
        progress(RenderProgress::Measured(&report))?;
        pictures.extend(report.pictures);
    }
    let device = harness::cuda_device();
    if let Some(device) = &device {
        let mut stage_result = Ok(());
        let mut start_stage = |stage: &str| start(&mut stage_result, &mut progress, stage);
        measurements.raster = raster_comparison::measure(&mut harness, device, options, &mut start_stage)?;
        stage_result?;
        let report = measurements.assemble(options, harness.renderer.info(), Vec::new());
        progress(RenderProgress::Measured(&report))?;
    }
    for index in &options.plants {
        progress(RenderProgress::Started(&plant_name(*index)))?;
        measurements.plants.extend(plants::measure(&mut harness, device.as_ref(), options, *index)?);
        let report = measurements.assemble(options, harness.renderer.info(), Vec::new());
        progress(RenderProgress::Measured(&report))?;
    }
    Ok(measurements.assemble(options, harness.renderer.info(), pictures))
}

/// Reports the start of a stage, unless an earlier report failed.
fn start(result: &mut Result<()>, progress: &mut impl FnMut(RenderProgress<'_>) -> Result<()>, stage: &str) {
    if result.is_ok() {
        *result = progress(RenderProgress::Started(stage));
    }
}

fn plant_name(index: usize) -> String {
    format!("plant-{}", index + 1)
}

/// Results so far. The workloads are the first ones of the options, and so are the plants.
#[derive(Default)]
struct Measurements {
    loads: Vec<RenderWorkloadSummary>,
    rows: Vec<RenderRow>,
    readback: Vec<ReadbackRates>,
    minimal_passes: Vec<MinimalPasses>,
    raster: Vec<RasterComparison>,
    plants: Vec<PlantResult>,
}

impl Measurements {
    fn assemble(
        &self,
        options: &RenderReportOptions,
        renderer: &RendererInfo,
        pictures: Vec<ImageFile>,
    ) -> RenderReport {
        let Self { loads, rows, readback, minimal_passes, raster, plants } = self;
        let failed = rows.iter().filter(|row: &&RenderRow| !row.is_as_expected()).map(describe_failure);
        let missing_loads = options.loads[loads.len()..].iter().map(|workload| workload.name());
        let is_missing = |name: &String| plants.iter().all(|plant| plant.load != *name);
        let missing_plants = options.plants.iter().map(|index| plant_name(*index)).filter(is_missing);
        RenderReport {
            provenance: Provenance::collect(),
            renderer: renderer.clone(),
            size: options.size,
            missing: missing_loads.chain(missing_plants).collect(),
            loads: loads.clone(),
            rows: rows.clone(),
            readback: readback.clone(),
            minimal_passes: minimal_passes.clone(),
            raster: raster.clone(),
            blurs: BlurComparison::pair_rows(rows),
            plants: plants.clone(),
            default_shadow: DefaultShadow::choose(rows, renderer, options.size),
            failed: failed.chain(raster.iter().filter_map(RasterComparison::describe_missing_times)).collect(),
            pictures,
        }
    }
}

fn describe_failure(row: &RenderRow) -> String {
    let reason =
        if row.passed { "expected to exceed its limits, but is within them".into() } else { row.faults.join("; ") };
    format!("{}: {}: {reason}", row.load, row.name)
}

impl RenderReport {
    /// Whether the report has no unexpected results.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }
}
