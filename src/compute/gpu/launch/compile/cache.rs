//! Disk cache of compiled kernels, keyed by the SHA-256 of everything that determines them. A cache failure only costs
//! compile time.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use sha2::{Digest as _, Sha256};

const DIGEST_BYTES: usize = 32;

/// A folder of compiled kernels, or none.
#[derive(Debug, Clone)]
pub(super) struct CubinCache {
    folder: Option<PathBuf>,
}

impl CubinCache {
    /// The folder that the environment selects: MODALCAST_CACHE, or `modalcast` in XDG_CACHE_HOME or `~/.cache`.
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
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let Some(path) = self.path(key) else { return };
        let unique = format!("{}.{}.part", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        let part = path.with_extension(unique);
        let content = [Sha256::digest(bytes).as_slice(), bytes].concat();
        let folder = path.parent().unwrap_or(&path);
        let stored = std::fs::create_dir_all(folder)
            .and_then(|()| std::fs::write(&part, content))
            .and_then(|()| std::fs::rename(&part, &path));
        if let Err(error) = stored {
            // The name of the part is unique to this call, so removing it is safe.
            std::fs::remove_file(&part).ok();
            tracing::warn!(%error, path = %path.display(), "a compiled kernel could not be cached");
        }
    }

    fn path(&self, key: &str) -> Option<PathBuf> {
        Some(self.folder.as_ref()?.join(format!("{key}.cubin")))
    }
}

/// The key of a list of texts. It includes their lengths, so that no two lists share a key.
pub(super) fn cache_key(cache_key_parts: &[&str]) -> String {
    let mut hash = Sha256::new();
    for text in cache_key_parts {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn cache_folder_from(lookup: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let named = |name: &str| lookup(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    named("MODALCAST_CACHE")
        .or_else(|| Some(named("XDG_CACHE_HOME")?.join("modalcast")))
        .or_else(|| Some(named("HOME")?.join(".cache/modalcast")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_put_comes_back_and_what_is_damaged_does_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let cache = CubinCache { folder: Some(folder.path().join("deep/er")) };
        assert_eq!(cache.get("key"), None);
        cache.put("key", b"machine code");
        assert_eq!(cache.get("key").as_deref(), Some(&b"machine code"[..]));
        let path = cache.path("key").expect("a folder");
        let mut bytes = std::fs::read(&path).expect("stored");
        for damage in [bytes.len() - 1, 0] {
            bytes[damage] ^= 1;
            std::fs::write(&path, &bytes).expect("written");
            assert_eq!(cache.get("key"), None, "byte {damage} changed");
            bytes[damage] ^= 1;
        }
        std::fs::write(&path, &bytes[..20]).expect("written");
        assert_eq!(cache.get("key"), None, "cut short");
        cache.put("key", b"machine code");
        assert!(cache.get("key").is_some(), "a damaged entry is replaced");
        let left = std::fs::read_dir(path.parent().expect("a folder")).expect("readable").count();
        assert_eq!(left, 1, "no part is left behind");
    }

    #[test]
    fn an_unwritable_or_unnamed_folder_costs_nothing_but_time() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        for folder in [None, Some(file.path().join("below a file"))] {
            let cache = CubinCache { folder };
            cache.put("key", b"code");
            assert_eq!(cache.get("key"), None);
        }
    }

    #[test]
    fn keys_tell_apart_what_differs_only_in_where_texts_end() {
        assert_ne!(cache_key(&["ab", "c"]), cache_key(&["a", "bc"]));
        assert_eq!(cache_key(&["ab", "c"]), cache_key(&["ab", "c"]));
        assert_eq!(cache_key(&[]).len(), 64);
    }

    #[test]
    fn the_folder_follows_the_environment_in_order() {
        let all = [("MODALCAST_CACHE", "/a"), ("XDG_CACHE_HOME", "/b"), ("HOME", "/c")];
        for (skipped, expected) in [(0, "/a"), (1, "/b/modalcast"), (2, "/c/.cache/modalcast")] {
            let lookup = |name: &str| {
                all[skipped..].iter().find(|(known, _)| *known == name).map(|(_, value)| OsString::from(value))
            };
            assert_eq!(cache_folder_from(lookup), Some(PathBuf::from(expected)));
        }
        assert_eq!(cache_folder_from(|_| Some(OsString::new())), None, "empty means unset");
    }
}
