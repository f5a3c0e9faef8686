//! The SHA-256 hashes that the files of a folder must have.

use std::collections::BTreeMap;

use sha2::{Digest as _, Sha256};

use crate::error::{Result, invalid};

/// The SHA-256 hashes of all files of a folder, by their paths in the folder.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct FileHashes(BTreeMap<String, [u8; 32]>);

impl FromIterator<(String, [u8; 32])> for FileHashes {
    fn from_iter<I: IntoIterator<Item = (String, [u8; 32])>>(hashes: I) -> Self {
        Self(hashes.into_iter().collect())
    }
}

impl FileHashes {
    /// The paths of the files, sorted.
    pub fn paths(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// Checks the content of the file at `path`.
    ///
    /// # Errors
    /// `Invalid` with the field `field` if the content has another hash, or the folder had no such file.
    pub(super) fn check(&self, path: &str, field: &str, content: &[u8]) -> Result<()> {
        let Some(expected) = self.0.get(path) else {
            return Err(invalid(field, "one of the files that were uploaded", "a file that was added later"));
        };
        let given: [u8; 32] = Sha256::digest(content).into();
        match given == *expected {
            true => Ok(()),
            false => Err(invalid(field, format!("the uploaded content, SHA-256 {}", hex(expected)), hex(&given))),
        }
    }
}

/// The bytes as lower-case hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
