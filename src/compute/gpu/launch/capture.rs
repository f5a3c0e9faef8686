//! Captures the work that a function submits to the device's stream as a CUDA graph.

use std::sync::Arc;

use cudarc::driver::CudaGraph;
use cudarc::driver::sys::{CUgraphInstantiate_flags, CUstreamCaptureMode};

use super::cleanup::with_cleanup;
use super::device::Device;
use super::error::cuda_error;
use modalcast_model::error::{Error, Result};

/// Captures the work that `submit` submits to the device's stream, without running it. The capture also ends when
/// `submit` returns an error or panics. Otherwise the stream would stay in capture mode and refuse the work of all
/// scenes.
///
/// The graph refers to the memory that the work uses. The caller launches it only while that memory exists.
///
/// # Errors
/// The error of `submit`; `Fault` when the work cannot be captured, or when nothing was submitted.
pub fn capture(device: &Device, submit: impl FnOnce() -> Result<()>) -> Result<CudaGraph> {
    let stage = "capture";
    let stream = Arc::clone(device.stream());
    // Relaxed, because access to pinned memory and calls of libraries query the driver, which stricter modes forbid.
    stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED).map_err(cuda_error(stage))?;
    let (submitted, graph) = with_cleanup(submit, || {
        stream.end_capture(CUgraphInstantiate_flags::CUDA_GRAPH_INSTANTIATE_FLAG_AUTO_FREE_ON_LAUNCH)
    });
    submitted?;
    let nothing_submitted = || Error::Fault { stage, reason: "expected submitted work, got none".into() };
    graph.map_err(cuda_error(stage))?.ok_or_else(nothing_submitted)
}
