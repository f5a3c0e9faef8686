//! Tests of the CUDA deformer, the CUDA rasterizer and the CUDA PNG encoder. They are ignored by default because they
//! need a GPU; run them with `--include-ignored --test-threads=1`. The test binary also runs on a machine without the
//! source tree. It reads real inputs from the folder MODALCAST_DATA.

mod accuracy;
mod batch;
#[path = "../common/mod.rs"]
mod common;
mod cuda_checks;
mod device;
mod extremes;
#[cfg(feature = "fault-injection")]
mod faults;
mod frame_info;
mod gl;
#[expect(dead_code, reason = "shared with the benchmarks")]
mod instanced_scenes;
mod interop;
mod light;
mod normals;
mod overlap;
mod png;
mod raster_backends;
mod raster_gl;
mod real;
mod reference_comparison;
mod scenes;
mod shared_memory;
