//! glTF and GLB files to scenes: each primitive is a domain.

use crate::error::{Result, invalid};
use crate::scene::Parts;

use super::files::Files;

/// Reads the glTF or GLB file `path`.
///
/// # Errors
/// `Invalid` naming the place in the file.
pub(super) fn read(files: &Files, path: &str) -> Result<Parts> {
    files.resolve(path)?;
    Err(invalid(format!("file '{path}'"), "a format that this build reads", "glTF"))
}
