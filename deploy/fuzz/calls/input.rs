//! The messages of an input.
//!
//! An input is a sequence of messages with [`SEPARATOR`] between them. The first byte of a message is its kind. After
//! [`CHUNK`] follows the content of a file or of arrays, after any other byte an encoded message. Mutations that insert
//! or remove bytes of a content therefore leave the other messages intact.

use bytes::Bytes;
use modalcast_proto::v1;
use prost::Message as _;
use sha2::{Digest as _, Sha256};
use v1::upload_arrays_request::Part as ArraysPart;
use v1::upload_scene_request::Part as FilesPart;

pub(crate) const SEPARATOR: &[u8] = b"\xf7\xf8\xf9\xfa";

// Kinds of messages.
pub(crate) const MESSAGE: u8 = 0;
pub(crate) const CHUNK: u8 = 1;

/// The encoded messages of an input.
pub(super) fn messages_of(input: &[u8]) -> Vec<Bytes> {
    let mut rest = Some(input);
    let parts = std::iter::from_fn(|| {
        let bytes = rest?;
        let end = bytes.windows(SEPARATOR.len()).position(|window| window == SEPARATOR);
        rest = end.map(|end| &bytes[end + SEPARATOR.len()..]);
        Some(&bytes[..end.unwrap_or(bytes.len())])
    });
    parts.filter_map(|part| part.split_first()).map(|(kind, content)| encode_message(*kind, content)).collect()
}

fn encode_message(kind: u8, content: &[u8]) -> Bytes {
    let content = Bytes::copy_from_slice(content);
    match kind {
        // Chunks of arrays have the same encoding.
        CHUNK => v1::UploadSceneRequest { part: Some(FilesPart::Chunk(content)) }.encode_to_vec().into(),
        _ => content,
    }
}

/// Fills in declarations, which mutations of the content make invalid: the size and the hash of a file that has no
/// hash, and the sums of a header that has none.
pub(super) fn declare_files(messages: &mut [Bytes]) {
    let (mut content, mut files, mut total_bytes) = (Vec::new(), 0, 0_u64);
    // From the last message on, because a declaration is sent before the content.
    for message in messages.iter_mut().rev() {
        let request = v1::UploadSceneRequest::decode(message.clone());
        let Some(part) = request.ok().and_then(|request| request.part) else { continue };
        let part = match part {
            FilesPart::Chunk(chunk) => {
                content = [&chunk[..], &content].concat();
                continue;
            }
            FilesPart::File(mut file) => {
                if file.sha256.is_empty() && !file.reuse {
                    file.bytes = content.len() as u64;
                    file.sha256 = Sha256::digest(&content).to_vec().into();
                }
                content.clear();
                files += 1;
                total_bytes = total_bytes.saturating_add(file.bytes);
                FilesPart::File(file)
            }
            FilesPart::Header(mut header) => {
                if header.files == 0 {
                    (header.files, header.total_bytes) = (files, total_bytes);
                }
                FilesPart::Header(header)
            }
        };
        *message = v1::UploadSceneRequest { part: Some(part) }.encode_to_vec().into();
    }
}

/// Fills in the sums of a header that has none.
pub(super) fn declare_arrays(messages: &mut [Bytes]) {
    let (mut domains, mut total_bytes) = (0, 0_u64);
    for message in messages.iter_mut().rev() {
        let request = v1::UploadArraysRequest::decode(message.clone());
        match request.ok().and_then(|request| request.part) {
            Some(ArraysPart::Domain(domain)) => {
                let [vertices, triangles, rank] = [domain.vertices, domain.triangles, domain.rank].map(u64::from);
                let vectors = vertices.saturating_mul(rank).saturating_add(vertices + triangles);
                total_bytes = total_bytes.saturating_add(vectors.saturating_mul(12));
                domains += 1;
            }
            Some(ArraysPart::Header(mut header)) if header.domains == 0 => {
                (header.domains, header.total_bytes) = (domains, total_bytes);
                let part = Some(ArraysPart::Header(header));
                *message = v1::UploadArraysRequest { part }.encode_to_vec().into();
            }
            _ => {}
        }
    }
}
