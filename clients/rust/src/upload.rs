//! Uploads a folder or a single file to the server and opens it as a scene. Each file is sent in chunks, with its
//! relative path, size and SHA-256. Files whose content the server already has are not sent.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use v1::upload_scene_request::Part;

use crate::client::Client;
use crate::error::{Error, Reason, Result, malformed_reply};

/// Bytes of file content per message: far below 4 MiB, the default limit of gRPC.
const CHUNK_BYTES: usize = 512 << 10;

/// Maximum depth of nested folders. Deeper ones are an error, so that a cyclic link does not cause an endless
/// recursion.
const MAX_FOLDER_DEPTH: usize = 16;

/// Number of hashes in one request for known files: the limit of the server.
const FILES_PER_REQUEST: usize = 4096;

/// One file to upload.
#[derive(Clone)]
struct LocalFile {
    local_path: PathBuf,
    /// Path relative to the uploaded folder, size and hash.
    header: v1::UploadFile,
}

impl Client {
    /// Uploads a folder or a single file and opens it under the name `scene`. `entry` is the uploaded path to open; if
    /// it is empty, the folder itself or the single file is opened. Sends only contents that no other uploaded scene of
    /// the server has.
    ///
    /// # Errors
    /// `File` if a file cannot be read; `Status` if the server rejects the upload or cannot open the scene.
    pub async fn upload_scene(&self, path: &Path, scene: &str, entry: &str) -> Result<v1::SceneInfo> {
        let root = path.to_owned();
        let list_task = tokio::task::spawn_blocking(move || list_files(&root));
        let mut files = list_task.await.map_err(|error| Error::file(path, error))??;
        let single_file = if path.is_file() { files.first().map(|file| file.header.path.clone()) } else { None };
        let header = v1::UploadHeader {
            scene: scene.to_owned(),
            entry: if entry.is_empty() { single_file.unwrap_or_default() } else { entry.to_owned() },
            files: u32::try_from(files.len())
                .map_err(|_| Error::file(path, format!("expected fewer than 2^32 files, got {}", files.len())))?,
            total_bytes: files.iter().map(|file| file.header.bytes).sum(),
        };
        self.mark_known_files(&mut files).await?;
        match self.send_upload(path, header.clone(), files.clone()).await {
            // Another client has deleted a scene since `mark_known_files`.
            Err(error) if error.rejection().is_some_and(|rejection| rejection.reason == Reason::ContentNotFound) => {
                files.iter_mut().for_each(|file| file.header.reuse = false);
                self.send_upload(path, header, files).await
            }
            result => result,
        }
    }

    /// Marks the files whose content the server already has. An older server has no such call, and gets all files.
    async fn mark_known_files(&self, files: &mut [LocalFile]) -> Result<()> {
        for files in files.chunks_mut(FILES_PER_REQUEST) {
            let sha256 = files.iter().map(|file| file.header.sha256.clone()).collect();
            let request = v1::FindUploadedFilesRequest { sha256 };
            let found = match self.reply(self.scenes().find_uploaded_files(request).await) {
                Ok(reply) => reply.found,
                Err(Error::Status { code: tonic::Code::Unimplemented, .. }) => return Ok(()),
                Err(error) => return Err(error),
            };
            if found.len() != files.len() {
                return Err(malformed_reply("find_uploaded_files.found", files.len(), found.len()));
            }
            for (file, is_known) in files.iter_mut().zip(found) {
                file.header.reuse = is_known;
            }
        }
        Ok(())
    }

    /// Sends files and opens them as a scene. `path` names the upload in errors.
    async fn send_upload(&self, path: &Path, header: v1::UploadHeader, files: Vec<LocalFile>) -> Result<v1::SceneInfo> {
        // At most 4 messages (2 MiB) are queued. When the queue is full, `send_files` waits.
        let (sender, queue) = mpsc::channel(4);
        let send_task = tokio::task::spawn_blocking(move || send_files(&sender, header, &files));
        let reply = self.reply(self.scenes().upload_scene(ReceiverStream::new(queue)).await);
        // A read error truncates the upload, and the server then rejects the upload. Report the read error, because it
        // is the cause.
        send_task.await.map_err(|error| Error::file(path, error))??;
        reply?.scene.ok_or_else(|| malformed_reply("upload.scene", "a scene", "none"))
    }
}

/// Lists all files below a folder, or the single file `root`, sorted by path.
fn list_files(root: &Path) -> Result<Vec<LocalFile>> {
    let mut paths = vec![];
    if root.is_file() {
        paths.push(root.to_owned());
    } else {
        collect_paths(root, 0, &mut paths)?;
    }
    paths.sort();
    let base = if root.is_file() { root.parent().unwrap_or(root) } else { root };
    paths.into_iter().map(|path| describe_file(base, path)).collect()
}

/// Appends the paths of all files below a folder.
fn collect_paths(folder: &Path, depth: usize, paths: &mut Vec<PathBuf>) -> Result<()> {
    if depth > MAX_FOLDER_DEPTH {
        let reason = format!("expected at most {MAX_FOLDER_DEPTH} nested folders, got more");
        return Err(Error::file(folder, reason));
    }
    for entry in folder.read_dir().map_err(|error| Error::file(folder, error))? {
        let path = entry.map_err(|error| Error::file(folder, error))?.path();
        if path.is_dir() {
            collect_paths(&path, depth + 1, paths)?;
        } else {
            paths.push(path);
        }
    }
    Ok(())
}

/// Computes the path relative to `base`, the size and the hash of a file.
fn describe_file(base: &Path, local_path: PathBuf) -> Result<LocalFile> {
    let relative_path = local_path.strip_prefix(base).map_err(|error| Error::file(&local_path, error))?;
    let names = relative_path.components().map(|component| component.as_os_str().to_str());
    let names = names.collect::<Option<Vec<_>>>();
    let path = names.ok_or_else(|| Error::file(&local_path, "the name is not UTF-8"))?.join("/");
    let mut hash = Sha256::new();
    let mut bytes = 0;
    read_chunks(&local_path, |chunk| {
        hash.update(chunk);
        bytes += chunk.len() as u64;
        true
    })?;
    let header = v1::UploadFile { path, bytes, sha256: hash.finalize().to_vec().into(), reuse: false };
    Ok(LocalFile { local_path, header })
}

/// Sends the header, then each file and its chunks; a reused file has no chunks. Stops without error if the server has
/// closed the stream.
fn send_files(
    sender: &mpsc::Sender<v1::UploadSceneRequest>,
    header: v1::UploadHeader,
    files: &[LocalFile],
) -> Result<()> {
    let send = |part| sender.blocking_send(v1::UploadSceneRequest { part: Some(part) }).is_ok();
    let mut is_open = send(Part::Header(header));
    for file in files {
        is_open = is_open && send(Part::File(file.header.clone()));
        if !is_open {
            return Ok(());
        }
        if file.header.reuse {
            continue;
        }
        read_chunks(&file.local_path, |chunk| {
            is_open = send(Part::Chunk(Bytes::copy_from_slice(chunk)));
            is_open
        })?;
    }
    Ok(())
}

/// Reads a file chunk by chunk until its end, or until `process_chunk` returns false.
fn read_chunks(path: &Path, mut process_chunk: impl FnMut(&[u8]) -> bool) -> Result<()> {
    let file_error = |error: std::io::Error| Error::file(path, error);
    let mut file = File::open(path).map_err(file_error)?;
    let mut buffer = vec![0; CHUNK_BYTES];
    loop {
        let length = file.read(&mut buffer).map_err(file_error)?;
        if length == 0 || !process_chunk(&buffer[..length]) {
            return Ok(());
        }
    }
}
