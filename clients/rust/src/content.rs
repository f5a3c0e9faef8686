//! Arrays and textures by their SHA-256, fetched from a server. A folder on this machine can store them, so that equal
//! content is received only once, also from different scenes and servers.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};

use crate::assemble::{Assembler, Chunk};
use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};

/// A SHA-256 hash.
pub type ContentHash = [u8; 32];

/// Number of hashes in one request: the limit of the server.
const HASHES_PER_REQUEST: usize = 4096;

/// Number of files written so far. Makes the names of temporary files unique.
static FILE_COUNTER: AtomicU64 = AtomicU64::new(0);

impl Client {
    /// Gets arrays and textures of a scene by the hashes in its description ([`crate::DescriptionRequest::hashes`]).
    /// Returns their bytes in the order of `hashes`.
    ///
    /// # Errors
    /// `Status` with the reason `ContentNotFound` if the scene has no content with one of the hashes; `Malformed` if
    /// the bytes do not have the hash, or all contents together exceed the reply limit.
    pub async fn read_content(&self, scene: &str, hashes: &[ContentHash]) -> Result<Vec<Bytes>> {
        let mut contents = Vec::with_capacity(hashes.len());
        let mut remaining_bytes = self.max_reply_bytes;
        for hashes in hashes.chunks(HASHES_PER_REQUEST) {
            let sha256 = hashes.iter().map(|hash| Bytes::copy_from_slice(hash)).collect();
            let request = v1::ReadContentRequest { scene: scene.to_owned(), sha256 };
            let mut messages = self.replies(self.scene_streams().read_content(request).await)?;
            for (item, hash) in hashes.iter().enumerate() {
                let mut assembler = Assembler::new("content", remaining_bytes);
                let bytes = loop {
                    let message = messages.next().await?;
                    let message = message.ok_or(Error::StreamEnded { awaited_reply: "the last chunk of a content" })?;
                    if message.item as usize != item {
                        return Err(malformed_reply("content.item", item, message.item));
                    }
                    // Every message has the total. The assembler expects it on the first chunk only.
                    let head = (!assembler.is_open()).then_some(((), message.total));
                    let chunk = Chunk { head, offset: message.offset, data: message.data };
                    if let Some(((), bytes)) = assembler.push(chunk)? {
                        break bytes;
                    }
                };
                check_hash(&bytes, hash)?;
                remaining_bytes -= bytes.len() as u64;
                contents.push(bytes);
            }
        }
        Ok(contents)
    }

    /// Gets contents by their hashes: from the folder `cache` if it contains them, else from the server. Stores the
    /// received contents in the folder.
    pub(crate) async fn fetch_contents(
        &self,
        scene: &str,
        hashes: BTreeSet<ContentHash>,
        cache: Option<&Path>,
    ) -> Result<BTreeMap<ContentHash, Bytes>> {
        let cache = cache.map(|folder| ContentCache { folder: folder.to_owned() });
        let mut contents = match &cache {
            Some(cache) => cache.clone().load(hashes.clone()).await?,
            None => BTreeMap::new(),
        };
        let missing_hashes: Vec<ContentHash> = hashes.into_iter().filter(|hash| !contents.contains_key(hash)).collect();
        if missing_hashes.is_empty() {
            return Ok(contents);
        }
        let received: Vec<Bytes> = self.read_content(scene, &missing_hashes).await?;
        let received: Vec<(ContentHash, Bytes)> = missing_hashes.into_iter().zip(received).collect();
        if let Some(cache) = cache {
            cache.store(received.clone()).await?;
        }
        contents.extend(received);
        Ok(contents)
    }
}

fn hash_of(bytes: &[u8]) -> ContentHash {
    Sha256::digest(bytes).into()
}

fn check_hash(bytes: &[u8], expected: &ContentHash) -> Result<()> {
    let given = hash_of(bytes);
    if given == *expected {
        return Ok(());
    }
    Err(malformed_reply("content.data", format!("bytes with the SHA-256 {}", hex(expected)), hex(&given)))
}

fn hex(hash: &ContentHash) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A folder with one file per content. The name of a file is the hash of its bytes in hexadecimal digits.
#[derive(Debug, Clone)]
struct ContentCache {
    folder: PathBuf,
}

impl ContentCache {
    fn path(&self, hash: &ContentHash) -> PathBuf {
        self.folder.join(hex(hash))
    }

    /// Reads the contents that are present. A damaged file counts as missing.
    async fn load(self, hashes: BTreeSet<ContentHash>) -> Result<BTreeMap<ContentHash, Bytes>> {
        let load_one = move |hash: ContentHash| {
            let bytes = std::fs::read(self.path(&hash)).ok()?;
            (hash_of(&bytes) == hash).then(|| (hash, Bytes::from(bytes)))
        };
        run_blocking(move || Ok(hashes.into_iter().filter_map(load_one).collect())).await
    }

    /// Writes contents. Each file is complete or missing, also if several threads or processes write the same content.
    async fn store(self, contents: Vec<(ContentHash, Bytes)>) -> Result<()> {
        run_blocking(move || {
            std::fs::create_dir_all(&self.folder).map_err(|error| Error::file(&self.folder, error))?;
            for (hash, bytes) in contents {
                let path = self.path(&hash);
                let number = FILE_COUNTER.fetch_add(1, Ordering::Relaxed);
                let temporary_path = path.with_extension(format!("{}-{number}.new", std::process::id()));
                let result = std::fs::write(&temporary_path, &bytes);
                result.and_then(|()| std::fs::rename(&temporary_path, &path)).map_err(|error| {
                    std::fs::remove_file(&temporary_path).ok();
                    Error::file(&path, error)
                })?;
            }
            Ok(())
        })
        .await
    }
}

/// Runs file access on the blocking pool of the runtime.
async fn run_blocking<T: Send + 'static>(work: impl FnOnce() -> Result<T> + Send + 'static) -> Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(|error| Error::file("content cache", error))?
}
