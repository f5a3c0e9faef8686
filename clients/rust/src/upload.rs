//! Uploads a folder or a single file to the server and opens it as a scene. Each file is sent in chunks, with its
//! relative path, size and SHA-256.

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
use crate::error::{Error, Result, malformed_reply};

/// Bytes per message: far below 4 MiB, the default limit of gRPC.
const CHUNK: usize = 512 << 10;

/// The most nested folders. Deeper ones are an error, so that a cyclic link ends.
const DEPTH: usize = 16;

/// One file to upload.
struct Entry {
    disk: PathBuf,
    file: v1::UploadFile,
}

impl Client {
    /// Uploads a folder or a single file and opens it under the name `scene`. `entry` is the uploaded path to open; if
    /// it is empty, the folder itself or the single file is opened.
    ///
    /// # Errors
    /// `File` if a file cannot be read; `Status` if the server refuses the upload or cannot open the scene.
    pub async fn upload_scene(&self, path: &Path, scene: &str, entry: &str) -> Result<v1::SceneInfo> {
        let (root, listing) = (
            path.to_owned(),
            tokio::task::spawn_blocking({
                let root = path.to_owned();
                move || list(&root)
            }),
        );
        let entries = listing.await.map_err(|fault| Error::file(&root, fault))??;
        let single = if root.is_file() { entries.first().map(|only| only.file.path.clone()) } else { None };
        let header = v1::UploadHeader {
            scene: scene.to_owned(),
            entry: if entry.is_empty() { single.unwrap_or_default() } else { entry.to_owned() },
            files: u32::try_from(entries.len()).map_err(|_| Error::file(&root, "more than 2^32 files"))?,
            total_bytes: entries.iter().map(|entry| entry.file.bytes).sum(),
        };
        let (sender, queue) = mpsc::channel(4);
        let reading = tokio::task::spawn_blocking(move || send_all(&sender, header, &entries));
        let reply = self.reply(self.scenes().upload_scene(ReceiverStream::new(queue)).await);
        // A read error truncates the upload, and the server refuses it. Report the read error, which is the cause.
        reading.await.map_err(|fault| Error::file(&root, fault))??;
        reply?.scene.ok_or_else(|| malformed_reply("upload.scene", "a scene", "none"))
    }
}

/// All files below a folder, sorted by path, with size and hash.
fn list(root: &Path) -> Result<Vec<Entry>> {
    let mut paths = vec![];
    if root.is_file() {
        paths.push(root.to_owned());
    } else {
        walk(root, 0, &mut paths)?;
    }
    paths.sort();
    let base = if root.is_file() { root.parent().unwrap_or(root) } else { root };
    paths.into_iter().map(|disk| describe(base, disk)).collect()
}

fn walk(folder: &Path, depth: usize, paths: &mut Vec<PathBuf>) -> Result<()> {
    if depth > DEPTH {
        return Err(Error::file(folder, format!("more than {DEPTH} folders deep")));
    }
    for item in folder.read_dir().map_err(|fault| Error::file(folder, fault))? {
        let path = item.map_err(|fault| Error::file(folder, fault))?.path();
        if path.is_dir() {
            walk(&path, depth + 1, paths)?;
        } else {
            paths.push(path);
        }
    }
    Ok(())
}

fn describe(base: &Path, disk: PathBuf) -> Result<Entry> {
    let relative = disk.strip_prefix(base).map_err(|fault| Error::file(&disk, fault))?;
    let names = relative.components().map(|part| part.as_os_str().to_str());
    let names = names.collect::<Option<Vec<_>>>().ok_or_else(|| Error::file(&disk, "the name is not UTF-8"))?;
    let path = names.join("/");
    let mut hash = Sha256::new();
    let mut bytes = 0;
    read(&disk, |chunk| {
        hash.update(chunk);
        bytes += chunk.len() as u64;
        true
    })?;
    Ok(Entry { disk, file: v1::UploadFile { path, bytes, sha256: hash.finalize().to_vec().into() } })
}

/// Sends the header, then each file and its chunks. Stops without error if the server has closed the stream.
fn send_all(sender: &mpsc::Sender<v1::UploadSceneRequest>, header: v1::UploadHeader, entries: &[Entry]) -> Result<()> {
    let send = |part| sender.blocking_send(v1::UploadSceneRequest { part: Some(part) }).is_ok();
    let mut listening = send(Part::Header(header));
    for entry in entries {
        listening = listening && send(Part::File(entry.file.clone()));
        if !listening {
            return Ok(());
        }
        read(&entry.disk, |chunk| {
            listening = send(Part::Chunk(Bytes::copy_from_slice(chunk)));
            listening
        })?;
    }
    Ok(())
}

/// Reads a file chunk by chunk while `more` returns true.
fn read(path: &Path, mut more: impl FnMut(&[u8]) -> bool) -> Result<()> {
    let fail = |fault: std::io::Error| Error::file(path, fault);
    let mut file = File::open(path).map_err(fail)?;
    let mut buffer = vec![0; CHUNK];
    loop {
        let got = file.read(&mut buffer).map_err(fail)?;
        if got == 0 || !more(&buffer[..got]) {
            return Ok(());
        }
    }
}
