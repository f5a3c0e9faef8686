//! Resolves buffers, buffer views and URIs to bytes, within a budget for all data that is stored or decoded.

use std::borrow::Cow;
use std::cell::Cell;

use base64::Engine;
use base64::engine::general_purpose::STANDARD_PAD_INDIFFERENT;

use super::document::{BufferView, Document};
use super::warnings::sanitize;
use super::{MAX_FILE, get_element};
use crate::error::{Result, invalid};
use crate::load::asset_dir::AssetDir;

/// The most bytes that one model may use in buffers, decoded accessors and pixels together. Otherwise a small file that
/// refers to one large buffer or image many times could exhaust the memory.
pub(super) const MEMORY_BUDGET: u64 = 1 << 31;

/// The buffers of a document.
#[derive(Debug)]
pub(super) struct GltfBuffers<'a> {
    document: &'a Document,
    folder: &'a AssetDir,
    buffers: Vec<Cow<'a, [u8]>>,
    remaining_budget: Cell<u64>,
}

impl<'a> GltfBuffers<'a> {
    /// Reads every buffer from its URI or, without a URI, from the GLB's binary chunk.
    ///
    /// # Errors
    /// `Invalid` with the buffer if its data is missing, shorter than declared or outside the folder.
    pub(super) fn load(document: &'a Document, folder: &'a AssetDir, bin: Option<&'a [u8]>) -> Result<Self> {
        let mut bytes = Self { document, folder, buffers: Vec::new(), remaining_budget: Cell::new(MEMORY_BUDGET) };
        for index in 0..document.buffers.len() {
            let buffer = bytes.buffer(index, bin).map_err(|error| error.prefix_field(&format!("buffers[{index}]")))?;
            bytes.buffers.push(buffer);
        }
        Ok(bytes)
    }

    fn buffer(&self, index: usize, bin: Option<&'a [u8]>) -> Result<Cow<'a, [u8]>> {
        let buffer = &self.document.buffers[index];
        let content = match (&buffer.uri, bin) {
            (Some(uri), _) => Cow::Owned(self.fetch(uri)?),
            (None, Some(bin)) if index == 0 => Cow::Borrowed(bin),
            (None, _) => return Err(invalid("uri", "a URI, or a GLB's binary chunk for buffer 0", "neither")),
        };
        if content.len() < buffer.byte_length {
            return Err(invalid(
                "byteLength",
                format!("at most the {} bytes there are", content.len()),
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
        let image = &self.document.images[index];
        match (&image.uri, image.buffer_view) {
            (Some(uri), _) => Ok(Cow::Owned(self.fetch(uri)?)),
            (None, Some(view)) => Ok(Cow::Borrowed(self.view(view)?.0)),
            (None, None) => Err(invalid("uri", "a URI or a bufferView", "neither")),
        }
    }

    /// Subtracts `bytes` from the budget; call it before allocating them.
    ///
    /// # Errors
    /// `Invalid` if the budget of the model is exceeded.
    pub(super) fn charge_budget(&self, bytes: u64) -> Result<()> {
        let remaining_budget = self.remaining_budget.get().checked_sub(bytes);
        let remaining_budget = remaining_budget
            .ok_or_else(|| invalid("decoded size", format!("at most {MEMORY_BUDGET} bytes in all"), "more"))?;
        self.remaining_budget.set(remaining_budget);
        Ok(())
    }

    fn fetch(&self, uri: &str) -> Result<Vec<u8>> {
        let content = match uri.strip_prefix("data:") {
            Some(data) => decode_data(data)?,
            None => self.folder.read(&relative(uri)?, MAX_FILE.min(self.remaining_budget.get()))?,
        };
        self.charge_budget(content.len() as u64)?;
        Ok(content)
    }
}

/// Decodes the part of a data URI after `data:`, which must be Base64.
fn decode_data(data: &str) -> Result<Vec<u8>> {
    let Some((kind, payload)) = data.split_once(',').filter(|(kind, _)| kind.ends_with(";base64")) else {
        return Err(invalid("uri", "data:...;base64,...", format!("data:{}", sanitize(data, 40))));
    };
    let refuse = |error| invalid("uri", format!("Base64 after 'data:{},'", sanitize(kind, 40)), error);
    STANDARD_PAD_INDIFFERENT.decode(payload).map_err(refuse)
}

/// The path of a relative URI. A model may read files only in and below its own folder.
fn relative(uri: &str) -> Result<String> {
    let path = percent_decoded(uri);
    let scheme = path.split('/').next().is_some_and(|first| first.contains(':'));
    let leaves = path.starts_with('/') || path.split('/').any(|part| part == "..");
    if path.is_empty() || scheme || leaves || path.contains(['\\', '\0']) {
        return Err(invalid("uri", "a data URI or a path in or below the model's folder", sanitize(uri, 120)));
    }
    Ok(path)
}

/// Decodes escapes such as `%20`. If the result is not UTF-8, the text is returned unchanged.
fn percent_decoded(uri: &str) -> String {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.as_bytes();
    while let [first, tail @ ..] = rest {
        let code = tail.first_chunk::<2>().and_then(|pair| std::str::from_utf8(pair).ok());
        match code.filter(|_| *first == b'%').and_then(|code| u8::from_str_radix(code, 16).ok()) {
            Some(byte) => (bytes.push(byte), rest = &tail[2..]),
            None => (bytes.push(*first), rest = tail),
        };
    }
    String::from_utf8(bytes).unwrap_or_else(|_| uri.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uri_stays_below_its_folder_whatever_its_spelling() {
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
            assert!(relative(uri).is_err(), "{uri:?} passed");
        }
        assert_eq!(relative("my%20buffer%2e1.bin").expect("inside"), "my buffer.1.bin");
        assert_eq!(relative("sub/100%.bin").expect("inside"), "sub/100%.bin");
        assert_eq!(relative("a..b/c:d").expect("inside"), "a..b/c:d");
    }

    #[test]
    fn only_base64_data_uris_are_decoded() {
        assert_eq!(decode_data("application/octet-stream;base64,AAEC").expect("valid"), [0, 1, 2]);
        assert_eq!(decode_data(";base64,AA").expect("padding may be left out"), [0]);
        assert!(decode_data("text/plain,hello").is_err());
        assert!(decode_data(";base64,A*==").is_err());
        assert!(decode_data(";base64").is_err());
    }
}
