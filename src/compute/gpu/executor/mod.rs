//! The deformer and the rasterizer on the device: launchers, steps in flight, outputs, readbacks and interop.
//!
//! | file | content |
//! |---|---|
//! | `deformer`, `step_slot` | the graph of a step, its pinned memory and the readback of its bounds |
//! | `launchers` | one launcher per kernel of a step |
//! | `inputs` | the input values of a step on the device |
//! | `output`, `interop` | the output buffers |
//! | `output_ring` | double buffering of the outputs: the output that a step writes, and its outdated domains |
//! | `readback`, `pinned_surface` | asynchronous readback of vertices, concurrent with the next step |
//! | `picture` | pictures that OpenGL draws and CUDA copies to the host |
//! | `pinned_pixels` | host memory of pictures, which readers share |
//! | `raster` | compute rasterizer, which draws into OpenGL's buffers or shared memory |
//! | `views`, `view_ring` | batches of small views, and exported memory for their pictures |
//! | `texture` | images as textures |
//! | `shared_range` | ranges of memory that CUDA shares with OpenGL |
//! | `png` | PNG encoder, from pixels in device memory to a file in pinned memory |
//! | `layout_check` | check that host and device agree on struct layouts |

mod deformer;
pub(crate) mod inputs;
mod interop;
pub(crate) mod launchers;
mod layout_check;
mod output;
mod output_ring;
mod picture;
mod picture_encoder;
mod pinned_pixels;
mod pinned_surface;
pub(crate) mod png;
pub(crate) mod raster;
mod readback;
mod shared_range;
mod step_slot;
mod texture;
pub(crate) mod view_ring;
pub(crate) mod views;

pub use deformer::{CudaDeformer, MAX_STEPS_IN_FLIGHT, PreparedDeformer};
pub use layout_check::device_layout_values;
pub use picture::CudaPictureMemory;
pub use pinned_pixels::{PinnedArray, PinnedPool};
