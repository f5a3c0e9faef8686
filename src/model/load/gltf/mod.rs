//! Loader of glTF 2.0 (`.gltf` and `.glb`). Each primitive of each node with a mesh becomes a domain; morph POSITION
//! targets become the columns of U (3n x r), weights become q, and nodes become transforms. Units are meters, Y is up.
//!
//! The JSON is parsed into our own structures, and all data is read with checked arithmetic. The `gltf` crate (1.4.1)
//! is not used for three reasons: its validation panics on some inputs, overflowing counts silently yield zero
//! elements, and it hides extensions that it was not built with.

mod accessor;
mod assemble;
mod buffers;
mod container;
mod document;
mod extensions;
mod hierarchy;
mod material;
mod primitive;
mod remarks;
mod skin;
#[cfg(test)]
mod tests;
mod texture;

use std::path::Path;

use crate::domain::CreaseAngle;
use crate::error::{Result, invalid};
use crate::scene::SceneParts;

use super::asset_dir::AssetDir;
use buffers::GltfBuffers;
use remarks::ImportRemarks;

/// The largest file in bytes: the model itself, or a buffer or image next to it.
const MAX_FILE_BYTES: u64 = 1 << 29;

/// Reads the glTF or GLB file `path`. Its buffers and images must be in the file itself or in or below its folder.
///
/// # Errors
/// `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read(files: &AssetDir, path: &str, crease_angle: CreaseAngle) -> Result<SceneParts> {
    let content = files.read(path, MAX_FILE_BYTES)?;
    let folder = match Path::new(path).parent().and_then(Path::to_str) {
        None | Some("") => files.clone(),
        Some(parent) => files.within(parent)?,
    };
    let name = Path::new(path).file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
    parse(&folder, &name, &content, crease_angle).map_err(|error| error.prefix_field(&format!("file '{path}'")))
}

/// Parses the bytes of a file. Relative URIs start at `folder`.
fn parse(folder: &AssetDir, name: &str, content: &[u8], crease_angle: CreaseAngle) -> Result<SceneParts> {
    let container = container::split_container(content)?;
    let document = container::parse_document(container.json)?;
    let mut remarks = ImportRemarks::default();
    check_version(&document)?;
    let extension = if container::is_binary(content) { "glb" } else { "gltf" };
    extensions::check(&document, folder.is_strict(), &format!("{name}.{extension}"), &mut remarks)?;
    report_ignored_features(&document, &mut remarks);
    let buffers = GltfBuffers::load(&document, folder, container.bin)?;
    assemble::assemble(name, &document, &buffers, crease_angle, remarks)
}

fn check_version(document: &document::Document) -> Result<()> {
    let asset = &document.asset;
    // A later minor version is compatible unless the file requires it as minimum.
    if asset.version.starts_with("2.") && asset.min_version.as_ref().is_none_or(|min_version| min_version == "2.0") {
        return Ok(());
    }
    let given = format!("'{}' with minVersion {:?}", remarks::sanitize(&asset.version, 20), asset.min_version);
    Err(invalid("asset.version", "2.0", remarks::sanitize(&given, 80)))
}

fn report_ignored_features(document: &document::Document, remarks: &mut ImportRemarks) {
    for (count, feature, reason) in [
        (document.animations.len(), "animations", "simulations provide the motion"),
        (document.cameras.len(), "cameras", "clients provide the cameras"),
    ] {
        if count > 0 {
            remarks.add(format!("{feature} ({count}) are ignored: {reason}"));
        }
    }
}

/// The element `index` of a list. `field` is the field of an error.
fn get_element<'a, T>(list: &'a [T], index: usize, field: &str) -> Result<&'a T> {
    list.get(index).ok_or_else(|| invalid(field, format!("an index below {}", list.len()), index))
}
