//! Benchmark kernels and their launchers; the server uses none of them. A `Trial` is one way to deform: its kernels are
//! timed without copies, and its positions are validated.
//!
//! | file | contents |
//! |---|---|
//! | `trial` | the `Trial` trait, and the driver's facts about kernels |
//! | `turns` | inputs of several steps, uploaded before timing starts |
//! | `measure` | timing by CUDA graphs and events |
//! | `roof` | the best memory rates of the device, for comparison |
//! | `ours` | the deformer's own kernels as a trial |
//! | `batch_mma` | many vectors q of one U at once by tensor cores, with their own summation order and rounding |
//! | `ingest` | host-to-device upload of a step's values |
//! | `overlap` | steps with readback by the host, serial and overlapped |
//! | `cublas`, [`plain_update`] | products by cuBLAS, and the vertex update that follows them |
//! | `raster` | the CUDA rasterizer on its own positions and samples |
//! | `thesis` | the kernels of the thesis |

mod batch_mma;
mod cublas;
mod ingest;
mod measure;
mod ours;
mod overlap;
mod plain_update;
mod raster;
mod roof;
mod thesis;
mod trial;
mod turns;

pub use batch_mma::BatchMma;
pub use cublas::{Cublas, Peer, cublas_version};
pub use ingest::ingest;
pub use measure::{Cache, Timing, empty_replay, gigabytes_per_second, time};
pub use ours::{Extent, Ours};
pub use overlap::{HostWrite, Overlap, host_writes, overlap};
pub use raster::{Raster, RasterCounts, RasterMesh};
pub use roof::{Roofs, roofs};
pub use thesis::{Lanes, Split, Thesis, idle_in_warp, lanes};
pub use trial::{KernelFacts, Trial};
pub use turns::Part;
