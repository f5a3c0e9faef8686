//! Benchmarks of CUDA kernels: the server's own kernels on inputs that are uploaded in advance, and kernels that the
//! server does not use. Every benchmark implements `KernelBenchmark`, the interface for timing its kernels and for
//! validating its positions.
//!
//! | file | contents |
//! |---|---|
//! | `kernel_benchmark` | the `KernelBenchmark` trait, compilation, and attributes such as register counts |
//! | `input_sets` | inputs of several steps, uploaded before timing starts |
//! | `timer` | timing by CUDA graphs and events |
//! | `bandwidth` | kernels that copy, read and fill device memory |
//! | `device_bandwidth` | peak bandwidths of the device, for comparison |
//! | `deformer_kernels` | the server's kernels that deform |
//! | `batch_mma` | x = T (x0 + U q) for many domains that share U, by tensor cores |
//! | `upload` | host-to-device upload of a step's values |
//! | `overlap` | steps whose vertices are read back to the host, serial and overlapped |
//! | `cublas`, `plain_update` | u = U q by cuBLAS, and the update x = T (x0 + u) that follows it |
//! | `raster` | the server's CUDA rasterizer, without OpenGL |
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
pub use input_sets::StepPart;
pub use kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
pub use overlap::{HostWrite, Overlap, measure_overlap, time_host_writes};
pub use raster::{RasterBenchmark, RasterCounts, RasterMesh};
pub use thesis::{KernelSplit, LaneCounts, ThesisBenchmark, count_lanes, idle_lanes_per_warp};
pub use timer::{gigabytes_per_second, time_empty_kernel, time_steps, time_stream};
pub use upload::time_upload;
