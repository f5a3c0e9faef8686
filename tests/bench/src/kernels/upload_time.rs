//! Times the upload of a step's header, transforms and q from pinned memory to the device, without any kernel.

use std::cell::RefCell;
use std::sync::Arc;

use super::kernel_benchmark::KernelBenchmark;
use super::timer::{Cache, Timing, time};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::inputs::{DirtyTileLayout, InputPacker, StagingBuffer, StepInputs};
use modalcast_compute::gpu::layout::Header;
use modalcast_compute::gpu::work::CoordinateLayout;
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneState};

/// The upload of whole steps as a trial.
struct UploadBenchmark(StepInputs, RefCell<StagingBuffer>);

impl KernelBenchmark for UploadBenchmark {
    fn name(&self) -> String {
        "ingest".into()
    }

    fn turns(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _turn: usize) -> Result<()> {
        self.0.send(device, &mut self.1.borrow_mut(), None)
    }

    fn launches(&self) -> usize {
        0
    }
}

/// Bytes of a whole step's values, and the time of their upload as a graph of its own.
///
/// # Errors
/// `Fault` when the device fails; `Invalid` when `replays` is 0.
pub fn ingest(device: &Device, scene: &Arc<Scene>, state: &SceneState, replays: usize) -> Result<(u64, Timing)> {
    let coordinates = CoordinateLayout::new(scene);
    // Only the number of bytes matters here, so factors and tiles are empty.
    let factors = vec![Vec::new(); scene.shapes.len()];
    let packing =
        InputPacker { scene: Arc::clone(scene), coordinates, factors, dirty_tile_layout: DirtyTileLayout::default() };
    let mut inputs = StepInputs::new(device, &Arc::new(packing))?;
    let mut staging = inputs.staging(device)?;
    inputs.write(&mut staging, &Header::default(), state)?;
    let bytes = inputs.bytes();
    let ingest = UploadBenchmark(inputs, RefCell::new(staging));
    Ok((bytes, time(device, &ingest, Cache::Warm, replays)?))
}
