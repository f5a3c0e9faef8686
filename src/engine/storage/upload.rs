//! Writes uploaded files into a temporary folder. The paths of the files cannot leave the folder. Sizes and SHA-256
//! hashes must equal the values that the client has declared. Files that the server already has are copied from the
//! uploads of other scenes.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sha2::{Digest as _, Sha256};

use super::file_system::{FileSystem, StateFile};
use super::upload_folder::UploadFolder;
use super::upload_record::{RECORD_NAME, UploadRecord, UploadedFiles, find_uploaded_files};
use crate::admission::{Account, PermitHandle};
use crate::engine::content::{ContentHash, hex, parse_hash};
use crate::engine::upload_permits::UploadPermit;
use modalcast_model::error::{Error, Result, fault, fault_in, invalid};

/// Limit on the length of a path in bytes.
const MAX_PATH_BYTES: usize = 240;
/// Limit on the number of components of a path, including the file name.
const MAX_PATH_DEPTH: usize = 16;

/// Bytes of a reused file that are copied at a time.
const COPY_CHUNK_BYTES: usize = 1 << 20;

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
    header: UploadHeader,
    folder: UploadFolder,
    /// Hashes of the files so far, by their paths.
    hashes: BTreeMap<String, ContentHash>,
    /// Sum of the declared sizes of the files so far, in bytes.
    declared_bytes: u64,
    open_file: Option<OpenFile>,
    /// The folders of uploads whose files the client may reuse.
    reusable_folders: Vec<PathBuf>,
    /// The files of `reusable_folders`. Read when the client first reuses a file.
    uploaded_files: Option<UploadedFiles>,
}

/// A complete upload that is not at its final place yet.
#[derive(Debug)]
pub(in crate::engine) struct CompleteUpload {
    pub(in crate::engine) scene: String,
    /// The path to open. An empty path means the folder.
    pub(in crate::engine) entry: String,
    folder: UploadFolder,
}

impl CompleteUpload {
    /// Completes the upload of a folder: adds the record, whose `hashes` are those of all files by their paths, and makes
    /// the folder durable.
    ///
    /// # Errors
    /// `Fault` of the disk; the folder is then removed.
    pub(super) fn new(
        scene: String,
        entry: String,
        folder: UploadFolder,
        hashes: &BTreeMap<String, ContentHash>,
    ) -> Result<Self> {
        let record = UploadRecord::new(&entry, hashes);
        let written = record.write(folder.file_system(), folder.path()).map_err(fault_in("upload"));
        match written.and_then(|()| folder.sync()) {
            Ok(()) => Ok(Self { scene, entry, folder }),
            Err(error) => {
                folder.discard();
                Err(error)
            }
        }
    }

    /// The client that has uploaded the files.
    pub(in crate::engine) fn account(&self) -> Option<&Account> {
        self.folder.account()
    }

    /// Moves the folder to `target_folder`. Replaces the earlier upload in that folder.
    pub(in crate::engine) fn commit(self, target_folder: &Path) -> Result<()> {
        self.folder.move_to(target_folder)
    }
}

/// The file that is being received.
#[derive(Debug)]
struct OpenFile {
    path: String,
    file: Box<dyn StateFile>,
    /// Size that the client declared.
    declared_bytes: u64,
    remaining_bytes: u64,
    hasher: Sha256,
    /// Hash that the client declared.
    declared_sha256: [u8; 32],
}

impl Upload {
    /// The name of the scene.
    pub fn scene(&self) -> &str {
        &self.header.scene
    }

    /// Creates a temporary folder next to the finished uploads. The client may reuse files of the uploads in
    /// `reusable_folders`.
    ///
    /// # Errors
    /// `Invalid` for a malformed entry path, `Fault` of the disk.
    pub(in crate::engine) fn begin(
        uploads: &Path,
        file_system: &Arc<dyn FileSystem>,
        header: UploadHeader,
        permit: UploadPermit,
        reusable_folders: Vec<PathBuf>,
    ) -> Result<Self> {
        if !header.entry.is_empty() {
            validate_path("header.entry", &header.entry)?;
        }
        let folder = UploadFolder::create(uploads, file_system, &header.scene, permit)?;
        Ok(Self {
            header,
            folder,
            hashes: BTreeMap::new(),
            declared_bytes: 0,
            open_file: None,
            reusable_folders,
            uploaded_files: None,
        })
    }

    /// The permit of the upload.
    pub fn permit(&self) -> Option<&PermitHandle> {
        self.folder.permit()
    }

    /// Begins the next file. `bytes` is its size; `sha256` must have 32 bytes.
    ///
    /// # Errors
    /// `Invalid` for a path that leaves the folder or was sent before, for more files or bytes than the header
    /// declares, for a malformed hash, and when the previous file is incomplete; `Fault` of the disk.
    pub fn begin_file(&mut self, path: &str, bytes: u64, sha256: &[u8]) -> Result<()> {
        self.check_file_complete()?;
        validate_path("file.path", path)?;
        let sha256 = parse_hash("file.sha256", sha256)?;
        if self.hashes.insert(path.to_owned(), sha256).is_some() {
            return Err(invalid("file.path", "a path that was not sent yet", path));
        }
        if self.hashes.len() > self.header.files as usize {
            return Err(invalid("header.files", self.header.files.to_string(), self.hashes.len()));
        }
        self.declared_bytes = self.declared_bytes.saturating_add(bytes);
        if self.declared_bytes > self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        let file_path = self.folder.path().join(path);
        let path_conflict = |error: io::Error| match error.kind() {
            ErrorKind::AlreadyExists | ErrorKind::NotADirectory | ErrorKind::InvalidFilename => {
                invalid("file.path", "a path that does not conflict with another file", path)
            }
            _ => fault("upload", error),
        };
        if let Some(parent) = file_path.parent() {
            self.folder.file_system().create_folder(parent).map_err(path_conflict)?;
        }
        let file = self.folder.file_system().create_file(&file_path, true).map_err(path_conflict)?;
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

    /// Adds a file whose content a reusable upload has, by copying it. The arguments are those of [`Self::begin_file`].
    ///
    /// # Errors
    /// `ContentNotFound` when no reusable upload has the content, or its file has changed; otherwise as for
    /// [`Self::begin_file`].
    pub fn reuse_file(&mut self, path: &str, bytes: u64, sha256: &[u8]) -> Result<()> {
        let hash = parse_hash("file.sha256", sha256)?;
        let not_found = || {
            let field = "file.sha256".into();
            Error::ContentNotFound { field, what: "uploaded file", sha256: hex(&hash) }
        };
        let files = self.uploaded_files.get_or_insert_with(|| find_uploaded_files(&self.reusable_folders));
        let mut source =
            files.get(&hash).into_iter().flatten().find_map(|path| File::open(path).ok()).ok_or_else(not_found)?;
        self.begin_file(path, bytes, sha256)?;
        // The content is verified like that of a sent file.
        self.copy_content(&mut source).map_err(|error| match error {
            Error::Invalid { .. } => not_found(),
            other => other,
        })
    }

    /// Copies the content of the current file.
    fn copy_content(&mut self, source: &mut File) -> Result<()> {
        let mut buffer = vec![0; COPY_CHUNK_BYTES];
        while self.open_file.is_some() {
            let length = source.read(&mut buffer).map_err(fault_in("upload"))?;
            if length == 0 {
                break;
            }
            self.write_chunk(&buffer[..length])?;
        }
        self.check_file_complete()
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

    /// Completes the upload. On failure, removes its files.
    ///
    /// # Errors
    /// `Invalid` naming the header field or file that does not match.
    pub(in crate::engine) fn finish(self) -> Result<CompleteUpload> {
        if let Err(error) = self.check_complete() {
            self.discard();
            return Err(error);
        }
        let Self { header: UploadHeader { scene, entry, .. }, folder, hashes, .. } = self;
        CompleteUpload::new(scene, entry, folder, &hashes)
    }

    /// Checks that all declared files and bytes have arrived.
    fn check_complete(&self) -> Result<()> {
        self.check_file_complete()?;
        if self.hashes.len() != self.header.files as usize {
            return Err(invalid("header.files", self.header.files.to_string(), self.hashes.len()));
        }
        if self.declared_bytes != self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        Ok(())
    }

    /// Removes the files. Blocks on the disk.
    pub fn discard(self) {
        self.folder.discard();
    }

    /// Checks the hash of the open file and closes it once all of its bytes have arrived. All files are synced together
    /// when the upload is complete.
    fn finish_file_if_complete(&mut self) -> Result<()> {
        let Some(open_file) = self.open_file.take_if(|open_file| open_file.remaining_bytes == 0) else {
            return Ok(());
        };
        let given: [u8; 32] = open_file.hasher.finalize().into();
        match given == open_file.declared_sha256 {
            true => Ok(()),
            false => Err(invalid(
                "file.sha256",
                hex(&open_file.declared_sha256),
                format!("{} for '{}'", hex(&given), open_file.path),
            )),
        }
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

/// Checks that a path is relative, uses forward slashes and consists of plain names.
fn validate_path(field: &str, path: &str) -> Result<()> {
    let is_plain_name =
        |part: &str| !part.is_empty() && part != "." && part != ".." && !part.contains(['\\', '\0', ':']);
    let depth = path.split('/').count();
    if path == RECORD_NAME {
        return Err(invalid(field, "a name that the server does not use", path));
    }
    if path.len() > MAX_PATH_BYTES || depth > MAX_PATH_DEPTH || !path.split('/').all(is_plain_name) {
        let expected =
            format!("a relative path of plain names, at most {MAX_PATH_BYTES} bytes and {MAX_PATH_DEPTH} parts");
        return Err(invalid(field, expected, format!("{path:?}")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::super::file_system::DiskFileSystem;
    use super::*;
    use crate::admission::Admission;
    use crate::config::Config;
    use crate::engine::upload_permits::UploadPermits;

    fn begin_upload(folder: &Path, files: u32, total_bytes: u64) -> Upload {
        let header = UploadHeader { scene: "s".into(), entry: String::new(), files, total_bytes };
        let permits = UploadPermits::new(&Config::default(), &Admission::default());
        let permit = permits.admit(Account::server(), total_bytes).expect("expected a free permit");
        let disk: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
        Upload::begin(folder, &disk, header, permit, vec![folder.join("known")]).expect("expected a temporary folder")
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
        let upload = upload.finish().expect("expected a complete upload");
        upload.commit(&folder.path().join("target")).expect("expected to move the folder");
        assert_eq!(fs::read(folder.path().join("target/a/b.txt")).expect("expected the file"), b"hello");
        assert_eq!(fs::read_dir(folder.path()).expect("expected a folder").count(), 1);
    }

    #[test]
    fn reused_file_is_copied_and_verified() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut upload = begin_upload(folder.path(), 1, 5);
        upload.begin_file("b.txt", 5, &sha256_of(b"hello")).expect("expected a new file");
        upload.write_chunk(b"hello").expect("expected an accepted chunk");
        let target = folder.path().join("known");
        upload.finish().and_then(|upload| upload.commit(&target)).expect("expected a complete upload");
        let reuse = |bytes: u64, content: &[u8]| {
            let mut upload = begin_upload(folder.path(), 1, bytes);
            upload.reuse_file("copy", bytes, &sha256_of(content)).map(|()| {
                upload.check_complete().expect("expected a complete upload");
                fs::read(upload.folder.path().join("copy")).expect("expected the copy")
            })
        };
        assert_eq!(reuse(5, b"hello").expect("expected a known file"), b"hello");
        // An unknown content, and sizes that contradict the content.
        for (bytes, content) in [(5, b"other"), (4, b"hello"), (6, b"hello")] {
            let error = reuse(bytes, content).expect_err("expected an unknown content");
            assert!(matches!(error, Error::ContentNotFound { .. }), "{error}");
        }
        fs::write(target.join("b.txt"), "HELLO").expect("expected a written file");
        assert!(matches!(reuse(5, b"hello"), Err(Error::ContentNotFound { .. })), "expected a changed file");
        fs::remove_file(target.join("b.txt")).expect("expected to remove a file");
        assert!(matches!(reuse(5, b"hello"), Err(Error::ContentNotFound { .. })), "expected a missing file");
    }

    #[test]
    fn unsafe_and_conflicting_paths_are_rejected() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut upload = begin_upload(folder.path(), 99, 0);
        let long_path = "x".repeat(300);
        let deep_path = ["d"; 20].join("/");
        let unsafe_paths = [RECORD_NAME, "", "/etc/x", "../x", "a/../x", "a//b", "./a", "a/", "a\\b", "a\0b", "C:x"];
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
        fs::remove_dir(upload.folder.path()).expect("expected the temporary folder");
        std::os::unix::fs::symlink(upload.folder.path(), upload.folder.path()).expect("expected a new link");
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
