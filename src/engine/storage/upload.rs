//! Writes uploaded files to disk. Paths cannot leave a new temporary folder; sizes and SHA-256 hashes are checked
//! against the declared ones. Dropping an unfinished [`Upload`] removes its folder, on a
//! thread of its own; [`Upload::discard`] removes it before it returns.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write as _};
use std::mem;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use sha2::{Digest as _, Sha256};
use tokio::sync::OwnedSemaphorePermit;

use modalcast_model::error::{Result, fault_in, invalid};

/// Limits of a path: its length in bytes and its number of components, the file name included.
const MAX_PATH_BYTES: usize = 240;
const MAX_PATH_DEPTH: usize = 16;

static COUNTER: AtomicU64 = AtomicU64::new(0);

/// The header of an upload: what the client is going to send.
#[derive(Debug, Clone, Default)]
pub struct UploadHeader {
    /// The name to open the scene under.
    pub scene: String,
    /// The uploaded path to open; empty means the folder.
    pub entry: String,
    pub files: u32,
    pub total_bytes: u64,
}

/// An upload in progress. Its methods block on the disk.
#[derive(Debug)]
pub struct Upload {
    pub(in crate::engine) header: UploadHeader,
    folder: PathBuf,
    paths: BTreeSet<String>,
    /// Sum of the declared sizes of the files so far, in bytes.
    declared_bytes: u64,
    open: Option<OpenFile>,
    /// Permit that counts against the limit on concurrent uploads, until the folder is moved or removed.
    permit: Option<OwnedSemaphorePermit>,
}

/// The file that is being received.
#[derive(Debug)]
struct OpenFile {
    path: String,
    file: File,
    bytes: u64,
    left: u64,
    hasher: Sha256,
    sha256: [u8; 32],
}

impl Upload {
    /// Creates a temporary folder next to the finished uploads.
    ///
    /// # Errors
    /// `Invalid` for a malformed entry path, `Fault` of the disk.
    pub(in crate::engine) fn begin(uploads: &Path, header: UploadHeader, place: OwnedSemaphorePermit) -> Result<Self> {
        if !header.entry.is_empty() {
            validate_path("header.entry", &header.entry)?;
        }
        let count = COUNTER.fetch_add(1, Ordering::Relaxed);
        let folder = uploads.join(format!(".{}-{count}", header.scene));
        fs::create_dir_all(&folder).map_err(fault_in("upload"))?;
        Ok(Self { header, folder, paths: BTreeSet::new(), declared_bytes: 0, open: None, permit: Some(place) })
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
            .map_err(|_| invalid(format!("file.sha256 of '{path}'"), "32 bytes", format!("{} bytes", sha256.len())))?;
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
        let place = self.folder.join(path);
        let clash = |error: io::Error| match error.kind() {
            ErrorKind::AlreadyExists | ErrorKind::NotADirectory | ErrorKind::InvalidFilename => {
                invalid("file.path", "a path whose folders are no files", path)
            }
            _ => fault_in("upload")(error),
        };
        if let Some(parent) = place.parent() {
            fs::create_dir_all(parent).map_err(clash)?;
        }
        let file = File::create_new(&place).map_err(clash)?;
        self.open = Some(OpenFile { path: path.into(), file, bytes, left: bytes, hasher: Sha256::new(), sha256 });
        self.finish_file()
    }

    /// Appends bytes to the current file.
    ///
    /// # Errors
    /// `Invalid` when the bytes exceed the declared size or the complete file has a different hash; `Fault` of the
    /// disk.
    pub fn write_chunk(&mut self, bytes: &[u8]) -> Result<()> {
        let count = bytes.len() as u64;
        let Some(open) = self.open.as_mut().filter(|open| count <= open.left) else {
            let left = self.open.as_ref().map_or(0, |open| open.left);
            return Err(invalid("chunk", format!("at most the {left} bytes that are left of the file"), count));
        };
        open.file.write_all(bytes).map_err(fault_in("upload"))?;
        open.hasher.update(bytes);
        open.left -= count;
        self.finish_file()
    }

    /// Checks that all declared files and bytes have arrived.
    ///
    /// # Errors
    /// `Invalid` naming the header field or file that does not match.
    pub(in crate::engine) fn finish(&mut self) -> Result<()> {
        self.check_file_complete()?;
        if self.paths.len() != self.header.files as usize {
            return Err(invalid("header.files", self.header.files.to_string(), self.paths.len()));
        }
        if self.declared_bytes != self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        Ok(())
    }

    /// Moves the folder to `place` and replaces an earlier upload of that name.
    pub(in crate::engine) fn commit(mut self, place: &Path) -> Result<()> {
        if place.exists() {
            fs::remove_dir_all(place).map_err(fault_in("upload"))?;
        }
        fs::rename(&self.folder, place).map_err(fault_in("upload"))?;
        self.folder = PathBuf::new();
        Ok(())
    }

    /// Removes the folder. Blocks on the disk.
    pub fn discard(mut self) {
        fs::remove_dir_all(mem::take(&mut self.folder)).ok(); // The next start removes leftovers.
    }

    fn finish_file(&mut self) -> Result<()> {
        let Some(open) = self.open.take_if(|open| open.left == 0) else { return Ok(()) };
        let given: [u8; 32] = open.hasher.finalize().into();
        if given != open.sha256 {
            return Err(invalid(format!("file.sha256 of '{}'", open.path), hex(&open.sha256), hex(&given)));
        }
        Ok(())
    }

    fn check_file_complete(&self) -> Result<()> {
        match &self.open {
            None => Ok(()),
            Some(open) => {
                let given = format!("{} bytes", open.bytes - open.left);
                Err(invalid(format!("file.bytes of '{}'", open.path), format!("{} bytes", open.bytes), given))
            }
        }
    }
}

impl Drop for Upload {
    /// Removes the folder on a thread that may block if this is a thread of a runtime.
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
    let is_plain = |part: &str| !part.is_empty() && part != "." && part != ".." && !part.contains(['\\', '\0', ':']);
    let parts = path.split('/').count();
    if path.len() > MAX_PATH_BYTES || parts > MAX_PATH_DEPTH || !path.split('/').all(is_plain) {
        let expected =
            format!("a relative path of plain names, at most {MAX_PATH_BYTES} bytes and {MAX_PATH_DEPTH} parts");
        return Err(invalid(field, expected, format!("{path:?}")));
    }
    Ok(())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::error::Error;

    fn begin(folder: &Path, files: u32, total_bytes: u64) -> Upload {
        let header = UploadHeader { scene: "s".into(), entry: String::new(), files, total_bytes };
        let places = std::sync::Arc::new(tokio::sync::Semaphore::new(1));
        Upload::begin(folder, header, places.try_acquire_owned().expect("free")).expect("begins")
    }

    fn sha(bytes: &[u8]) -> Vec<u8> {
        Sha256::digest(bytes).to_vec()
    }

    #[test]
    fn files_arrive_in_chunks_and_settle_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut upload = begin(folder.path(), 2, 5);
        upload.begin_file("a/b.txt", 5, &sha(b"hello")).expect("a file");
        upload.write_chunk(b"he").expect("fits");
        upload.write_chunk(b"llo").expect("fits");
        upload.begin_file("empty", 0, &sha(b"")).expect("an empty file");
        upload.finish().expect("whole");
        upload.commit(&folder.path().join("done")).expect("settles");
        assert_eq!(fs::read(folder.path().join("done/a/b.txt")).expect("is there"), b"hello");
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1);
    }

    #[test]
    fn bad_paths_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut upload = begin(folder.path(), 99, 0);
        let long = "x".repeat(300);
        let deep = ["d"; 20].join("/");
        for path in ["", "/etc/x", "../x", "a/../x", "a//b", "./a", "a/", "a\\b", "a\0b", "C:x", &long, &deep] {
            let refusal = upload.begin_file(path, 0, &sha(b"")).expect_err(path).to_string();
            assert!(refusal.starts_with("file.path"), "{refusal}");
        }
        upload.begin_file("a", 0, &sha(b"")).expect("plain");
        for path in ["a", "a/b"] {
            assert!(upload.begin_file(path, 0, &sha(b"")).is_err(), "{path} passed");
        }
    }

    #[test]
    fn a_fault_of_the_disk_is_not_the_clients() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut upload = begin(folder.path(), 1, 0);
        // No user, root included, can create a folder below a symbolic link that points to itself.
        fs::remove_dir(&upload.folder).expect("is there");
        std::os::unix::fs::symlink(&upload.folder, &upload.folder).expect("linked");
        assert!(matches!(upload.begin_file("a/b", 0, &sha(b"")), Err(Error::Fault { .. })));
    }

    #[test]
    fn sizes_and_hashes_are_held_to_and_nothing_is_left_of_a_failure() {
        let folder = tempfile::tempdir().expect("a folder");
        let refusal = |act: fn(&mut Upload) -> Result<()>| {
            let mut upload = begin(folder.path(), 1, 4);
            act(&mut upload).expect_err("refused").to_string()
        };
        assert!(refusal(|up| up.begin_file("a", 5, &sha(b""))).starts_with("header.total_bytes"));
        assert!(refusal(|up| up.begin_file("a", 4, b"short")).starts_with("file.sha256"));
        assert!(refusal(|up| up.write_chunk(b"x")).starts_with("chunk"));
        assert!(
            refusal(|up| up.begin_file("a", 1, &sha(b"x")).and_then(|()| up.write_chunk(b"xy"))).starts_with("chunk")
        );
        assert!(
            refusal(|up| up.begin_file("a", 1, &sha(b"x")).and_then(|()| up.write_chunk(b"y")))
                .starts_with("file.sha256")
        );
        assert!(refusal(|up| up.begin_file("a", 1, &sha(b"x")).and_then(|()| up.finish())).starts_with("file.bytes"));
        assert!(refusal(Upload::finish).starts_with("header.files"));
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 0);
    }
}
