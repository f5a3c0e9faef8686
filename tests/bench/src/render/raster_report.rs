//! The report of `modalcast report render --raster`: the CUDA rasterizer compared with OpenGL on single passes and on whole
//! frames.

use std::path::Path;

use serde::Serialize;

use super::frame_comparison::{self, FrameComparison};
use super::harness::{RenderHarness, Size};
use super::raster_comparison::{RasterComparison, measure};
use super::{RenderReportOptions, comparison_tables};
use crate::provenance::Provenance;
use modalcast_compute::gpu::Device;
use modalcast_model::error::{Result, fault_in};
use modalcast_render::RendererInfo;

/// Results of all loads.
#[derive(Debug, Clone, Serialize)]
pub struct RasterReport {
    pub made: Provenance,
    pub renderer: RendererInfo,
    pub size: Size,
    pub rows: Vec<RasterComparison>,
    /// Whole frames.
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
            self.made.line(),
            self.renderer.renderer,
            self.size.width,
            self.size.height,
            comparison_tables::raster(&self.rows),
            frame_comparison::markdown(&self.frames)
        );
        for (name, bytes) in [("raster.json", json), ("raster.md", markdown.into_bytes())] {
            std::fs::write(folder.join(name), bytes).map_err(fault_in("report"))?;
        }
        Ok(())
    }

    /// Whether everything was timed.
    pub fn passed(&self) -> bool {
        self.rows.iter().all(|row| row.passes.is_some()) && frame_comparison::faults(&self.frames).is_empty()
    }
}

/// Measures these passes and nothing else; `progress` receives a description of each stage.
///
/// # Errors
/// `Unavailable` without OpenGL, a CUDA device or NVRTC; errors of loading and drawing a scene.
pub fn rasters(request: &RenderReportOptions, mut progress: impl FnMut(&str)) -> Result<RasterReport> {
    let device = Device::open(0)?;
    device.check_compiler()?;
    let mut studio = RenderHarness::open()?;
    let rows = measure(&mut studio, &device, request, &mut progress)?;
    let frames = frame_comparison::measure(&mut studio, &device, request, &mut progress)?;
    let renderer = studio.renderer.info().clone();
    Ok(RasterReport { made: Provenance::here(), renderer, size: request.size, rows, frames })
}
