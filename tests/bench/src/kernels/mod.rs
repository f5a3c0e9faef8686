//! What only measures: no server runs any of it. A `Trial` is one way to deform, timed as kernels alone and judged by
//! its positions.
//!
//! | file | what |
//! |---|---|
//! | `trial` | what a trial is, and what the driver says of its kernels |
//! | `turns` | values of several steps that lie on the device before the clock starts |
//! | `measure` | the stopwatch |
//! | `roof` | the best rates of the device, to compare with |
//! | `ours` | the deformer's own kernels as a trial |
//! | `batch_mma` | many vectors q of one U at once by tensor cores, with an order and a rounding of its own |
//! | `ingest` | the way of a step's values to the device |
//! | `overlap` | steps that the host reads, one after the other and side by side |
//! | `cublas`, [`plain_update`] | a library's products, and the vertex update behind them |
//! | `raster` | the rasteriser on positions and samples of its own |
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
