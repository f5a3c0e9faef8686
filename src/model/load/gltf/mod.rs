//! Loader of glTF 2.0 (`.gltf` and `.glb`). Each primitive of each node with a mesh becomes a domain; morph POSITION
//! targets become the columns of U (3n x r), weights become q, and nodes become transforms. Units are meters, Y is up.
//!
//! The JSON is parsed into our own structures, and all data is read with checked arithmetic. The `gltf` crate (1.4.1)
//! is not used: its validation panics on some inputs, overflowing counts silently yield zero elements, and extensions
//! that it was not built with are invisible, so that none of its checks could be relied on.

mod accessor;
mod assemble;
mod bytes;
mod container;
mod document;
mod hierarchy;
mod material;
mod primitive;
mod remarks;
#[cfg(test)]
mod tests;
mod texture;

use std::path::Path;

use crate::error::{Result, invalid};
use crate::scene::Parts;

use super::files::Files;
use bytes::Bytes;
use remarks::Remarks;

/// The largest file in bytes: the model itself, or a buffer or image next to it.
const MAX_FILE: u64 = 1 << 29;

/// Extensions that affect only the appearance of surfaces and lights; the geometry is correct without them.
const LOOK_ONLY: [&str; 4] = ["KHR_materials_", "KHR_texture_transform", "KHR_lights_punctual", "KHR_xmp"];

/// Reads the glTF or GLB file `path`. Its buffers and images must be in the file itself or in or below its folder.
///
/// # Errors
/// `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read(files: &Files, path: &str) -> Result<Parts> {
    let content = files.read(path, MAX_FILE)?;
    let folder = match Path::new(path).parent().and_then(Path::to_str) {
        None | Some("") => files.clone(),
        Some(parent) => files.within(parent)?,
    };
    let name = Path::new(path).file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
    parse(&folder, &name, &content).map_err(|error| error.within(&format!("file '{path}'")))
}

/// Parses the bytes of a file. Relative URIs start at `folder`.
fn parse(folder: &Files, name: &str, content: &[u8]) -> Result<Parts> {
    let container = container::split(content)?;
    let document = container::parse(container.json)?;
    let mut remarks = Remarks::default();
    check_version(&document)?;
    check_extensions(&document, &mut remarks)?;
    remark_on_what_is_left_out(&document, &mut remarks);
    let bytes = Bytes::load(&document, folder, container.bin)?;
    assemble::assemble(name, &document, &bytes, remarks)
}

fn check_version(document: &document::Document) -> Result<()> {
    let asset = &document.asset;
    // A later minor version is compatible unless the file requires it as minimum.
    if asset.version.starts_with("2.") && asset.min_version.as_ref().is_none_or(|least| least == "2.0") {
        return Ok(());
    }
    let given = format!("'{}' with minVersion {:?}", remarks::tidy(&asset.version, 20), asset.min_version);
    Err(invalid("asset.version", "2.0", remarks::tidy(&given, 80)))
}

fn check_extensions(document: &document::Document, remarks: &mut Remarks) -> Result<()> {
    let look_only = |name: &str| LOOK_ONLY.iter().any(|start| name.starts_with(start));
    for (at, name) in document.extensions_required.iter().enumerate() {
        if !look_only(name) {
            let field = format!("extensionsRequired[{at}]");
            return Err(invalid(field, "an extension that is supported here (none that changes geometry is)", name));
        }
    }
    for name in document.extensions_used.iter().chain(&document.extensions_required) {
        remarks.add(format!("the extension {name} is not supported: ignored"));
    }
    Ok(())
}

fn remark_on_what_is_left_out(document: &document::Document, remarks: &mut Remarks) {
    for (count, what, why) in [
        (document.animations.len(), "animations", "motion comes from the physics process"),
        (document.skins.len(), "skins", "meshes keep their bind pose"),
        (document.cameras.len(), "cameras", "frames bring their own"),
    ] {
        if count > 0 {
            remarks.add(format!("{what} ({count}) are ignored: {why}"));
        }
    }
}

/// The element `index` of a list; an error names the list.
fn at<'a, T>(list: &'a [T], index: usize, field: &str) -> Result<&'a T> {
    list.get(index).ok_or_else(|| invalid(field, format!("an index below {}", list.len()), index))
}
