//! Times the upload of a step's header, transforms and q from pinned memory to the device, without any kernel.

use std::sync::Arc;

use super::kernel_benchmark::KernelBenchmark;
use super::timer::time_steps;
use crate::timing::{CacheState, Timing};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::step_input::{InputPacker, InputPart, StagingBuffer, StepHeader, StepInputs};
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneState};

/// Uploads the inputs of one step. It launches no kernel.
struct UploadBenchmark {
    inputs: StepInputs,
    staging: StagingBuffer,
}

impl KernelBenchmark for UploadBenchmark {
    fn name(&self) -> String {
        "upload".into()
    }

    fn input_set_count(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _input_set: usize) -> Result<()> {
        // SAFETY: `time_steps` waits for all replays, so no copy runs when `self` is dropped. Nothing writes the
        // staging buffer while copies run.
        unsafe { self.inputs.send(device, &self.staging, InputPart::All) }
    }

    fn launches_per_step(&self) -> usize {
        0
    }
}

/// Bytes of the inputs of one step, and the time of a graph that only uploads them.
///
/// # Errors
/// `Fault` when the device fails; `Invalid` when `replays` is 0.
pub fn time_upload(device: &Device, scene: &Arc<Scene>, state: &SceneState, replays: usize) -> Result<(u64, Timing)> {
    // `sizes_only` packs wrong values of the right sizes. The values do not affect the time of a copy.
    let inputs = StepInputs::new(device, &Arc::new(InputPacker::sizes_only(scene)))?;
    let mut staging = inputs.allocate_staging(device)?;
    inputs.write(&mut staging, &StepHeader::default(), state)?;
    let bytes = inputs.bytes();
    let benchmark = UploadBenchmark { inputs, staging };
    Ok((bytes, time_steps(device, &benchmark, CacheState::Warm, replays)?))
}
