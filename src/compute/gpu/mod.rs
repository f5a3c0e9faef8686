//! The CUDA backend: one launcher module per kernel, with the name of the kernel.
//!
//! The kernels are in `kernels/*.cu`. NVRTC compiles them at run time for the device that is present, with only the
//! features that the scene needs ([`plan()`]), and a disk cache keeps the machine code. A step is one CUDA graph: a
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
//! | `work`, `normal_tables`, `rings`, `layout` | derive the tables that the kernels read from the scene; pure |
//! | `inputs`, `staging` | the input values of a step and their upload |
//! | `apply`, `batch`, `deform`, `bounds`, `normals` | the launchers |
//! | `dependent_launch` | programmatic dependent launch: a launch that overlaps the end of the kernel before it |
//! | `deformer`, `step_slot` | the graph of a step, its pinned memory and the readback of its bounds |
//! | `output`, `interop` | the output buffers |
//! | `boxes` | a bounding box per domain, if the scene asks for them |
//! | `output_ring` | double buffering of the outputs: which one a step writes and which domains it lacks; pure |
//! | `readback` | asynchronous readback of vertices, concurrent with the next step |
//! | `raster` | compute rasterizer: triangles to samples in OpenGL's buffers, next to OpenGL's own rasterizer |
//! | `device`, `memory`, `compile` | the device, its buffers, its machine code |
//! | `probe`, `layout_check` | device capabilities; check that host and device agree on struct layouts |
//! | `benchmarks` | benchmark kernels |

pub mod apply;
mod batch;
pub mod bounds;
mod boxes;
mod compile;
pub mod deform;
mod deformer;
mod dependent_launch;
mod device;
pub mod inputs;
mod interop;
pub mod layout;
mod layout_check;
pub mod memory;
mod normal_tables;
pub mod normals;
mod output;
mod output_ring;
pub mod plan;
mod probe;
pub mod raster;
mod readback;
mod rings;
pub mod staging;
mod step_slot;
pub mod work;

#[cfg(any(test, feature = "testing"))]
pub use compile::{CompiledVariant, assert_compiles};
pub use deformer::{CudaDeformer, MAX_STEPS_IN_FLIGHT};
pub use device::Device;
pub use layout::{LayoutConstant, layout_constants};
pub use layout_check::device_layout_values;
pub use plan::{BufferDescriptor, BufferRole, DeformPlan, KernelDescriptor, KernelKind, OmittedFeature, plan};
pub use probe::{DeviceInfo, Probe, probe};
pub use raster::{CudaRasterizer, RasterGranularity, RasterVariant};
