//! The report of `modalcast report render --raster`: the CUDA rasterizer compared with OpenGL on single passes and on
//! whole frames.

use std::path::Path;

use serde::Serialize;

use super::frame_comparison::{self, FrameComparison};
use super::harness::{RenderHarness, Size};
use super::raster_comparison::{self, RasterComparison};
use super::{RenderReportOptions, comparison_tables};
use crate::provenance::Provenance;
use modalcast_compute::gpu::Device;
use modalcast_model::error::{Result, fault_in};
use modalcast_render::RendererInfo;

/// Results of all workloads.
#[derive(Debug, Clone, Serialize)]
pub struct RasterReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    pub renderer: RendererInfo,
    pub size: Size,
    /// Single passes, one entry per workload.
    pub rows: Vec<RasterComparison>,
    /// Whole frames, one entry per workload.
    pub frames: Vec<FrameComparison>,
}

impl RasterReport {
    /// Writes `raster.json` and `raster.md` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("report"))?;
        let json = serde_json::to_vec_pretty(self).map_err(fault_in("report"))?;
        let markdown = format!(
            "{}\n\n{}; {} x {} pixels.\n{}{}",
            self.provenance.line(),
            self.renderer.renderer,
            self.size.width,
            self.size.height,
            comparison_tables::raster_section(&self.rows),
            frame_comparison::markdown(&self.frames)
        );
        for (name, bytes) in [("raster.json", json), ("raster.md", markdown.into_bytes())] {
            std::fs::write(folder.join(name), bytes).map_err(fault_in("report"))?;
        }
        Ok(())
    }

    /// Whether all passes and frames were timed.
    pub fn passed(&self) -> bool {
        self.rows.iter().all(|row| row.passes.is_some()) && self.frames.iter().all(|frame| frame.cuda.is_some())
    }
}

/// Compares the rasterizers on all workloads; `progress` receives a description of each stage.
///
/// # Errors
/// `Unavailable` without OpenGL, a CUDA device or NVRTC; errors of loading and drawing a scene.
pub fn compare_rasterizers(options: &RenderReportOptions, mut progress: impl FnMut(&str)) -> Result<RasterReport> {
    let device = Device::open(0)?;
    device.check_compiler()?;
    let mut harness = RenderHarness::open()?;
    let rows = raster_comparison::measure(&mut harness, &device, options, &mut progress)?;
    let frames = frame_comparison::measure(&mut harness, &device, options, &mut progress)?;
    let renderer = harness.renderer.info().clone();
    Ok(RasterReport { provenance: Provenance::collect(), renderer, size: options.size, rows, frames })
}
