//! The state folder: a lock that limits the folder to one server, and the catalog `scenes.json` of open scenes.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};

use super::atomic_file::write_atomic;
use crate::engine::lock::lock;
use modalcast_model::error::{Error, Result, fault_in, invalid};

/// The origin of a scene.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum SceneProvenance {
    /// A built-in name, or a path inside the repository.
    Repository { source: String },
    /// Files that a client uploaded. `entry` is the path to open; empty means the folder.
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

/// The catalog of open scenes: names and origins, written to disk at every change.
#[derive(Debug)]
pub(in crate::engine) struct SceneCatalog {
    folder: PathBuf,
    entries: Mutex<BTreeMap<String, SceneProvenance>>,
    /// File lock of the server that uses the folder. The operating system releases it when the process dies.
    lock: Mutex<Option<File>>,
}

impl SceneCatalog {
    /// Locks the folder, reads its catalog and removes unfinished uploads.
    ///
    /// # Errors
    /// `Unavailable` when another server uses the folder, or when the folder cannot be created or read.
    pub(in crate::engine) fn open(folder: &Path) -> Result<Self> {
        let unusable = |reason: String| Error::Unavailable {
            what: "state folder",
            reason,
            remedy: "Name another one with --state".into(),
        };
        let refuse = |error: std::io::Error| unusable(format!("{}: {error}", folder.display()));
        fs::create_dir_all(folder.join("uploads")).map_err(refuse)?;
        let lock = File::create(folder.join("lock")).map_err(refuse)?;
        lock.try_lock().map_err(|_| unusable(format!("{} is in use by another server", folder.display())))?;
        let entries = read(&folder.join("scenes.json")).map_err(refuse)?;
        remove_leftovers(&folder.join("uploads"));
        Ok(Self { folder: folder.to_owned(), entries: Mutex::new(entries), lock: Mutex::new(Some(lock)) })
    }

    pub(in crate::engine) fn entries(&self) -> BTreeMap<String, SceneProvenance> {
        self.guard().clone()
    }

    /// Adds a scene. Writes to disk; a failure leaves the catalog unchanged.
    pub(in crate::engine) fn add(&self, name: &str, provenance: &SceneProvenance) -> Result<()> {
        self.change(|entries| entries.insert(name.to_owned(), provenance.clone())).map(drop)
    }

    /// Removes a scene; returns whether it was listed. Writes to disk; a failure leaves the catalog unchanged.
    pub(in crate::engine) fn remove(&self, name: &str) -> Result<bool> {
        self.change(|entries| entries.remove(name)).map(|entry| entry.is_some())
    }

    /// The folder of the checkpoints.
    pub(in crate::engine) fn checkpoint_folder(&self) -> PathBuf {
        self.folder.join("steps")
    }

    /// The folder of an upload's files.
    pub(in crate::engine) fn upload_folder(&self, name: &str) -> PathBuf {
        self.folder.join("uploads").join(name)
    }

    /// Releases the lock, so that another server may use the folder.
    pub(in crate::engine) fn release(&self) {
        lock(&self.lock).take();
    }

    /// Changes the catalog on disk first and in memory only if that succeeds, so that both agree.
    fn change<T>(&self, change: impl FnOnce(&mut BTreeMap<String, SceneProvenance>) -> T) -> Result<T> {
        let mut entries = self.guard();
        let mut changed = entries.clone();
        let result = change(&mut changed);
        let text = serde_json::to_vec_pretty(&changed).map_err(fault_in("writing scenes.json"))?;
        write_atomic(&self.folder.join("scenes.json"), &text).map_err(fault_in("writing scenes.json"))?;
        *entries = changed;
        Ok(result)
    }

    fn guard(&self) -> MutexGuard<'_, BTreeMap<String, SceneProvenance>> {
        lock(&self.entries)
    }
}

/// Reads the catalog; empty if there is none. A damaged file is renamed to `scenes.json.damaged`, or to
/// `scenes.json.damaged.1` and so on if that exists, so that it is kept and the server can start.
fn read(path: &Path) -> io::Result<BTreeMap<String, SceneProvenance>> {
    let bytes = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
        read => read?,
    };
    serde_json::from_slice(&bytes).or_else(|error| {
        let backup = unused_backup_path(path);
        tracing::warn!(%error, "the list of open scenes is damaged; it is kept as {} and begins empty", backup.display());
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
    let fits = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    if name.is_empty() || name.len() > 64 || name.starts_with('.') || !name.chars().all(fits) {
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
    let last = source.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    let stem = last.rsplit_once('.').map_or(last, |(stem, _)| if stem.is_empty() { last } else { stem });
    let fit = |letter: char| if letter.is_ascii_alphanumeric() || "._-".contains(letter) { letter } else { '-' };
    let stem = if source.trim_end_matches('/') == "." { "scene" } else { stem };
    let name: String = stem.trim_start_matches('.').chars().map(fit).take(64).collect();
    validate_scene_name(&name).map_err(|_| invalid("source", "a built-in name or a path in the repository", source))?;
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_could_leave_a_folder_are_refused() {
        for name in ["", ".", "..", ".hidden", "a/b", "a\\b", "a\0", "ü", &"x".repeat(65)] {
            assert!(validate_scene_name(name).is_err(), "{name:?} passed");
        }
        assert_eq!(validate_scene_name("tree_2.v-1"), Ok("tree_2.v-1"));
    }

    #[test]
    fn a_source_gives_its_last_part_as_name() {
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
            assert!(default_scene_name(source).is_err(), "{source:?} passed");
        }
    }

    #[test]
    fn a_damaged_list_is_set_aside_and_an_unreadable_one_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let list = folder.path().join("scenes.json");
        fs::write(&list, b"{\"a\":").expect("written");
        let scene_catalog = SceneCatalog::open(folder.path()).expect("it starts");
        assert!(scene_catalog.entries().is_empty() && !list.exists());
        assert_eq!(fs::read(folder.path().join("scenes.json.damaged")).expect("set aside"), b"{\"a\":");
        drop(scene_catalog);
        fs::write(&list, b"[").expect("written");
        drop(SceneCatalog::open(folder.path()).expect("it starts"));
        let backup = |name: &str| fs::read(folder.path().join(name)).expect("set aside");
        assert_eq!(backup("scenes.json.damaged"), b"{\"a\":", "the first one is not overwritten");
        assert_eq!(backup("scenes.json.damaged.1"), b"[");
        // A folder in place of the file is unreadable for every user, root included.
        fs::create_dir(&list).expect("a folder");
        assert!(matches!(SceneCatalog::open(folder.path()), Err(Error::Unavailable { .. })));
    }

    #[test]
    fn a_list_that_cannot_be_written_stays_as_it_is() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene_catalog = SceneCatalog::open(folder.path()).expect("free");
        let provenance = SceneProvenance::Repository { source: "strips".into() };
        scene_catalog.add("a", &provenance).expect("written");
        fs::create_dir(folder.path().join("scenes.new")).expect("in the way of every writing");
        assert!(matches!(scene_catalog.add("b", &provenance), Err(Error::Fault { .. })));
        assert!(matches!(scene_catalog.remove("a"), Err(Error::Fault { .. })));
        assert_eq!(scene_catalog.entries().into_keys().collect::<Vec<_>>(), ["a"]);
        fs::remove_dir(folder.path().join("scenes.new")).expect("out of the way");
        assert_eq!(scene_catalog.remove("a"), Ok(true));
    }

    #[test]
    fn the_list_survives_and_a_second_server_is_refused_while_the_first_lives() {
        let folder = tempfile::tempdir().expect("a folder");
        let first = SceneCatalog::open(folder.path()).expect("free");
        let provenance = SceneProvenance::Upload { entry: String::new() };
        first.add("a", &provenance).expect("written");
        first.add("b", &provenance).expect("written");
        assert_eq!(first.remove("b"), Ok(true));
        assert!(matches!(SceneCatalog::open(folder.path()), Err(Error::Unavailable { .. })));
        first.release();
        let second = SceneCatalog::open(folder.path()).expect("free again");
        assert_eq!(second.entries().into_iter().collect::<Vec<_>>(), [("a".to_owned(), provenance)]);
    }
}
