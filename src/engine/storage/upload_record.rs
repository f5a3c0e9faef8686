//! The record of an upload, a file in its folder: the path to open and the SHA-256 of every file. A server that finds an
//! upload without an entry in the catalog can verify and open it, and clients need not send files that the server already
//! has. The record becomes durable together with the folder.

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::{self, Read as _, Write as _};
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use super::file_system::FileSystem;
use crate::engine::content::{ContentHash, hex};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::load::FileHashes;

/// Name of the record in the folder of an upload. No uploaded file can have it.
pub(super) const RECORD_NAME: &str = ".upload.json";

/// Bytes of a file that are hashed at a time.
const HASH_CHUNK_BYTES: usize = 1 << 20;

/// Paths of uploaded files by their hashes. Several files can have equal content.
pub(in crate::engine) type UploadedFiles = HashMap<ContentHash, Vec<PathBuf>>;

/// What a folder of uploaded files contains.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(super) struct UploadRecord {
    /// The path to open. An empty path means the folder.
    pub(super) entry: String,
    /// Hexadecimal hashes by the paths of the files.
    files: BTreeMap<String, String>,
    /// Hash of the fields above.
    sha256: String,
}

impl UploadRecord {
    pub(super) fn new(entry: &str, hashes: &BTreeMap<String, ContentHash>) -> Self {
        let files = hashes.iter().map(|(path, hash)| (path.clone(), hex(hash))).collect();
        let mut record = Self { entry: entry.into(), files, sha256: String::new() };
        record.sha256 = record.hash();
        record
    }

    fn hash(&self) -> String {
        let mut hasher = Sha256::new();
        let fields = self.files.iter().flat_map(|(path, hash)| [path, hash]).chain([&self.entry]);
        for field in fields {
            hasher.update((field.len() as u64).to_le_bytes());
            hasher.update(field);
        }
        hex(&hasher.finalize())
    }

    /// Writes the record to the folder of its upload, whose files are synced after that.
    pub(super) fn write(&self, file_system: &dyn FileSystem, folder: &Path) -> io::Result<()> {
        let mut file = file_system.create_file(&folder.join(RECORD_NAME), true)?;
        file.write_all(&serde_json::to_vec_pretty(self)?)
    }

    /// Reads the record of a folder. `None` if there is none or it is damaged.
    pub(super) fn read(folder: &Path) -> Option<Self> {
        let record: Self = serde_json::from_slice(&fs::read(folder.join(RECORD_NAME)).ok()?).ok()?;
        (record.sha256 == record.hash()).then_some(record)
    }

    /// The hashes of all files, which exist.
    ///
    /// # Errors
    /// `Invalid` with the name of a file that does not exist, or with [`RECORD_NAME`] if a hash is malformed.
    pub(super) fn hashes_of_existing_files(&self, folder: &Path) -> Result<FileHashes> {
        let hash_of = |(path, digits): (&String, &String)| {
            if !folder.join(path).is_file() {
                return Err(invalid(format!("file '{path}'"), "the file that was uploaded", "none"));
            }
            let hash = parse_hex(digits).ok_or_else(damaged_record)?;
            Ok((path.clone(), hash))
        };
        self.files.iter().map(hash_of).collect()
    }

    /// Whether the folder has all files with their content. Reads every file.
    pub(super) fn matches(&self, folder: &Path) -> bool {
        self.files.iter().all(|(path, hash)| hash_file(&folder.join(path)).is_ok_and(|given| hex(&given) == *hash))
    }
}

fn damaged_record() -> Error {
    invalid(format!("file '{RECORD_NAME}'"), "the record of the upload", "none, or a damaged one")
}

/// The hashes that the files in the folder of an upload must have. Reads only the record.
///
/// # Errors
/// `Invalid` with the name of the record or of a file, if it does not exist or the record is damaged.
pub(in crate::engine) fn read_hashes(folder: &Path) -> Result<FileHashes> {
    UploadRecord::read(folder).ok_or_else(damaged_record)?.hashes_of_existing_files(folder)
}

fn hash_file(path: &Path) -> io::Result<ContentHash> {
    let (mut file, mut hasher) = (File::open(path)?, Sha256::new());
    let mut buffer = vec![0; HASH_CHUNK_BYTES];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(hasher.finalize().into()),
            length => hasher.update(&buffer[..length]),
        }
    }
}

/// Finds the files of uploads by their hashes. Leaves out damaged records and files that no longer exist. The hash of a
/// file must be verified before it is reused.
pub(in crate::engine) fn find_uploaded_files(folders: &[PathBuf]) -> UploadedFiles {
    let mut found = UploadedFiles::new();
    for folder in folders {
        let Some(record) = UploadRecord::read(folder) else { continue };
        for (path, digits) in record.files {
            let path = folder.join(path);
            if let Some(hash) = parse_hex(&digits).filter(|_| path.is_file()) {
                found.entry(hash).or_default().push(path);
            }
        }
    }
    found
}

fn parse_hex(digits: &str) -> Option<ContentHash> {
    let mut hash = ContentHash::default();
    if digits.len() != 2 * hash.len() {
        return None;
    }
    for (index, byte) in hash.iter_mut().enumerate() {
        *byte = u8::from_str_radix(digits.get(2 * index..2 * index + 2)?, 16).ok()?;
    }
    Some(hash)
}

#[cfg(test)]
mod tests {
    use super::super::file_system::DiskFileSystem;
    use super::*;

    /// Writes a file and the record of an upload. Returns the hash of the file.
    fn write_upload(folder: &Path) -> ContentHash {
        fs::create_dir_all(folder).expect("expected a new folder");
        fs::write(folder.join("x"), b"content").expect("expected a written file");
        let hash: ContentHash = Sha256::digest(b"content").into();
        let record = UploadRecord::new("x", &[("x".to_owned(), hash)].into());
        record.write(&DiskFileSystem, folder).expect("expected a written record");
        hash
    }

    #[test]
    fn record_matches_only_unchanged_files() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        write_upload(folder.path());
        let record = UploadRecord::read(folder.path()).expect("expected a record");
        assert!(record.entry == "x" && record.matches(folder.path()));
        fs::write(folder.path().join("x"), b"Content").expect("expected a written file");
        assert!(!record.matches(folder.path()), "expected a changed file to be noticed");
        fs::remove_file(folder.path().join("x")).expect("expected a removed file");
        assert!(!record.matches(folder.path()), "expected a missing file to be noticed");
        let path = folder.path().join(RECORD_NAME);
        let text = fs::read_to_string(&path).expect("expected a record");
        for damaged in [text.replace("\"entry\": \"x\"", "\"entry\": \"y\""), text[..20].to_owned(), String::new()] {
            assert_ne!(damaged, text);
            fs::write(&path, damaged).expect("expected a written file");
            assert_eq!(UploadRecord::read(folder.path()), None);
        }
    }

    #[test]
    fn missing_files_and_damaged_records_are_named() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let error = |folder: &Path| read_hashes(folder).expect_err("expected an error").to_string();
        assert!(error(folder.path()).starts_with("file '.upload.json': expected the record of the upload"));
        let hash = write_upload(folder.path());
        assert_eq!(read_hashes(folder.path()), Ok([("x".to_owned(), hash)].into_iter().collect()));
        fs::remove_file(folder.path().join("x")).expect("expected a removed file");
        assert_eq!(error(folder.path()), "file 'x': expected the file that was uploaded, got none");
    }

    #[test]
    fn uploaded_files_are_found_by_hash_while_they_exist() {
        let uploads = tempfile::tempdir().expect("expected a temporary folder");
        let folders = ["a.b", "without record", "absent"].map(|name| uploads.path().join(name));
        assert!(find_uploaded_files(&folders).is_empty());
        let hash = write_upload(&folders[0]);
        fs::create_dir(&folders[1]).expect("expected a new folder");
        let path = folders[0].join("x");
        assert_eq!(find_uploaded_files(&folders), [(hash, vec![path.clone()])].into());
        assert!(find_uploaded_files(&folders[1..]).is_empty(), "expected only files of these folders");
        fs::remove_file(path).expect("expected a removed file");
        assert!(find_uploaded_files(&folders).is_empty());
    }

    #[test]
    fn only_complete_hexadecimal_hashes_are_parsed() {
        assert_eq!(parse_hex(&hex(&[0xa7; 32])), Some([0xa7; 32]));
        for digits in ["", "a7", &"g0".repeat(32), &"é".repeat(32)] {
            assert_eq!(parse_hex(digits), None, "{digits}");
        }
    }
}
