//! Checkpoints: files with the state of a run, from which a later process continues it with the next step.
//!
//! A file has one line of text, and then JSON:
//!
//! ```text
//! modalcast-sim checkpoint VERSION SHA256 BYTES
//! {"identity": ..., "next_step": ..., "recorded_rows": ..., "state": ...}
//! ```
//!
//! SHA256 and BYTES are the hash and the size of the JSON. A file is replaced by a rename, so that a process that is
//! killed at any time leaves the old file or the new one.

mod identity;
#[cfg(test)]
mod tests;

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};

use modalcast_client::Error as ClientError;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest as _, Sha256};

use crate::error::{Result, invalid_input};
use crate::model::Model;
pub use identity::RunIdentity;
pub(crate) use identity::hexadecimal;

/// The version of the format. A change of the state of a scenario, or of an integrator whose steps then have other
/// bits, needs a new one: a file of another version is rejected.
const VERSION: u32 = 2;

/// The start of every file.
const MAGIC: &str = "modalcast-sim checkpoint ";

/// Maximum size of the first line, with its end.
const MAX_HEADER_BYTES: u64 = 160;

/// Maximum size of the JSON without its numbers.
const MAX_TEXT_BYTES: u64 = 1 << 20;

/// Maximum size of the numbers of a coordinate or a domain. A tree, which has most, needs q, v, a force and
/// a force of viewers: four numbers of at most 21 bytes.
const MAX_BYTES_PER_COORDINATE: u64 = 256;

/// The largest number of a step. The times of later steps are not exact.
const MAX_STEP: u64 = 1 << 53;

/// Where and how often a run writes its state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointOptions {
    pub path: PathBuf,
    /// Number of steps between two files, at least 1. The last step is always written.
    pub interval: u64,
}

/// The state of a run between two steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Checkpoint {
    pub(crate) identity: RunIdentity,
    /// The number of the next step.
    pub(crate) next_step: u64,
    /// Number of steps in the record of the run; `None` without a record.
    pub(crate) recorded_rows: Option<u64>,
    /// The state of the scenario before the next step.
    pub(crate) state: Value,
}

impl Checkpoint {
    /// Replaces the file at `path`, durably.
    ///
    /// # Errors
    /// `Client` if it cannot be written.
    pub(crate) fn write(&self, path: &Path) -> Result<()> {
        let file_error = |error: &dyn std::fmt::Display| ClientError::file(path, error);
        let json = serde_json::to_vec(self).map_err(|error| file_error(&error))?;
        let header = format!("{MAGIC}{VERSION} {} {}\n", hexadecimal(&Sha256::digest(&json)), json.len());
        Ok(replace_file(path, &[header.as_bytes(), &json]).map_err(|error| file_error(&error))?)
    }

    /// Reads a file of a run of `model`. Memory is bounded by the size of the model.
    ///
    /// # Errors
    /// `Client` if the file cannot be read; `Invalid` if it is no complete checkpoint of this version.
    pub(crate) fn read(path: &Path, model: &Model) -> Result<Self> {
        let numbers = (model.coordinate_count + model.domains.len()) as u64;
        let json = read_json(path, MAX_TEXT_BYTES + MAX_BYTES_PER_COORDINATE * numbers)?;
        let invalid = |expected: &str, given: String| invalid_input(path.display().to_string(), expected, given);
        let checkpoint: Self =
            serde_json::from_slice(&json).map_err(|error| invalid("the fields of a checkpoint", error.to_string()))?;
        if checkpoint.next_step > MAX_STEP {
            return Err(invalid("a step of at most 2^53", checkpoint.next_step.to_string()));
        }
        Ok(checkpoint)
    }
}

/// Reads the JSON of a file of at most `max_bytes`, and checks the version, the size and the hash.
fn read_json(path: &Path, max_bytes: u64) -> Result<Vec<u8>> {
    let file_error = |error: std::io::Error| ClientError::file(path, error);
    let invalid = |expected: String, given: String| invalid_input(path.display().to_string(), expected, given);
    let file = File::open(path).map_err(file_error)?;
    let file_bytes = file.metadata().map_err(file_error)?.len();
    let mut start = vec![];
    (&file).take(MAX_HEADER_BYTES).read_to_end(&mut start).map_err(file_error)?;
    let Some((header, rest)) = split_header(&start) else {
        let given =
            format!("{file_bytes} bytes that start with {:?}", String::from_utf8_lossy(&start[..start.len().min(32)]));
        return Err(invalid("a checkpoint of modalcast-sim".into(), given));
    };
    if header.version != VERSION {
        return Err(invalid(format!("a checkpoint of version {VERSION}"), format!("version {}", header.version)));
    }
    let json_bytes = file_bytes.saturating_sub((start.len() - rest.len()) as u64);
    if json_bytes != header.json_bytes {
        let expected = format!("{} bytes after the first line", header.json_bytes);
        return Err(invalid(expected, format!("{json_bytes}: the file was truncated or altered")));
    }
    if json_bytes > max_bytes {
        return Err(invalid(format!("at most {max_bytes} bytes for this scene"), json_bytes.to_string()));
    }
    let mut json = rest.to_vec();
    file.take(json_bytes.saturating_sub(rest.len() as u64)).read_to_end(&mut json).map_err(file_error)?;
    let hash = hexadecimal(&Sha256::digest(&json));
    if hash != header.hash {
        return Err(invalid(
            format!("content with the SHA-256 {}", header.hash),
            format!("{hash}: the file was altered"),
        ));
    }
    Ok(json)
}

/// The first line of a file.
struct Header {
    version: u32,
    /// The SHA-256 of the JSON, hexadecimal.
    hash: String,
    json_bytes: u64,
}

/// Splits the start of a file into the first line and the bytes after it; `None` if it is no header.
fn split_header(start: &[u8]) -> Option<(Header, &[u8])> {
    let end = start.iter().position(|byte| *byte == b'\n')?;
    let line = std::str::from_utf8(&start[..end]).ok()?.strip_prefix(MAGIC)?;
    let mut words = line.split(' ');
    let header = Header {
        version: words.next()?.parse().ok()?,
        hash: words.next()?.to_owned(),
        json_bytes: words.next()?.parse().ok()?,
    };
    words.next().is_none().then_some((header, &start[end + 1..]))
}

/// Replaces a file by the concatenation of `parts`: writes a temporary file in the same folder, syncs and renames it,
/// and syncs the folder. A later call overwrites a temporary file that a killed process has left.
fn replace_file(path: &Path, parts: &[&[u8]]) -> std::io::Result<()> {
    let temporary_path = temporary_path(path);
    let mut file = File::create(&temporary_path)?;
    parts.iter().try_for_each(|part| file.write_all(part))?;
    // Without this, a power failure after the rename could leave an empty file.
    file.sync_all()?;
    std::fs::rename(&temporary_path, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

/// The file name with `.tmp` appended.
fn temporary_path(path: &Path) -> PathBuf {
    let mut temporary_path = path.as_os_str().to_owned();
    temporary_path.push(".tmp");
    temporary_path.into()
}
