//! The CUDA backend: one launcher module per kernel, with the name of the kernel.
//!
//! The kernels are in `kernels/*.cu`. NVRTC compiles them at run time for the device that is present, with only the
//! features that the scene needs ([`plan`]), and a disk cache keeps the machine code. A step is one CUDA graph: a
//! host-to-device copy, at most four kernel launches for any number of domains, and a readback of the bounds. The
//! kernels write directly into OpenGL's buffers when the driver shares them.
//!
//! ```text
//! inputs -> [apply or batch] -> deform -> bounds -> [normals] -> answer
//! ```
//! A partial step, which changes few domains, launches `apply`. A full step launches `batch` if the scene has domains
//! that share a large U. `normals` is launched if normals follow the deformed surface.
//!
//! | file | content |
//! |---|---|
//! | `plan` | derives the kernels with their macros, the buffers and the launches from the scene |
//! | `work`, `pack`, `rings`, `layout` | derive the tables that the kernels read from the scene; pure |
//! | `inputs`, `staging` | the input values of a step and their upload |
//! | `apply`, `batch`, `deform`, `bounds`, `normals` | the launchers |
//! | `chain` | programmatic dependent launch: a launch that overlaps the end of the kernel before it |
//! | `deformer`, `flight` | the graph of a step, its pinned memory and the readback of its bounds |
//! | `output`, `interop` | the output buffers |
//! | `boxes` | a bounding box per domain, if the scene asks for them |
//! | `rotation` | double buffering of the outputs: which one a step writes and which domains it lacks; pure |
//! | `fetch` | asynchronous readback of vertices, concurrent with the next step |
//! | `raster` | compute rasterizer: triangles to samples in OpenGL's buffers, next to OpenGL's own rasterizer |
//! | `device`, `memory`, `compile` | the device, its buffers, its machine code |
//! | `probe`, `report` | device capabilities; check that host and device agree on struct layouts |
//! | `trials` | benchmark kernels |

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
/// Names of the OpenGL buffers that receive the output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GlBuffers {
    /// 3 f32 per vertex.
    pub positions: u32,
    /// 3 f32 per corner.
    pub normals: u32,
    /// 4 f32 per corner; only if the scene has normal maps.
    pub tangents: Option<u32>,
}
