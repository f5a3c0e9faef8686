//! Benchmark kernels and their launchers; the server uses none of them. Each implements `KernelBenchmark`: its kernels
//! are timed without copies, and its positions are validated.
//!
//! | file | contents |
//! |---|---|
//! | `kernel_benchmark` | the `KernelBenchmark` trait, and the driver's attributes of kernels |
//! | `input_sets` | inputs of several steps, uploaded before timing starts |
//! | `timer` | timing by CUDA graphs and events |
//! | `bandwidth` | kernels that copy, read and fill device memory |
//! | `memory_roofs` | peak bandwidths of the device, for comparison |
//! | `deformer_kernels` | the deformer's own kernels |
//! | `batch_mma` | many vectors q of one U by tensor cores, with their own summation order and rounding |
//! | `upload_time` | host-to-device upload of a step's values |
//! | `overlap` | steps with readback by the host, serial and overlapped |
//! | `cublas`, `plain_update` | products by cuBLAS, and the vertex update that follows them |
//! | `raster` | the CUDA rasterizer with its own positions and samples |
//! | `thesis` | the kernels of the thesis |

mod bandwidth;
mod batch_mma;
mod cublas;
mod deformer_kernels;
mod input_sets;
mod kernel_benchmark;
mod memory_roofs;
mod overlap;
mod plain_update;
mod raster;
mod thesis;
mod timer;
mod upload_time;

pub use batch_mma::BatchMmaBenchmark;
pub use cublas::{CublasBenchmark, CublasMethod, cublas_version};
pub use deformer_kernels::{BenchmarkStep, DeformerBenchmark, StepOutputs};
pub use input_sets::Part;
pub use kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
pub use memory_roofs::{Roofs, roofs};
pub use overlap::{HostWrite, Overlap, host_writes, overlap};
pub use raster::{RasterBenchmark, RasterCounts, RasterMesh};
pub use thesis::{KernelSplit, LaneCounts, ThesisBenchmark, count_lanes, idle_lanes_per_warp};
pub use timer::{empty_replay, gigabytes_per_second, time};
pub use upload_time::time_upload;
