//! Writes uploaded files into a new temporary folder. The paths of the files cannot leave the folder. Sizes and SHA-256
//! hashes must equal the values that the client has declared. Dropping an unfinished [`Upload`] removes its folder in
//! the background. [`Upload::discard`] removes the folder before it returns.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write as _};
use std::mem;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use sha2::{Digest as _, Sha256};
use tokio::sync::OwnedSemaphorePermit;

use crate::engine::content::hex;
use modalcast_model::error::{Result, fault, fault_in, invalid};

/// Limit on the length of a path in bytes.
const MAX_PATH_BYTES: usize = 240;
/// Limit on the number of components of a path, including the file name.
const MAX_PATH_DEPTH: usize = 16;

/// Number of uploads so far. Makes the names of temporary folders unique.
static UPLOAD_COUNTER: AtomicU64 = AtomicU64::new(0);

/// The header of an upload, which declares the files that the client is going to send.
#[derive(Debug, Clone, Default)]
pub struct UploadHeader {
    /// Name of the scene.
    pub scene: String,
    /// The uploaded path to open. An empty path means the folder.
    pub entry: String,
    /// Number of files.
    pub files: u32,
    /// Sum of the sizes of all files.
    pub total_bytes: u64,
}

/// An upload in progress. Its methods block on the disk.
#[derive(Debug)]
pub struct Upload {
    pub(in crate::engine) header: UploadHeader,
    /// The temporary folder; empty after it was moved or removed.
    folder: PathBuf,
    /// Paths of the files so far.
    paths: BTreeSet<String>,
    /// Sum of the declared sizes of the files so far, in bytes.
    declared_bytes: u64,
    open_file: Option<OpenFile>,
    /// Counts against the limit on concurrent uploads until the folder is moved or removed.
    permit: Option<OwnedSemaphorePermit>,
}

/// The file that is being received.
#[derive(Debug)]
struct OpenFile {
    path: String,
    file: File,
    /// Size that the client declared.
    declared_bytes: u64,
    remaining_bytes: u64,
    hasher: Sha256,
    /// Hash that the client declared.
    declared_sha256: [u8; 32],
}

impl Upload {
    /// Creates a temporary folder next to the finished uploads.
    ///
    /// # Errors
    /// `Invalid` for a malformed entry path, `Fault` of the disk.
    pub(in crate::engine) fn begin(uploads: &Path, header: UploadHeader, permit: OwnedSemaphorePermit) -> Result<Self> {
        if !header.entry.is_empty() {
            validate_path("header.entry", &header.entry)?;
        }
        let count = UPLOAD_COUNTER.fetch_add(1, Ordering::Relaxed);
        let folder = uploads.join(format!(".{}-{count}", header.scene));
        fs::create_dir_all(&folder).map_err(fault_in("upload"))?;
        Ok(Self { header, folder, paths: BTreeSet::new(), declared_bytes: 0, open_file: None, permit: Some(permit) })
    }

    /// Begins the next file. `bytes` is its size; `sha256` must have 32 bytes.
    ///
    /// # Errors
    /// `Invalid` for a path that leaves the folder or was sent before, for more files or bytes than the header
    /// declares, for a malformed hash, and when the previous file is incomplete; `Fault` of the disk.
    pub fn begin_file(&mut self, path: &str, bytes: u64, sha256: &[u8]) -> Result<()> {
        self.check_file_complete()?;
        validate_path("file.path", path)?;
        let sha256: [u8; 32] = sha256
            .try_into()
            .map_err(|_| invalid("file.sha256", "32 bytes", format!("{} bytes for '{path}'", sha256.len())))?;
        if !self.paths.insert(path.to_owned()) {
            return Err(invalid("file.path", "a path that was not sent yet", path));
        }
        if self.paths.len() > self.header.files as usize {
            return Err(invalid("header.files", self.header.files.to_string(), self.paths.len()));
        }
        self.declared_bytes = self.declared_bytes.saturating_add(bytes);
        if self.declared_bytes > self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        let file_path = self.folder.join(path);
        let path_conflict = |error: io::Error| match error.kind() {
            ErrorKind::AlreadyExists | ErrorKind::NotADirectory | ErrorKind::InvalidFilename => {
                invalid("file.path", "a path that does not conflict with another file", path)
            }
            _ => fault("upload", error),
        };
        if let Some(parent) = file_path.parent() {
            fs::create_dir_all(parent).map_err(path_conflict)?;
        }
        let file = File::create_new(&file_path).map_err(path_conflict)?;
        self.open_file = Some(OpenFile {
            path: path.into(),
            file,
            declared_bytes: bytes,
            remaining_bytes: bytes,
            hasher: Sha256::new(),
            declared_sha256: sha256,
        });
        self.finish_file_if_complete()
    }

    /// Appends bytes to the current file.
    ///
    /// # Errors
    /// `Invalid` when the bytes exceed the declared size or the complete file has a different hash; `Fault` of the
    /// disk.
    pub fn write_chunk(&mut self, bytes: &[u8]) -> Result<()> {
        let chunk_bytes = bytes.len() as u64;
        let Some(open_file) = self.open_file.as_mut().filter(|open_file| chunk_bytes <= open_file.remaining_bytes)
        else {
            let remaining_bytes = self.open_file.as_ref().map_or(0, |open_file| open_file.remaining_bytes);
            let expected = format!("at most {remaining_bytes} bytes (the rest of the file)");
            return Err(invalid("chunk", expected, format!("{chunk_bytes} bytes")));
        };
        open_file.file.write_all(bytes).map_err(fault_in("upload"))?;
        open_file.hasher.update(bytes);
        open_file.remaining_bytes -= chunk_bytes;
        self.finish_file_if_complete()
    }

    /// Checks that all declared files and bytes have arrived.
    ///
    /// # Errors
    /// `Invalid` naming the header field or file that does not match.
    pub(in crate::engine) fn check_complete(&self) -> Result<()> {
        self.check_file_complete()?;
        if self.paths.len() != self.header.files as usize {
            return Err(invalid("header.files", self.header.files.to_string(), self.paths.len()));
        }
        if self.declared_bytes != self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        Ok(())
    }

    /// Moves the folder to `target_folder`. Replaces the earlier upload in that folder.
    pub(in crate::engine) fn commit(mut self, target_folder: &Path) -> Result<()> {
        if target_folder.exists() {
            fs::remove_dir_all(target_folder).map_err(fault_in("upload"))?;
        }
        fs::rename(&self.folder, target_folder).map_err(fault_in("upload"))?;
        self.folder = PathBuf::new();
        Ok(())
    }

    /// Removes the folder. Blocks on the disk.
    pub fn discard(mut self) {
        fs::remove_dir_all(mem::take(&mut self.folder)).ok(); // The next start removes leftovers.
    }

    /// Checks the hash of the open file and closes it once all of its bytes have arrived.
    fn finish_file_if_complete(&mut self) -> Result<()> {
        let Some(open_file) = self.open_file.take_if(|open_file| open_file.remaining_bytes == 0) else { return Ok(()) };
        let given: [u8; 32] = open_file.hasher.finalize().into();
        if given != open_file.declared_sha256 {
            return Err(invalid(
                "file.sha256",
                hex(&open_file.declared_sha256),
                format!("{} for '{}'", hex(&given), open_file.path),
            ));
        }
        Ok(())
    }

    /// Fails if the last file is incomplete.
    fn check_file_complete(&self) -> Result<()> {
        match &self.open_file {
            None => Ok(()),
            Some(open_file) => {
                let received_bytes = open_file.declared_bytes - open_file.remaining_bytes;
                let given = format!("{received_bytes} bytes for '{}'", open_file.path);
                Err(invalid("file.bytes", format!("{} bytes", open_file.declared_bytes), given))
            }
        }
    }
}

impl Drop for Upload {
    /// Removes the folder. On a thread of a tokio runtime, removes it on the blocking pool.
    fn drop(&mut self) {
        let folder = mem::take(&mut self.folder);
        if folder.as_os_str().is_empty() {
            return;
        }
        let permit = self.permit.take();
        let remove = move || {
            fs::remove_dir_all(folder).ok(); // The next start removes leftovers.
            drop(permit);
        };
        match tokio::runtime::Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(remove)),
            Err(_) => remove(),
        }
    }
}

/// Checks that a path is relative, uses forward slashes and consists of plain names.
fn validate_path(field: &str, path: &str) -> Result<()> {
    let is_plain_name =
        |part: &str| !part.is_empty() && part != "." && part != ".." && !part.contains(['\\', '\0', ':']);
    let depth = path.split('/').count();
    if path.len() > MAX_PATH_BYTES || depth > MAX_PATH_DEPTH || !path.split('/').all(is_plain_name) {
        let expected =
            format!("a relative path of plain names, at most {MAX_PATH_BYTES} bytes and {MAX_PATH_DEPTH} parts");
        return Err(invalid(field, expected, format!("{path:?}")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::error::Error;

    fn begin_upload(folder: &Path, files: u32, total_bytes: u64) -> Upload {
        let header = UploadHeader { scene: "s".into(), entry: String::new(), files, total_bytes };
        let permits = std::sync::Arc::new(tokio::sync::Semaphore::new(1));
        let permit = permits.try_acquire_owned().expect("expected a free permit");
        Upload::begin(folder, header, permit).expect("expected a temporary folder")
    }

    fn sha256_of(bytes: &[u8]) -> Vec<u8> {
        Sha256::digest(bytes).to_vec()
    }

    #[test]
    fn committed_upload_has_the_files_of_all_chunks() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut upload = begin_upload(folder.path(), 2, 5);
        upload.begin_file("a/b.txt", 5, &sha256_of(b"hello")).expect("expected a new file");
        upload.write_chunk(b"he").expect("expected an accepted chunk");
        upload.write_chunk(b"llo").expect("expected an accepted chunk");
        upload.begin_file("empty", 0, &sha256_of(b"")).expect("expected a new file");
        upload.check_complete().expect("expected a complete upload");
        upload.commit(&folder.path().join("target")).expect("expected to move the folder");
        assert_eq!(fs::read(folder.path().join("target/a/b.txt")).expect("expected the file"), b"hello");
        assert_eq!(fs::read_dir(folder.path()).expect("expected a folder").count(), 1);
    }

    #[test]
    fn unsafe_and_conflicting_paths_are_rejected() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut upload = begin_upload(folder.path(), 99, 0);
        let long_path = "x".repeat(300);
        let deep_path = ["d"; 20].join("/");
        let unsafe_paths = ["", "/etc/x", "../x", "a/../x", "a//b", "./a", "a/", "a\\b", "a\0b", "C:x"];
        for path in unsafe_paths.into_iter().chain([long_path.as_str(), &deep_path]) {
            let error = upload.begin_file(path, 0, &sha256_of(b"")).expect_err(path).to_string();
            assert!(error.starts_with("file.path"), "expected file.path for {path:?}, got {error}");
        }
        upload.begin_file("a", 0, &sha256_of(b"")).expect("expected a new file");
        for path in ["a", "a/b"] {
            assert!(upload.begin_file(path, 0, &sha256_of(b"")).is_err(), "expected an error for {path}");
        }
    }

    #[test]
    fn disk_error_is_a_fault() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut upload = begin_upload(folder.path(), 1, 0);
        // No user, root included, can create a folder below a symbolic link that points to itself.
        fs::remove_dir(&upload.folder).expect("expected the temporary folder");
        std::os::unix::fs::symlink(&upload.folder, &upload.folder).expect("expected a new link");
        assert!(matches!(upload.begin_file("a/b", 0, &sha256_of(b"")), Err(Error::Fault { .. })));
    }

    #[test]
    fn wrong_sizes_and_hashes_are_rejected_and_leave_no_files() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        type UploadCalls = fn(&mut Upload) -> Result<()>;
        // The header declares one file and 4 bytes. Each case is a sequence of calls and the beginning of its error.
        let calls: [(UploadCalls, &str); 7] = [
            (|upload| upload.begin_file("a", 5, &sha256_of(b"")), "header.total_bytes"),
            (|upload| upload.begin_file("a", 4, b"short"), "file.sha256"),
            (|upload| upload.write_chunk(b"x"), "chunk"),
            (|upload| upload.begin_file("a", 1, &sha256_of(b"x")).and_then(|()| upload.write_chunk(b"xy")), "chunk"),
            (
                |upload| upload.begin_file("a", 1, &sha256_of(b"x")).and_then(|()| upload.write_chunk(b"y")),
                "file.sha256",
            ),
            (|upload| upload.begin_file("a", 1, &sha256_of(b"x")).and_then(|()| upload.check_complete()), "file.bytes"),
            (|upload| upload.check_complete(), "header.files"),
        ];
        for (call, field) in calls {
            let mut upload = begin_upload(folder.path(), 1, 4);
            let error = call(&mut upload).expect_err(field).to_string();
            assert!(error.starts_with(field), "expected {field}, got {error}");
        }
        assert_eq!(fs::read_dir(folder.path()).expect("expected a folder").count(), 0);
    }
}
