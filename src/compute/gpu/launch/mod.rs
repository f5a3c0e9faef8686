//! Access to a CUDA device: context, memory, compilation, launches and graphs. Independent of scenes.
//!
//! | file | content |
//! |---|---|
//! | `device` | the device and its stream |
//! | `context` | a context that is current on a thread |
//! | `memory` | device buffers and pinned host memory |
//! | `exported_memory` | device memory that OpenGL can import |
//! | `kernel` | descriptors of kernels, and their launch |
//! | `capture` | CUDA graphs |
//! | `compile` | machine code by NVRTC, and its cache |
//! | `cleanup` | cleanup that also runs when work panics |
//! | `error` | conversion of driver errors; a lost device differs from other faults |
//! | `probe` | the CUDA components of this machine |

mod capture;
pub(crate) mod cleanup;
pub(crate) mod compile;
pub(crate) mod context;
mod device;
pub(crate) mod error;
mod exported_memory;
mod kernel;
mod memory;
mod probe;

pub use capture::capture;
#[cfg(any(test, feature = "testing"))]
pub use compile::{CAPABILITIES, CompiledVariant, assert_compiles};
pub use device::Device;
pub(crate) use exported_memory::ExportedMemory;
pub use kernel::{KernelDescriptor, KernelKind, LaunchOrder, launch_kernel};
pub(crate) use kernel::{KernelSource, KernelText};
pub use memory::{DeviceBuffer, PinnedBuffer, PinnedUse};
pub(crate) use memory::{PageLock, download};
pub use probe::{DeviceInfo, Probe, probe};
