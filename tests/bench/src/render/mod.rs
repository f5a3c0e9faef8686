//! Benchmarks of error against run time for the renderer: pictures by every variant against brute-force ray-cast
//! references.
//!
//! Validation comes before timing: a variant whose error against its intended result exceeds a stated bound is not
//! timed. The report names it and fails. Some variants are included to show a failure; the report also fails if such a
//! variant passes.
//!
//! - [`workloads`], [`variants`]: the scenes, and the ways to draw them.
//! - `ray_scene`, `paint`, `texels`, `view`, `shade`, `sample_pattern`, `picture`: the references. 64 samples per pixel, in f64
//!   except for the boxes of the BVH. Opaque surfaces and cut-outs by their nearest point, transparent ones sorted by
//!   depth along every sample. Shadows by one ray per sample to the sun, or by rays distributed over the blur's
//!   footprint.
//! - `studio`, `meter`: frames of the renderer, and their sun visibility.
//! - `readback`: frames per second when each frame is read back.
//! - [`metrics`]: errors, light bleeding, flicker.
//! - `bare`: the passes of the scene stripped to its mesh, timed in the same run; `blurs`: moments and blur by compute
//!   and by fragment shaders.
//! - `raster`: the bare passes by the CUDA rasterizer and by OpenGL; `frame_comparison`: whole frames with either.
//! - [`packing`]: images in one array as in equation 3.13, against arrays by size.
//! - [`plants`]: the plants of table 4.5, deformed and drawn.
//! - [`frame_times`]: frame times of a scene of the user, for comparison with other programs.
//! - [`figures`]: figures like those of the thesis, for viewing.

mod blur_comparison;
mod comparison_tables;
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
pub mod workloads;

use serde::Serialize;

pub use self::blur_comparison::BlurComparison;
use self::harness::RenderHarness;
pub use self::harness::{PassTime, Size};
pub use self::image_files::ImageFile;
pub use self::measure::RenderRow;
pub use self::minimal_passes::{FrameBaseline, MinimalPasses};
use self::plants::PlantResult;
pub use self::raster_comparison::RasterComparison;
pub use self::raster_report::{RasterReport, rasters};
pub use self::readback::ReadbackRates;
use self::variants::RenderVariant;
use self::workloads::RenderWorkload;
use super::is_selected;
use super::provenance::Provenance;
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;
use modalcast_render::{FrameParams, RendererInfo, shadow_texel_axes};

/// Settings of a report.
#[derive(Debug, Clone)]
pub struct RenderReportOptions {
    pub loads: Vec<RenderWorkload>,
    /// Plants of table 4.5 to deform and draw, as indices from 0.
    pub plants: Vec<usize>,
    /// Variants to measure: full names, or prefixes that end in `*`. An empty list selects all.
    pub variants: Vec<String>,
    pub size: Size,
    /// Fewer variants, samples and steps, for machines with few cores.
    pub quick: bool,
    /// Frames per median.
    pub replays: usize,
}

impl RenderReportOptions {
    /// The variants to measure. A quick run has fewer, but includes every variant that is named in full.
    pub fn wanted(&self) -> Vec<RenderVariant> {
        let (few, mut all) = (variants::all(self.quick), variants::all(false));
        all.retain(|variant| {
            let is_named = self.variants.contains(&variant.name);
            is_named || is_selected(&self.variants, &variant.name) && few.iter().any(|own| own.name == variant.name)
        });
        all
    }
}

/// Facts of one load in a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderWorkloadSummary {
    pub name: String,
    pub vertices: usize,
    pub triangles: usize,
    pub domains: usize,
    /// Samples per pixel of the references.
    pub samples: usize,
    /// Rays to the sun per sample, where the light is filtered.
    pub taps: usize,
    /// Time to trace all references of the still picture.
    pub reference_ms: f64,
    /// Texels of the shadow map of the load's own look; `None` without one.
    pub texels: Option<ShadowTexelSize>,
    /// Steps over which flicker was measured.
    pub steps: usize,
    /// Size of the pictures of the moving scene.
    pub steps_size: Size,
    /// Reason why flicker was not measured.
    pub no_flicker: Option<String>,
}

/// Longer side of a texel of a shadow map of `size` texels per side, in scene units. `side`: of the map that is drawn,
/// which is fitted to the vertices' extent in light space; `by_corners`: of a map that is fitted to the corners of
/// their bounds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ShadowTexelSize {
    pub size: u32,
    pub side: f64,
    pub by_corners: f64,
}

impl ShadowTexelSize {
    fn of(scene: &Scene, shot: &FrameParams) -> Option<Self> {
        let longer =
            |shot: &FrameParams| shadow_texel_axes(scene, shot).map(|sides| sides[0].norm().max(sides[1].norm()));
        let (side, by_corners) = (longer(shot)?, longer(&FrameParams { light: None, ..*shot })?);
        scene.look.shadow.map(|shadow| Self { size: shadow.size, side, by_corners })
    }
}

/// All results of one run.
#[derive(Debug, Clone, Serialize)]
pub struct RenderReport {
    pub made: Provenance,
    pub renderer: RendererInfo,
    pub size: Size,
    /// Error bounds against the intended result, for rows without tighter ones.
    pub bounds: variants::ErrorLimits,
    pub loads: Vec<RenderWorkloadSummary>,
    pub rows: Vec<RenderRow>,
    /// One entry per load.
    pub readback: Vec<ReadbackRates>,
    /// Times of the bare passes on each load.
    pub bare: Vec<MinimalPasses>,
    /// The same passes by CUDA and by OpenGL, where there is a CUDA device.
    pub raster: Vec<RasterComparison>,
    /// Times of the passes that compute the same moment map by compute and by fragment shaders.
    pub blurs: Vec<BlurComparison>,
    /// Plants of table 4.5, deformed and drawn.
    pub plants: Vec<PlantResult>,
    /// Unexpected results, as `load: variant: reason`: variants that failed, and variants that passed although they are
    /// stated to fail.
    pub failed: Vec<String>,
    /// Pictures for viewing.
    #[serde(skip)]
    pub pictures: Vec<ImageFile>,
}

/// Measures everything that is requested; `progress` receives a description of each stage.
///
/// # Errors
/// `Unavailable` without OpenGL; errors of loading and drawing a scene.
pub fn render(request: &RenderReportOptions, mut progress: impl FnMut(&str)) -> Result<RenderReport> {
    let mut studio = RenderHarness::open()?;
    let (mut loads, mut rows, mut bare, mut pictures) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut readback = Vec::new();
    for kind in &request.loads {
        progress(&format!("{}: building", kind.name()));
        let measured = measure::load(&mut studio, request, *kind, &mut progress)?;
        loads.push(measured.entry);
        rows.extend(measured.rows);
        bare.extend(measured.bare);
        pictures.extend(measured.files);
        progress(&format!("{}: reading back", kind.name()));
        readback.push(readback::measure(&mut studio, request, *kind)?);
    }
    let device = harness::cuda_device();
    let raster = match &device {
        Some(device) => raster_comparison::measure(&mut studio, device, request, &mut progress)?,
        None => Vec::new(),
    };
    let mut plants = Vec::new();
    for index in &request.plants {
        progress(&format!("plant-{}", index + 1));
        plants.push(plants::measure(&mut studio, device.as_ref(), request, *index)?);
    }
    let failed = rows.iter().filter(|row: &&RenderRow| !row.as_stated()).map(why);
    let failed = failed.chain(raster.iter().filter_map(RasterComparison::fault)).collect();
    let (made, renderer, bounds) = (Provenance::here(), studio.renderer.info().clone(), variants::ERROR_LIMITS);
    let blurs = BlurComparison::of(&rows);
    let size = request.size;
    Ok(RenderReport {
        made,
        renderer,
        size,
        bounds,
        loads,
        rows,
        readback,
        bare,
        raster,
        blurs,
        plants,
        failed,
        pictures,
    })
}

fn why(row: &RenderRow) -> String {
    let why = if row.passed { "keeps bounds that it is stated to exceed".into() } else { row.faults.join("; ") };
    format!("{}: {}: {why}", row.load, row.name)
}

impl RenderReport {
    /// Whether every variant passed or failed as stated.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }
}
