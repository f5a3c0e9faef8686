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

use crate::error::{Error, Result};

/// Checks a factor of slow motion.
fn check_slow(slow: f64) -> Result<()> {
    match slow.is_finite() && slow > 0.0 {
        true => Ok(()),
        false => Err(Error::invalid("slow", "a finite number above 0", slow)),
    }
}
