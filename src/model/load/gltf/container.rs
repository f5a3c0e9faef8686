//! Splits a `.gltf` or `.glb` file into its JSON document and its binary chunk.

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::document::Document;
use super::remarks::sanitize;
use crate::error::{Result, invalid};
use crate::load::text::without_byte_order_mark;

/// The largest number of JSON objects in a document. Each object takes at least two bytes of text but about 300 bytes
/// of memory.
const MAX_OBJECTS: usize = 1 << 21;
/// The largest number of commas in a document. It limits the memory of list elements, as [`MAX_OBJECTS`] limits the
/// memory of objects.
const MAX_COMMAS: usize = 1 << 24;
/// The largest document that is parsed a second time to locate an error, in bytes.
const MAX_LOCATABLE_BYTES: usize = 1 << 22;
/// The first bytes of a GLB. The version, the length of the file and the chunks follow.
const MAGIC: &[u8] = b"glTF";
/// What the user of a file of glTF 1.0 can do.
const UPGRADE: &str = "convert the file to glTF 2.0";
/// Chunk types of a GLB: the characters "JSON" and "BIN\0" as little-endian u32.
const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;

/// The two parts of a model file.
#[derive(Debug)]
pub(super) struct Container<'a> {
    pub(super) json: &'a [u8],
    /// The bytes of the buffer without a URI.
    pub(super) bin: Option<&'a [u8]>,
}

/// Whether a file is a GLB.
pub(super) fn is_binary(content: &[u8]) -> bool {
    content.starts_with(MAGIC)
}

/// Splits a GLB into its chunks. Any other content is assumed to be JSON.
///
/// # Errors
/// `Invalid` with the field of the header or the chunk.
pub(super) fn split_container(content: &[u8]) -> Result<Container<'_>> {
    if !is_binary(content) {
        return Ok(Container { json: without_byte_order_mark(content)?, bin: None });
    }
    let version = read_word(content, 4, "glb.version")?;
    if version != 2 {
        return Err(invalid("glb.version", "2", format!("{version}: {UPGRADE}")));
    }
    let length = read_word(content, 8, "glb.length")?;
    if u64::from(length) != content.len() as u64 {
        return Err(invalid("glb.length", format!("{}, the size of the file", content.len()), length));
    }
    let (kind, json, next_start) = read_chunk(content, 12)?;
    if kind != JSON {
        return Err(invalid("glb.chunk[0].type", format!("{JSON:#x} (JSON)"), format!("{kind:#x}")));
    }
    if next_start == content.len() {
        return Ok(Container { json, bin: None });
    }
    let (kind, bin, _) = read_chunk(content, next_start)?;
    // Chunks of unknown types must be ignored; the only known type after JSON is BIN.
    Ok(Container { json, bin: (kind == BIN).then_some(bin) })
}

/// Type and content of the chunk at `start`, and the start of the next chunk.
fn read_chunk(content: &[u8], start: usize) -> Result<(u32, &[u8], usize)> {
    let length = read_word(content, start, "glb.chunk.length")? as usize;
    let kind = read_word(content, start + 4, "glb.chunk.type")?;
    let body = &content[start + 8..];
    if length > body.len() {
        return Err(invalid(
            "glb.chunk.length",
            format!("at most {}, the remaining bytes of the file", body.len()),
            length,
        ));
    }
    Ok((kind, &body[..length], start + 8 + length))
}

/// Reads a little-endian u32. `field` is the field of an error.
fn read_word(content: &[u8], start: usize, field: &str) -> Result<u32> {
    let bytes = content.get(start..).and_then(|rest| rest.first_chunk::<4>());
    let truncated = || invalid(field, format!("four bytes at {start}"), format!("a file of {} bytes", content.len()));
    Ok(u32::from_le_bytes(*bytes.ok_or_else(truncated)?))
}

/// Parses the JSON document.
///
/// # Errors
/// `Invalid` with the list and the element that do not conform to glTF, or with the version of another version.
pub(super) fn parse_document(json: &[u8]) -> Result<Document> {
    for (character, noun, limit) in [(b'{', "objects", MAX_OBJECTS), (b',', "commas", MAX_COMMAS)] {
        let count = json.iter().filter(|byte| **byte == character).count();
        if count > limit {
            return Err(invalid("json", format!("at most {limit} {noun}"), count));
        }
    }
    serde_json::from_slice(json).map_err(|error| {
        if let Some(version) = older_version(json) {
            return invalid("asset.version", "2.0", format!("{}: {UPGRADE}", sanitize(&version, 20)));
        }
        let (field, given) = locate_error(json).unwrap_or_else(|| ("json".into(), error.to_string()));
        invalid(field, "a glTF 2.0 document", given)
    })
}

/// The version of a document of glTF 1.0, in which objects with names replace the top-level lists.
fn older_version(json: &[u8]) -> Option<String> {
    #[derive(Default, Deserialize)]
    #[serde(default)]
    struct VersionedDocument {
        asset: Value,
        scenes: Value,
    }
    let VersionedDocument { asset, scenes } = serde_json::from_slice(json).ok()?;
    let version = match asset.get("version") {
        Some(Value::String(version)) => version.clone(),
        Some(Value::Number(version)) => version.to_string(),
        // The version was optional.
        _ if scenes.is_object() => "1.0".to_owned(),
        _ => return None,
    };
    (!version.starts_with('2')).then_some(version)
}

/// Finds the first element of a top-level list that does not parse on its own. Returns its field and the reason. The
/// parser reports only line and column, which do not help because documents often have only one line.
fn locate_error(json: &[u8]) -> Option<(String, String)> {
    use super::document as doc;
    let root: Value = serde_json::from_slice(Some(json).filter(|json| json.len() <= MAX_LOCATABLE_BYTES)?).ok()?;
    let checks = [
        ("scenes", first_invalid_element::<doc::Scene> as fn(&Value) -> Option<(usize, String)>),
        ("nodes", first_invalid_element::<doc::Node>),
        ("meshes", first_invalid_element::<doc::Mesh>),
        ("accessors", first_invalid_element::<doc::Accessor>),
        ("bufferViews", first_invalid_element::<doc::BufferView>),
        ("buffers", first_invalid_element::<doc::Buffer>),
        ("materials", first_invalid_element::<doc::Material>),
        ("textures", first_invalid_element::<doc::Texture>),
        ("images", first_invalid_element::<doc::Image>),
        ("samplers", first_invalid_element::<doc::Sampler>),
    ];
    checks.into_iter().find_map(|(list_name, find_invalid)| {
        let (index, reason) = find_invalid(root.get(list_name)?)?;
        Some((format!("{list_name}[{index}]"), reason))
    })
}

fn first_invalid_element<T: DeserializeOwned>(list: &Value) -> Option<(usize, String)> {
    let reason = |element: &Value| T::deserialize(element).err().map(|error| error.to_string());
    list.as_array()?.iter().enumerate().find_map(|(index, element)| Some((index, reason(element)?)))
}
