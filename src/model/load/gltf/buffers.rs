//! Resolves buffers, buffer views and URIs to bytes, within a budget for all data that is stored or decoded.

use std::borrow::Cow;
use std::cell::Cell;
use std::sync::Arc;

use base64::Engine;
use base64::engine::general_purpose::STANDARD_PAD_INDIFFERENT;

use super::document::{BufferView, Document};
use super::remarks::sanitize;
use super::{MAX_FILE_BYTES, get_element};
use crate::domain::Texture;
use crate::error::{Result, invalid};
use crate::load::asset_dir::{AssetDir, ReferencedFile};
use crate::load::polygons::build_bytes;
use crate::memory::MemoryReservation;

/// The largest total size in bytes of a model's buffers, decoded accessors and pixels. Without this limit, a small file
/// that refers to one large buffer or image many times could exhaust the memory.
pub(super) const MEMORY_BUDGET: u64 = 1 << 31;

/// The buffers of a document.
#[derive(Debug)]
pub(super) struct GltfBuffers<'a> {
    document: &'a Document,
    folder: &'a AssetDir,
    buffers: Vec<Cow<'a, [u8]>>,
    /// The part of [`MEMORY_BUDGET`] that is not used yet.
    remaining_budget: Cell<u64>,
}

/// Where the bytes of an image are.
#[derive(Debug)]
enum ImageSource<'a> {
    /// A data URI without `data:`.
    Data(&'a str),
    /// The index of a buffer view.
    View(usize),
    /// The decoded URI of a file.
    File(String),
}

impl<'a> GltfBuffers<'a> {
    /// Reads every buffer from its URI or, without a URI, from the GLB's binary chunk.
    ///
    /// # Errors
    /// `Invalid` with the buffer if its data is missing, shorter than declared or outside the folder.
    pub(super) fn load(document: &'a Document, folder: &'a AssetDir, bin: Option<&'a [u8]>) -> Result<Self> {
        let mut gltf_buffers =
            Self { document, folder, buffers: Vec::new(), remaining_budget: Cell::new(MEMORY_BUDGET) };
        for index in 0..document.buffers.len() {
            let buffer = gltf_buffers
                .load_buffer(index, bin)
                .map_err(|error| error.prefix_field(&format!("buffers[{index}]")))?;
            gltf_buffers.buffers.push(buffer);
        }
        Ok(gltf_buffers)
    }

    fn load_buffer(&self, index: usize, bin: Option<&'a [u8]>) -> Result<Cow<'a, [u8]>> {
        let buffer = &self.document.buffers[index];
        let content = match (&buffer.uri, bin) {
            (Some(uri), _) => Cow::Owned(self.read_uri(uri)?),
            (None, Some(bin)) if index == 0 => Cow::Borrowed(bin),
            (None, _) => return Err(invalid("uri", "a URI, or a GLB's binary chunk for buffer 0", "neither")),
        };
        if content.len() < buffer.byte_length {
            return Err(invalid(
                "byteLength",
                format!("at most {}, the size of the data", content.len()),
                buffer.byte_length,
            ));
        }
        Ok(content)
    }

    /// The bytes of a buffer view and its stride.
    ///
    /// # Errors
    /// `Invalid` if the view exceeds its buffer.
    pub(super) fn view(&self, index: usize) -> Result<(&[u8], Option<usize>)> {
        let view = get_element(&self.document.buffer_views, index, "bufferView")?;
        let bytes = self.view_bytes(view).map_err(|error| error.prefix_field(&format!("bufferViews[{index}]")))?;
        Ok((bytes, view.byte_stride))
    }

    fn view_bytes(&self, view: &BufferView) -> Result<&[u8]> {
        let buffer = get_element(&self.buffers, view.buffer, "buffer")?;
        let length = self.document.buffers[view.buffer].byte_length;
        let end = view.byte_offset.checked_add(view.byte_length).filter(|end| *end <= length);
        let end = end.ok_or_else(|| {
            let given = format!("{} + {}", view.byte_offset, view.byte_length);
            invalid("byteOffset + byteLength", format!("at most {length}, the bytes of buffer {}", view.buffer), given)
        })?;
        Ok(&buffer[view.byte_offset..end])
    }

    /// The encoded bytes of an image.
    ///
    /// # Errors
    /// `Invalid` if the image has no source or the source does not exist.
    pub(super) fn image(&self, index: usize) -> Result<Cow<'_, [u8]>> {
        match self.image_source(index)? {
            ImageSource::Data(data) => self.decode_data(data).map(Cow::Owned),
            ImageSource::View(view) => Ok(Cow::Borrowed(self.view(view)?.0)),
            ImageSource::File(reference) => match self.folder.locate(&reference) {
                ReferencedFile::Exact(path) | ReferencedFile::Similar { path, .. } => {
                    self.read_file(&path).map(Cow::Owned)
                }
                ReferencedFile::Missing { reason } => {
                    Err(invalid("uri", "an existing file", format!("'{}', which {reason}", sanitize(&reference, 120))))
                }
            },
        }
    }

    /// Whether an image can be drawn. If not, or if it is another file than that of the URI, adds a remark that begins with
    /// `subject`; the remark on an image that is not drawn ends with `stand_in`.
    ///
    /// # Errors
    /// As for [`Self::image`] and [`AssetDir::find_image`].
    pub(super) fn is_usable_image(
        &self,
        index: usize,
        subject: &str,
        stand_in: &str,
        remarks: &mut Vec<String>,
    ) -> Result<bool> {
        let start = match self.image_source(index)? {
            ImageSource::Data(data) => Cow::Owned(decode_data_uri(signature_of_data_uri(data))?),
            ImageSource::View(view) => Cow::Borrowed(self.view(view)?.0),
            ImageSource::File(reference) => {
                return Ok(self.folder.find_image(&reference, subject, stand_in, remarks)?.is_some());
            }
        };
        let start = &start[..start.len().min(Texture::SIGNATURE_BYTES)];
        let unsupported = self.folder.unsupported_image("in the model", start)?;
        remarks.extend(unsupported.map(|reason| format!("{subject} {reason}: {stand_in}")));
        Ok(unsupported.is_none())
    }

    fn image_source(&self, index: usize) -> Result<ImageSource<'_>> {
        let image = &self.document.images[index];
        match (image.uri.as_deref(), image.buffer_view) {
            (Some(uri), _) => Ok(match uri.strip_prefix("data:") {
                Some(data) => ImageSource::Data(data),
                None => ImageSource::File(decode_percent_escapes(uri)),
            }),
            (None, Some(view)) => Ok(ImageSource::View(view)),
            (None, None) => Err(invalid("uri", "a URI or a bufferView", "neither")),
        }
    }

    /// Whether an unusable image is an error instead of a remark.
    pub(super) const fn is_strict(&self) -> bool {
        self.folder.is_strict()
    }

    /// Subtracts `bytes` from the budget; call it before allocating them.
    ///
    /// # Errors
    /// `Invalid` if the budget of the model is exceeded, `OutOfMemory` if that of the scene is.
    pub(super) fn charge_budget(&self, bytes: u64) -> Result<()> {
        self.count_budget(bytes)?;
        self.folder.reserve("model", bytes)
    }

    /// As [`Self::charge_budget`], for bytes that are already reserved in the memory of the scene.
    pub(super) fn count_budget(&self, bytes: u64) -> Result<()> {
        let remaining_budget = self.remaining_budget.get().checked_sub(bytes);
        let remaining_budget = remaining_budget
            .ok_or_else(|| invalid("decoded size", format!("at most {MEMORY_BUDGET} bytes in total"), "more"))?;
        self.remaining_budget.set(remaining_budget);
        Ok(())
    }

    /// Reserves memory for a mesh that is built from vertices and triangles.
    ///
    /// # Errors
    /// `OutOfMemory`.
    pub(super) fn reserve_mesh(&self, vertices: usize, triangles: usize) -> Result<()> {
        self.folder.reserve("mesh of the model", build_bytes(vertices, 3 * triangles))
    }

    /// The memory of the scene that is loaded.
    pub(super) const fn memory(&self) -> &Arc<MemoryReservation> {
        self.folder.memory()
    }

    fn read_uri(&self, uri: &str) -> Result<Vec<u8>> {
        match uri.strip_prefix("data:") {
            Some(data) => self.decode_data(data),
            None => self.read_file(&relative_path(uri)?),
        }
    }

    fn read_file(&self, path: &str) -> Result<Vec<u8>> {
        let limit = MAX_FILE_BYTES.min(self.remaining_budget.get());
        let content = self.folder.read(path, limit)?;
        // The reservation of the file ends with the conversion.
        self.charge_budget(content.len() as u64)?;
        Ok(content.into_bytes())
    }

    fn decode_data(&self, data: &str) -> Result<Vec<u8>> {
        let content = decode_data_uri(data)?;
        self.charge_budget(content.len() as u64)?;
        Ok(content)
    }
}

/// The start of a data URI, which has the signature of an image. `data` is the part after `data:`.
fn signature_of_data_uri(data: &str) -> &str {
    // Four characters encode three bytes.
    const CHARACTERS: usize = 4 * Texture::SIGNATURE_BYTES.div_ceil(3);
    let payload_start = data.find(',').map_or(0, |comma| comma + 1);
    data.get(..payload_start + CHARACTERS).unwrap_or(data)
}

/// Decodes a data URI with Base64 content. `data` is the part after `data:`.
fn decode_data_uri(data: &str) -> Result<Vec<u8>> {
    let Some((media_type, payload)) = data.split_once(',').filter(|(media_type, _)| media_type.ends_with(";base64"))
    else {
        return Err(invalid("uri", "data:...;base64,...", format!("data:{}", sanitize(data, 40))));
    };
    let invalid_base64 = |error| invalid("uri", format!("Base64 after 'data:{},'", sanitize(media_type, 40)), error);
    STANDARD_PAD_INDIFFERENT.decode(payload).map_err(invalid_base64)
}

/// The path of the relative URI of a buffer. A model may read buffers only in and below its own folder.
fn relative_path(uri: &str) -> Result<String> {
    let path = decode_percent_escapes(uri);
    let has_scheme = path.split('/').next().is_some_and(|component| component.contains(':'));
    let leaves_folder = path.starts_with('/') || path.split('/').any(|component| component == "..");
    if path.is_empty() || has_scheme || leaves_folder || path.contains(['\\', '\0']) {
        return Err(invalid("uri", "a data URI or a path in or below the model's folder", sanitize(uri, 120)));
    }
    Ok(path)
}

/// Decodes escapes such as `%20`. If the result is not UTF-8, the text is returned unchanged.
fn decode_percent_escapes(uri: &str) -> String {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut remainder = uri.as_bytes();
    while let [byte, next_bytes @ ..] = remainder {
        let hex_digits = next_bytes.first_chunk::<2>().and_then(|digits| std::str::from_utf8(digits).ok());
        match hex_digits.filter(|_| *byte == b'%').and_then(|hex_digits| u8::from_str_radix(hex_digits, 16).ok()) {
            Some(byte) => (bytes.push(byte), remainder = &next_bytes[2..]),
            None => (bytes.push(*byte), remainder = next_bytes),
        };
    }
    String::from_utf8(bytes).unwrap_or_else(|_| uri.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uris_outside_of_the_folder_are_rejected() {
        let outside = [
            "../secret.bin",
            "a/../../b.bin",
            "%2e%2e/secret.bin",
            "/etc/hostname",
            "%2Fetc/hostname",
            "file:///x",
            "https://host/x.bin",
            "C:\\x.bin",
            "a\\..\\b",
            "",
            "a%00b",
            "..",
        ];
        for uri in outside {
            assert!(relative_path(uri).is_err(), "{uri:?}: expected an error");
        }
        assert_eq!(relative_path("my%20buffer%2e1.bin").expect("a relative path"), "my buffer.1.bin");
        assert_eq!(relative_path("sub/100%.bin").expect("a relative path"), "sub/100%.bin");
        assert_eq!(relative_path("a..b/c:d").expect("a relative path"), "a..b/c:d");
    }

    #[test]
    fn only_base64_data_uris_are_decoded() {
        assert_eq!(decode_data_uri("application/octet-stream;base64,AAEC").expect("valid Base64"), [0, 1, 2]);
        assert_eq!(decode_data_uri(";base64,AA").expect("valid Base64 without padding"), [0]);
        assert!(decode_data_uri("text/plain,hello").is_err());
        assert!(decode_data_uri(";base64,A*==").is_err());
        assert!(decode_data_uri(";base64").is_err());
    }
}
