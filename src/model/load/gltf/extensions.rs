//! The extensions of a document: which are read, which can be ignored, and which make it impossible to read the geometry.

use super::document::Document;
use super::remarks::{ImportRemarks, sanitize};
use crate::error::{Result, invalid};
use crate::load::conversion::compression_hint;

/// Extensions that are read.
const SUPPORTED: [&str; 3] = ["KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"];

/// Extensions with an image in a format that is not decoded. The image is a missing image.
const IMAGE_FORMATS: [&str; 3] = ["KHR_texture_basisu", "EXT_texture_avif", "MSFT_texture_dds"];

/// Extensions that compress geometry.
const COMPRESSIONS: [&str; 3] = ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"];

/// Extensions that add or move surfaces.
const GEOMETRY: [&str; 2] = ["EXT_mesh_gpu_instancing", "MSFT_lod"];

/// Name prefixes of extensions that affect only the appearance of surfaces and lights, animations and names. The geometry is
/// correct without them.
const APPEARANCE_PREFIXES: [&str; 7] = [
    "KHR_materials_",
    "EXT_materials_",
    "KHR_techniques_",
    "KHR_lights_",
    "EXT_lights_",
    "KHR_xmp",
    "KHR_animation_pointer",
];

/// Extensions with hints for editors, without which nothing differs. They need no remark.
const HINTS: [&str; 1] = ["FB_ngon_encoding"];

/// Checks the required extensions, and adds a remark for each extension that is not read. `name` is the name of the file.
///
/// # Errors
/// `Invalid` for a required extension that compresses or changes geometry, or that is not known. In strict mode, for each
/// required extension that is not read.
pub(super) fn check(document: &Document, is_strict: bool, name: &str, remarks: &mut ImportRemarks) -> Result<()> {
    for (index, extension) in document.extensions_required.iter().enumerate() {
        let field = format!("extensionsRequired[{index}]");
        let extension = extension.as_str();
        let given = sanitize(extension, 80);
        if SUPPORTED.contains(&extension) {
            continue;
        }
        if COMPRESSIONS.contains(&extension) {
            let given = format!("{given}{}", compression_hint(name));
            return Err(invalid(field, "geometry without compression", given));
        }
        if GEOMETRY.contains(&extension) {
            return Err(invalid(field, "no extension that changes geometry", given));
        }
        let is_ignored = IMAGE_FORMATS.contains(&extension)
            || APPEARANCE_PREFIXES.iter().any(|prefix| extension.starts_with(prefix));
        if !is_ignored {
            return Err(invalid(field, "a known extension, because others can change geometry", given));
        }
        if is_strict {
            return Err(invalid(field, "an extension that is supported", format!("{given} (strict mode)")));
        }
    }
    for extension in document.extensions_used.iter().chain(&document.extensions_required) {
        if !SUPPORTED.contains(&extension.as_str()) && !HINTS.contains(&extension.as_str()) {
            remarks.add(format!("the extension {extension} is not supported: ignored"));
        }
    }
    Ok(())
}
