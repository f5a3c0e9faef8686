//! Disk cache of compiled kernels. The key is the SHA-256 of everything that determines the machine code. After a cache
//! failure, the kernel is compiled again.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use sha2::{Digest as _, Sha256};

const DIGEST_BYTES: usize = 32;

/// The cache. Without a folder it stores nothing. A file contains the SHA-256 of the machine code, then the machine
/// code.
#[derive(Debug, Clone)]
pub(super) struct CubinCache {
    folder: Option<PathBuf>,
}

impl CubinCache {
    /// The cache in the folder that the environment selects: MODALCAST_CACHE, or `modalcast` in XDG_CACHE_HOME or
    /// `~/.cache`.
    pub(super) fn from_env() -> Self {
        Self { folder: cache_folder_from(|name| std::env::var_os(name)) }
    }

    /// The folder of the compiled kernels.
    pub(super) fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// The bytes stored under a key, if they exist and are not damaged.
    pub(super) fn get(&self, key: &str) -> Option<Vec<u8>> {
        let mut bytes = std::fs::read(self.path(key)?).ok()?;
        if bytes.len() <= DIGEST_BYTES || Sha256::digest(&bytes[DIGEST_BYTES..]).as_slice() != &bytes[..DIGEST_BYTES] {
            tracing::warn!(key, "a cached kernel is damaged and will be compiled again");
            return None;
        }
        Some(bytes.split_off(DIGEST_BYTES))
    }

    /// Stores bytes under a key. The file is renamed into place, so it appears complete or not at all, and several
    /// servers may share the folder.
    pub(super) fn put(&self, key: &str, bytes: &[u8]) {
        static TEMPORARY_FILE_COUNT: AtomicU64 = AtomicU64::new(0);
        let Some(path) = self.path(key) else { return };
        let extension = format!("{}.{}.part", std::process::id(), TEMPORARY_FILE_COUNT.fetch_add(1, Ordering::Relaxed));
        let temporary_path = path.with_extension(extension);
        let content = [Sha256::digest(bytes).as_slice(), bytes].concat();
        let folder = path.parent().unwrap_or(&path);
        let store_result = std::fs::create_dir_all(folder)
            .and_then(|()| std::fs::write(&temporary_path, content))
            .and_then(|()| std::fs::rename(&temporary_path, &path));
        if let Err(error) = store_result {
            // The name of the temporary file is unique to this call, so removing it is safe.
            std::fs::remove_file(&temporary_path).ok();
            tracing::warn!(%error, path = %path.display(), "a compiled kernel could not be cached");
        }
    }

    fn path(&self, key: &str) -> Option<PathBuf> {
        Some(self.folder.as_ref()?.join(format!("{key}.cubin")))
    }
}

/// The key of a list of texts. It includes their lengths, so that no two lists share a key.
pub(super) fn cache_key(texts: &[&str]) -> String {
    let mut hash = Sha256::new();
    for text in texts {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn cache_folder_from(lookup: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let path_variable = |name: &str| lookup(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    path_variable("MODALCAST_CACHE")
        .or_else(|| Some(path_variable("XDG_CACHE_HOME")?.join("modalcast")))
        .or_else(|| Some(path_variable("HOME")?.join(".cache/modalcast")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_stored_bytes_unless_the_file_is_damaged() {
        let folder = tempfile::tempdir().expect("a folder");
        let cache = CubinCache { folder: Some(folder.path().join("missing/folders")) };
        assert_eq!(cache.get("key"), None);
        cache.put("key", b"machine code");
        assert_eq!(cache.get("key").as_deref(), Some(&b"machine code"[..]));
        let path = cache.path("key").expect("a folder");
        let mut bytes = std::fs::read(&path).expect("a stored kernel");
        for damaged_byte in [bytes.len() - 1, 0] {
            bytes[damaged_byte] ^= 1;
            std::fs::write(&path, &bytes).expect("a written file");
            assert_eq!(cache.get("key"), None, "byte {damaged_byte} changed");
            bytes[damaged_byte] ^= 1;
        }
        std::fs::write(&path, &bytes[..20]).expect("a written file");
        assert_eq!(cache.get("key"), None, "a truncated file");
        cache.put("key", b"machine code");
        assert!(cache.get("key").is_some(), "a damaged entry is replaced");
        let file_count = std::fs::read_dir(path.parent().expect("a folder")).expect("a readable folder").count();
        assert_eq!(file_count, 1, "expected no temporary file");
    }

    #[test]
    fn missing_or_unwritable_folder_disables_the_cache() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        for folder in [None, Some(file.path().join("below a file"))] {
            let cache = CubinCache { folder };
            cache.put("key", b"code");
            assert_eq!(cache.get("key"), None);
        }
    }

    #[test]
    fn key_depends_on_the_lengths_of_the_texts() {
        assert_ne!(cache_key(&["ab", "c"]), cache_key(&["a", "bc"]));
        assert_eq!(cache_key(&["ab", "c"]), cache_key(&["ab", "c"]));
        assert_eq!(cache_key(&[]).len(), 64);
    }

    #[test]
    fn first_set_variable_selects_the_folder() {
        let variables = [("MODALCAST_CACHE", "/a"), ("XDG_CACHE_HOME", "/b"), ("HOME", "/c")];
        for (skipped, expected) in [(0, "/a"), (1, "/b/modalcast"), (2, "/c/.cache/modalcast")] {
            let lookup = |name: &str| {
                variables[skipped..]
                    .iter()
                    .find(|(variable, _)| *variable == name)
                    .map(|(_, value)| OsString::from(value))
            };
            assert_eq!(cache_folder_from(lookup), Some(PathBuf::from(expected)));
        }
        assert_eq!(cache_folder_from(|_| Some(OsString::new())), None, "an empty variable counts as unset");
    }
}
