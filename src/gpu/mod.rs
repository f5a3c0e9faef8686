//! CUDA: one launcher per kernel, with the kernel's name.
//!
//! Kernels live in `kernels/*.cu`; NVRTC compiles them for the device that is there, with the parts that the scene
//! needs ([`plan`]), and a cache on disk keeps the machine code. All domains of a scene go through two launches a step,
//! straight into OpenGL's buffers when the driver shares them.

mod apply;
mod batch;
mod bounds;
mod cache;
mod cublas;
mod deform;
mod deformer;
mod device;
mod ingest;
mod inputs;
mod interop;
mod layout;
mod measure;
mod memory;
mod normals;
mod nvrtc;
mod ours;
mod output;
mod pack;
mod plain_update;
mod plan;
mod probe;
mod report;
mod rings;
mod roof;
mod thesis;
mod trial;
mod turns;
mod work;

pub use batch::Batch;
pub use cublas::{Cublas, Peer, cublas_version};
pub use deformer::CudaDeformer;
pub use device::Device;
pub use ingest::ingest;
pub use layout::{Agreement, agreements};
pub use measure::{Cache, Timing, empty_replay, gigabytes_per_second, time};
pub use ours::{Extent, Ours};
pub use plan::{Buffer, Kernel, Launch, LeftOut, Plan, Role, plan};
pub use probe::{DeviceInfo, Probe, probe};
pub use report::device_values;
pub use roof::{Roofs, roofs};
pub use thesis::{Lanes, Split, Thesis, idle_in_warp, lanes};
pub use trial::{KernelFacts, Trial};
pub use turns::Part;

/// OpenGL buffers to write into, by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GlBuffers {
    /// 3 f32 per vertex.
    pub positions: u32,
    /// 3 f32 per corner.
    pub normals: u32,
    /// 4 f32 per corner, when the scene has normal maps.
    pub tangents: Option<u32>,
}
