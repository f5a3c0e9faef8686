use std::os::unix::fs::MetadataExt as _;

use serde_json::json;

use super::*;
use crate::error::Error;
use crate::hierarchy::tests::four_domain_model;

fn checkpoint(next_step: u64) -> Checkpoint {
    let state = json!({"q": [1.0_f64.to_bits(), u64::MAX], "text": "a remark"});
    let identity = RunIdentity::default().with("motion", "a test").with_number("dt", 0.1);
    Checkpoint { identity, next_step, recorded_rows: Some(4), state }
}

/// Reads a file with these bytes. An error must be one of the content, which has the exit code 5.
fn read_bytes(bytes: &[u8]) -> Result<Checkpoint, String> {
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), bytes).expect("a writable file");
    Checkpoint::read(file.path(), &four_domain_model()).map_err(|error| {
        assert!(matches!(error, Error::Invalid { .. }), "{error}");
        error.to_string()
    })
}

/// The bytes of a file with this JSON, whose size and hash are right.
fn file_of(json: &str) -> Vec<u8> {
    let hash = hexadecimal(&Sha256::digest(json));
    format!("{MAGIC}{VERSION} {hash} {}\n{json}", json.len()).into_bytes()
}

fn written_bytes() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("run.checkpoint");
    checkpoint(7).write(&path).expect("a writable folder");
    std::fs::read(&path).expect("a file")
}

#[test]
fn file_round_trips() {
    assert_eq!(read_bytes(&written_bytes()), Ok(checkpoint(7)));
}

#[test]
fn every_truncation_and_every_altered_bit_is_rejected() {
    let valid = written_bytes();
    for length in 0..valid.len() {
        let error = read_bytes(&valid[..length]).expect_err("a truncated file");
        assert!(error.contains("expected"), "{error}");
    }
    for bit in 0..8 * valid.len() {
        let mut altered = valid.clone();
        altered[bit / 8] ^= 1 << (bit % 8);
        assert!(read_bytes(&altered).is_err(), "bit {bit}: {:?}", String::from_utf8_lossy(&altered));
    }
    assert!(read_bytes(&[&valid[..], b" "].concat()).expect_err("a longer file").contains("truncated or altered"));
}

/// Their size does not matter: only the first bytes are read.
#[test]
fn files_of_another_kind_are_rejected_from_their_first_bytes() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("sparse");
    for head in [&b""[..], b"\x89PNG\r\n\x1a\n", b"modalcast-sim checkpoint \n", &[b'1'; 4096], MAGIC.as_bytes()] {
        std::fs::write(&path, head).expect("a writable file");
        // 1 TiB of zeros, which need no space on the disk.
        File::options().write(true).open(&path).and_then(|file| file.set_len(1 << 40)).expect("a sparse file");
        assert!(std::fs::metadata(&path).expect("a file").blocks() < 1 << 10, "control");
        let error = Checkpoint::read(&path, &four_domain_model()).expect_err("another kind").to_string();
        assert!(error.contains("expected a checkpoint of modalcast-sim, got 1099511627776 bytes"), "{error}");
    }
    let error = Checkpoint::read(folder.path(), &four_domain_model()).expect_err("a folder");
    assert!(matches!(error, Error::Client(ClientError::File { .. })), "{error}");
}

#[test]
fn files_of_another_version_size_or_content_are_rejected() {
    let other_version = String::from_utf8(written_bytes()).expect("text").replacen("checkpoint 2 ", "checkpoint 3 ", 1);
    let error = read_bytes(other_version.as_bytes()).expect_err("another version");
    assert!(error.ends_with("expected a checkpoint of version 2, got version 3"), "{error}");
    let valid = serde_json::to_string(&checkpoint(7)).expect("JSON");
    read_bytes(&file_of(&valid)).expect("control");
    for (json, expected) in [
        ("[".repeat(10_000), "the fields of a checkpoint"),
        ("null".into(), "the fields of a checkpoint"),
        (valid.replacen("next_step\":7", "next_step\":-7", 1), "the fields of a checkpoint"),
        (valid.replacen("next_step\":7", "next_step\":18446744073709551615", 1), "a step of at most 2^53"),
        // 1 MiB and 256 bytes for each of six coordinates and four domains.
        (valid + &" ".repeat(2 << 20), "at most 1051136 bytes"),
    ] {
        let error = read_bytes(&file_of(&json)).expect_err("an invalid file");
        assert!(error.contains(expected), "{error}");
    }
}

/// A process that is killed during a write leaves a part of the temporary file.
#[test]
fn interrupted_write_leaves_the_old_file() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("run.checkpoint");
    let read = || Checkpoint::read(&path, &four_domain_model()).expect("a checkpoint").next_step;
    checkpoint(1).write(&path).expect("a writable folder");
    std::fs::write(temporary_path(&path), &written_bytes()[..50]).expect("a writable folder");
    assert_eq!(read(), 1);
    checkpoint(2).write(&path).expect("a writable folder");
    assert_eq!((read(), temporary_path(&path).exists()), (2, false));
    // A write that fails.
    std::fs::create_dir(temporary_path(&path)).expect("a writable folder");
    let error = checkpoint(3).write(&path).expect_err("no temporary file");
    assert!(matches!(error, Error::Client(ClientError::File { .. })) && error.to_string().contains("run.checkpoint"));
    assert_eq!(read(), 2);
}
