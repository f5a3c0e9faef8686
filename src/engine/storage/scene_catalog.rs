//! The catalog of open scenes in `scenes.json`, and the lock that limits a state folder to one server.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};

use super::atomic_file::write_atomic;
use super::uploaded_files::HashLists;
use crate::engine::lock::lock;
use modalcast_model::error::{Error, Result, fault_in, invalid};

/// Where a scene comes from.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum SceneProvenance {
    /// A built-in scene or a path inside the repository.
    Repository { source: String },
    /// Files that a client uploaded. `entry` is the path to open. An empty `entry` means the folder.
    Upload { entry: String },
}

impl SceneProvenance {
    /// Readable description for lists and errors.
    pub fn label(&self) -> String {
        match self {
            Self::Repository { source } => source.clone(),
            Self::Upload { entry } if entry.is_empty() => "uploaded".into(),
            Self::Upload { entry } => format!("uploaded: {entry}"),
        }
    }
}

/// The names and provenances of the open scenes, written to disk at every change.
#[derive(Debug)]
pub(in crate::engine) struct SceneCatalog {
    folder: PathBuf,
    entries: Mutex<BTreeMap<String, SceneProvenance>>,
    /// File lock of the server that uses the folder. The operating system releases it when the process dies.
    folder_lock: Mutex<Option<File>>,
}

impl SceneCatalog {
    /// Locks the folder, reads its catalog and removes unfinished uploads.
    ///
    /// # Errors
    /// `Unavailable` when another server uses the folder, or when the folder cannot be created or read.
    pub(in crate::engine) fn open(folder: &Path) -> Result<Self> {
        let unavailable = |reason: String| Error::Unavailable {
            what: "state folder",
            reason,
            remedy: "Name another folder with --state".into(),
        };
        let unusable_folder = |error: std::io::Error| unavailable(format!("{}: {error}", folder.display()));
        fs::create_dir_all(folder.join("uploads")).map_err(unusable_folder)?;
        let folder_lock = File::create(folder.join("lock")).map_err(unusable_folder)?;
        folder_lock.try_lock().map_err(|_| unavailable(format!("{} is in use by another server", folder.display())))?;
        let entries = read_catalog(&folder.join("scenes.json")).map_err(unusable_folder)?;
        remove_leftovers(&folder.join("uploads"));
        let (entries, folder_lock) = (Mutex::new(entries), Mutex::new(Some(folder_lock)));
        Ok(Self { folder: folder.to_owned(), entries, folder_lock })
    }

    pub(in crate::engine) fn entries(&self) -> BTreeMap<String, SceneProvenance> {
        self.lock_entries().clone()
    }

    /// Adds a scene and writes the catalog. A failure leaves the catalog unchanged.
    pub(in crate::engine) fn add(&self, name: &str, provenance: &SceneProvenance) -> Result<()> {
        self.change_entries(|entries| entries.insert(name.to_owned(), provenance.clone())).map(drop)
    }

    /// Removes a scene and writes the catalog. Returns whether the scene was listed. A failure leaves the catalog
    /// unchanged.
    pub(in crate::engine) fn remove(&self, name: &str) -> Result<bool> {
        self.change_entries(|entries| entries.remove(name)).map(|entry| entry.is_some())
    }

    /// The folder of the checkpoints.
    pub(in crate::engine) fn checkpoint_folder(&self) -> PathBuf {
        self.folder.join("steps")
    }

    /// The folder of all uploads.
    pub(in crate::engine) fn uploads(&self) -> PathBuf {
        self.folder.join("uploads")
    }

    /// The folder of an upload's files.
    pub(in crate::engine) fn upload_folder(&self, name: &str) -> PathBuf {
        self.uploads().join(name)
    }

    /// The hashes of the files of all uploads.
    pub(in crate::engine) fn hash_lists(&self) -> HashLists {
        HashLists::new(self.folder.join("upload-hashes"), self.uploads())
    }

    /// Releases the lock, so that another server may use the folder.
    pub(in crate::engine) fn release(&self) {
        lock(&self.folder_lock).take();
    }

    /// Changes the catalog on disk, and in memory only if that succeeds, so that both agree.
    fn change_entries<T>(&self, change: impl FnOnce(&mut BTreeMap<String, SceneProvenance>) -> T) -> Result<T> {
        let mut entries = self.lock_entries();
        let mut changed_entries = entries.clone();
        let result = change(&mut changed_entries);
        let text = serde_json::to_vec_pretty(&changed_entries).map_err(fault_in("writing scenes.json"))?;
        write_atomic(&self.folder.join("scenes.json"), &text).map_err(fault_in("writing scenes.json"))?;
        *entries = changed_entries;
        Ok(result)
    }

    fn lock_entries(&self) -> MutexGuard<'_, BTreeMap<String, SceneProvenance>> {
        lock(&self.entries)
    }
}

/// Reads the catalog. A missing file yields an empty catalog. A damaged file is renamed to
/// [`unused_backup_path`] and yields an empty catalog, so that the server can start.
fn read_catalog(path: &Path) -> io::Result<BTreeMap<String, SceneProvenance>> {
    let bytes = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
        result => result?,
    };
    serde_json::from_slice(&bytes).or_else(|error| {
        let backup = unused_backup_path(path);
        tracing::warn!(%error, "scenes.json is damaged and renamed to {}; no scene is reopened", backup.display());
        fs::rename(path, backup).map(|()| BTreeMap::new())
    })
}

/// The first of `scenes.json.damaged`, `scenes.json.damaged.1`, ... that does not exist.
fn unused_backup_path(path: &Path) -> PathBuf {
    let mut backup = path.with_extension("json.damaged");
    let mut number = 0;
    while backup.exists() {
        number += 1;
        backup = path.with_extension(format!("json.damaged.{number}"));
    }
    backup
}

/// Removes uploads that a killed server did not finish.
fn remove_leftovers(uploads: &Path) {
    let Ok(folders) = fs::read_dir(uploads) else { return };
    for folder in folders.flatten() {
        if folder.file_name().to_string_lossy().starts_with('.') {
            fs::remove_dir_all(folder.path()).ok(); // The next start tries again.
        }
    }
}

/// Returns `name` if it is valid as the name of a scene. The name is also used as a file name.
///
/// # Errors
/// `Invalid` unless the name has 1 to 64 ASCII letters, digits, dots, dashes and underscores and does not start with a
/// dot.
pub fn validate_scene_name(name: &str) -> Result<&str> {
    let is_allowed = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    if name.is_empty() || name.len() > 64 || name.starts_with('.') || !name.chars().all(is_allowed) {
        let expected = "1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-', no dot first";
        return Err(invalid("scene", expected, format!("{name:?}")));
    }
    Ok(name)
}

/// The default name of a scene: the last path component of its source without extension, with `-` in place of
/// characters that are not allowed.
///
/// # Errors
/// `Invalid` when the source yields no valid name.
pub(in crate::engine) fn default_scene_name(source: &str) -> Result<String> {
    let file_name = source.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    let stem = file_name.rsplit_once('.').map_or(file_name, |(stem, _)| if stem.is_empty() { file_name } else { stem });
    let replace_invalid =
        |letter: char| if letter.is_ascii_alphanumeric() || "._-".contains(letter) { letter } else { '-' };
    let stem = if source.trim_end_matches('/') == "." { "scene" } else { stem };
    let name: String = stem.trim_start_matches('.').chars().map(replace_invalid).take(64).collect();
    validate_scene_name(&name).map_err(|_| invalid("source", "a built-in name or a path in the repository", source))?;
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_are_unsafe_as_file_names_are_rejected() {
        for name in ["", ".", "..", ".hidden", "a/b", "a\\b", "a\0", "ü", &"x".repeat(65)] {
            assert!(validate_scene_name(name).is_err(), "expected an error for {name:?}");
        }
        assert_eq!(validate_scene_name("tree_2.v-1"), Ok("tree_2.v-1"));
    }

    #[test]
    fn default_name_is_the_last_path_component() {
        for (source, name) in [
            ("tree", "tree"),
            ("vega/simpleBridge/", "simpleBridge"),
            ("a b/c d.glb", "c-d"),
            ("x.y.obj", "x.y"),
            (".", "scene"),
            ("./tree", "tree"),
        ] {
            assert_eq!(default_scene_name(source).as_deref(), Ok(name));
        }
        for source in ["", "/", "..", "a/.."] {
            assert!(default_scene_name(source).is_err(), "expected an error for {source:?}");
        }
    }

    #[test]
    fn damaged_catalog_is_renamed_and_an_unreadable_one_is_an_error() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let catalog_path = folder.path().join("scenes.json");
        let read_backup = |name: &str| fs::read(folder.path().join(name)).expect("expected a backup");
        fs::write(&catalog_path, b"{\"a\":").expect("expected a written file");
        let scene_catalog = SceneCatalog::open(folder.path()).expect("expected an empty catalog");
        assert!(scene_catalog.entries().is_empty() && !catalog_path.exists());
        assert_eq!(read_backup("scenes.json.damaged"), b"{\"a\":");
        drop(scene_catalog);
        fs::write(&catalog_path, b"[").expect("expected a written file");
        drop(SceneCatalog::open(folder.path()).expect("expected an empty catalog"));
        assert_eq!(read_backup("scenes.json.damaged"), b"{\"a\":", "expected the first backup to remain");
        assert_eq!(read_backup("scenes.json.damaged.1"), b"[");
        // A folder in place of the file is unreadable for every user, root included.
        fs::create_dir(&catalog_path).expect("expected a new folder");
        assert!(matches!(SceneCatalog::open(folder.path()), Err(Error::Unavailable { .. })));
    }

    #[test]
    fn failed_write_leaves_the_catalog_unchanged() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene_catalog = SceneCatalog::open(folder.path()).expect("expected an unlocked folder");
        let provenance = SceneProvenance::Repository { source: "strips".into() };
        scene_catalog.add("a", &provenance).expect("expected a written catalog");
        // A folder with the name of the temporary file makes every write fail.
        let obstacle = folder.path().join("scenes.new");
        fs::create_dir(&obstacle).expect("expected a new folder");
        assert!(matches!(scene_catalog.add("b", &provenance), Err(Error::Fault { .. })));
        assert!(matches!(scene_catalog.remove("a"), Err(Error::Fault { .. })));
        assert_eq!(scene_catalog.entries().into_keys().collect::<Vec<_>>(), ["a"]);
        fs::remove_dir(&obstacle).expect("expected to remove the folder");
        assert_eq!(scene_catalog.remove("a"), Ok(true));
    }

    #[test]
    fn catalog_persists_and_locks_its_folder() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let first_catalog = SceneCatalog::open(folder.path()).expect("expected an unlocked folder");
        let provenance = SceneProvenance::Upload { entry: String::new() };
        first_catalog.add("a", &provenance).expect("expected a written catalog");
        first_catalog.add("b", &provenance).expect("expected a written catalog");
        assert_eq!(first_catalog.remove("b"), Ok(true));
        assert!(matches!(SceneCatalog::open(folder.path()), Err(Error::Unavailable { .. })));
        first_catalog.release();
        let second_catalog = SceneCatalog::open(folder.path()).expect("expected an unlocked folder");
        assert_eq!(second_catalog.entries().into_iter().collect::<Vec<_>>(), [("a".to_owned(), provenance)]);
    }
}
