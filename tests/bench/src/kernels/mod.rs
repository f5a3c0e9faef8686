//! Benchmark kernels and their launchers; the server uses none of them. Each implements `KernelBenchmark`: its kernels
//! are timed without copies, and its positions are validated.
//!
//! | file | contents |
//! |---|---|
//! | `kernel_benchmark` | the `KernelBenchmark` trait, and the driver's attributes of kernels |
//! | `input_sets` | inputs of several steps, uploaded before timing starts |
//! | `timer` | timing by CUDA graphs and events |
//! | `bandwidth` | kernels that copy, read and fill device memory |
//! | `device_bandwidth` | peak bandwidths of the device, for comparison |
//! | `deformer_kernels` | the deformer's own kernels |
//! | `batch_mma` | many vectors q of one U by tensor cores, with their own summation order and rounding |
//! | `upload` | host-to-device upload of a step's values |
//! | `overlap` | steps with readback by the host, serial and overlapped |
//! | `cublas`, `plain_update` | products by cuBLAS, and the vertex update that follows them |
//! | `raster` | the CUDA rasterizer with its own positions and samples |
//! | `thesis` | the kernels of the thesis |

mod bandwidth;
mod batch_mma;
mod cublas;
mod deformer_kernels;
mod device_bandwidth;
mod input_sets;
mod kernel_benchmark;
mod overlap;
mod plain_update;
mod raster;
mod thesis;
mod timer;
mod upload;

pub use batch_mma::BatchMmaBenchmark;
pub use cublas::{CublasBenchmark, CublasMethod, cublas_version};
pub use deformer_kernels::{BenchmarkStep, DeformerBenchmark, StepOutputs};
pub use device_bandwidth::{DeviceBandwidth, measure_bandwidth};
pub use input_sets::Part;
pub use kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
pub use overlap::{HostWrite, Overlap, measure_overlap, time_host_writes};
pub use raster::{RasterBenchmark, RasterCounts, RasterMesh};
pub use thesis::{KernelSplit, LaneCounts, ThesisBenchmark, count_lanes, idle_lanes_per_warp};
pub use timer::{gigabytes_per_second, time_empty_kernel, time_steps};
pub use upload::time_upload;
