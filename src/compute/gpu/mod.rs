//! CUDA: one launcher per kernel, with the kernel's name.
//!
//! Kernels live in `kernels/*.cu`; NVRTC compiles them for the device that is there, with the parts that the scene
//! needs ([`plan()`]), and a cache on disk keeps the machine code. A step is one graph: a copy to the device, at most four
//! launches whatever the number of domains, straight into OpenGL's buffers when the driver shares them, and the bounds
//! on their way back.
//!
//! ```text
//! inputs -> [apply or batch] -> deform -> bounds -> [normals] -> answer
//! ```
//! `apply` is there in steps that change few domains, `batch` in the others where domains share a large U, `normals` where
//! normals follow the deformed surface.
//!
//! | file | what |
//! |---|---|
//! | `plan` | scene to kernels with their macros, buffers and launches |
//! | `work`, `pack`, `rings`, `layout` | scene to the tables that kernels read; pure |
//! | `inputs`, `staging` | the values of a step on their way to the device |
//! | `apply`, `batch`, `deform`, `bounds`, `normals` | the launchers |
//! | `chain` | a launch that begins while the kernel before it ends |
//! | `deformer`, `flight` | the graph of a step, its pinned memory and its answer |
//! | `output`, `interop` | where the vertices go |
//! | `boxes` | a box of each domain, where the scene keeps them |
//! | `rotation` | which of two outputs a step writes while the other is read, and what it lacks; pure |
//! | `fetch` | vertices on their way to the host, beside the next step |
//! | `raster` | triangles to samples in OpenGL's buffers, beside OpenGL's own rasteriser |
//! | `device`, `memory`, `compile` | the device, its buffers, its machine code |
//! | `probe`, `report` | what is there, and whether the device agrees on layouts |

pub mod apply;
mod batch;
pub mod bounds;
mod boxes;
mod chain;
mod compile;
pub mod deform;
mod deformer;
mod device;
mod fetch;
mod flight;
pub mod inputs;
mod interop;
pub mod layout;
pub mod memory;
pub mod normals;
mod output;
mod pack;
pub mod plan;
mod probe;
pub mod raster;
mod report;
mod rings;
mod rotation;
pub mod staging;
pub mod work;

#[cfg(any(test, feature = "testing"))]
pub use compile::{Assembled, assert_compiles};
pub use deformer::{CudaDeformer, MOST_UNDER_WAY};
pub use device::Device;
pub use layout::{Agreement, agreements};
pub use plan::{Buffer, Kernel, Launch, LeftOut, Plan, Role, plan};
pub use probe::{DeviceInfo, Probe, probe};
pub use raster::{GlRaster, RasterForm, Spread};
pub use report::device_values;
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
