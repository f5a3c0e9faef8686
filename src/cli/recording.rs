//! Recordings that `modalcast view` plays.

use std::path::Path;

use bytes::Bytes;
use modalcast_model::error::{Error, Result, invalid};

/// The first bytes of an MCAP file.
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Limit on a recording in a page. Its text has 4/3 of the bytes, and Chromium limits a text to 512 MiB.
const MAX_BYTES: u64 = 256 << 20;

/// Whether a path names a recording.
pub(super) fn is_recording(path: &str) -> bool {
    Path::new(path).extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
}

/// Reads a recording.
///
/// # Errors
/// `NotFound` if there is no such file; `Invalid` if it cannot be read, is too large, or is not an MCAP file.
pub(super) fn read(path: &str) -> Result<Bytes> {
    let field = format!("recording '{path}'");
    let unreadable = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::NotFound => Error::NotFound { what: "recording", given: path.into() },
        kind => invalid(&field, "a readable file", kind),
    };
    let file_bytes = std::fs::metadata(path).map_err(unreadable)?.len();
    if file_bytes > MAX_BYTES {
        let expected = format!("at most {MAX_BYTES} bytes (`modalcast replay` plays a recording of any size)");
        return Err(invalid(&field, expected, format!("{file_bytes} bytes")));
    }
    let bytes = std::fs::read(path).map_err(unreadable)?;
    match bytes.starts_with(MAGIC) {
        true => Ok(bytes.into()),
        false => Err(invalid(&field, "an MCAP file, which `modalcast record` writes", "another format")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_mcap_files_are_read() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("a.MCAP");
        let name = path.to_string_lossy();
        assert!(is_recording(&name) && !is_recording("mcap") && !is_recording("a.glb"));
        assert_eq!(read(&name), Err(Error::NotFound { what: "recording", given: name.to_string() }));
        std::fs::write(&path, [MAGIC, b"rest"].concat()).expect("expected a written file");
        assert_eq!(read(&name).expect("expected a recording").len(), MAGIC.len() + 4);
        std::fs::write(&path, "text").expect("expected a written file");
        let message = read(&name).expect_err("expected an error").to_string();
        assert!(
            message.ends_with("expected an MCAP file, which `modalcast record` writes, got another format"),
            "{message}"
        );
        std::fs::File::create(&path).and_then(|file| file.set_len(MAX_BYTES + 1)).expect("expected a written file");
        let message = read(&name).expect_err("expected an error").to_string();
        assert!(message.ends_with("got 268435457 bytes"), "{message}");
        let message = read(&folder.path().to_string_lossy()).expect_err("expected an error").to_string();
        assert!(message.ends_with("expected a readable file, got is a directory"), "{message}");
    }
}
