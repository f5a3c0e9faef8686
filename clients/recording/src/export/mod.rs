//! Converts recordings to other formats.

mod glb;
mod gltf;
mod html;
mod npz;
mod tracks;
mod video;

pub use gltf::export_gltf;
pub use html::export_html;
pub use npz::export_npz;
pub use video::{VideoEncoder, VideoSettings};
