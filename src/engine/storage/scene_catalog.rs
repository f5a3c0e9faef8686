//! The catalog of open scenes in `scenes.json`, and the lock that limits a state folder to one server.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

use super::file_system::{FileSystem, make_private, write_atomic};
use super::recovery::{Recovery, StatePaths, write_record};
use super::scene_record::{SceneAccess, SceneRecord};
use crate::engine::lock::lock;
use modalcast_model::error::{Error, Result, fault_in};

/// The names and records of the open scenes, written to disk at every change. A second file for each scene has its record,
/// too, so that a damaged catalog can be rebuilt.
#[derive(Debug)]
pub(in crate::engine) struct SceneCatalog {
    file_system: Arc<dyn FileSystem>,
    paths: StatePaths,
    entries: Mutex<BTreeMap<String, SceneRecord>>,
    /// File lock of the server that uses the folder. The operating system releases it when the process dies.
    folder_lock: Mutex<Option<File>>,
}

/// The files of an uploaded scene.
#[derive(Debug)]
pub(in crate::engine) struct UploadSize {
    pub(in crate::engine) scene: String,
    /// The principal to whom they belong.
    pub(in crate::engine) owner: String,
    pub(in crate::engine) bytes: u64,
}

impl SceneCatalog {
    /// Locks the folder and brings it into a consistent state, see [`Recovery`].
    ///
    /// # Errors
    /// `Unavailable` when another server uses the folder, or when the folder cannot be created, read or written.
    pub(in crate::engine) fn open(folder: &Path, file_system: &Arc<dyn FileSystem>) -> Result<Self> {
        let unavailable = |reason: String| Error::Unavailable {
            what: "state folder",
            reason,
            remedy: "Name another folder with --state".into(),
        };
        let unusable_folder = |error: std::io::Error| unavailable(format!("{}: {error}", folder.display()));
        let paths = StatePaths { folder: folder.to_owned() };
        for path in [paths.uploads(), paths.steps(), paths.sources()] {
            file_system.create_folder(&path).map_err(unusable_folder)?;
        }
        let folder_lock = File::create(folder.join("lock")).map_err(unusable_folder)?;
        folder_lock.try_lock().map_err(|_| unavailable(format!("{} is in use by another server", folder.display())))?;
        make_private(folder).map_err(unusable_folder)?;
        file_system.sync_folder(folder).map_err(unusable_folder)?;
        let entries = Recovery { paths: &paths, file_system: &**file_system }.run().map_err(unusable_folder)?;
        let (entries, folder_lock) = (Mutex::new(entries), Mutex::new(Some(folder_lock)));
        Ok(Self { file_system: Arc::clone(file_system), paths, entries, folder_lock })
    }

    pub(in crate::engine) fn entries(&self) -> BTreeMap<String, SceneRecord> {
        self.lock_entries().clone()
    }

    pub(in crate::engine) fn find(&self, name: &str) -> Option<SceneRecord> {
        self.lock_entries().get(name).cloned()
    }

    /// Adds a scene and writes the catalog. A failure leaves the catalog unchanged.
    pub(in crate::engine) fn add(&self, name: &str, record: &SceneRecord) -> Result<()> {
        let path = self.paths.source(name);
        if self.lock_entries().get(name) == Some(record) && path.exists() {
            return Ok(());
        }
        write_record(&*self.file_system, &path, record).map_err(fault_in("writing the record of a scene"))?;
        self.change_entries(|entries| entries.insert(name.to_owned(), record.clone())).map(drop)
    }

    /// Changes who may use a scene of the catalog, and writes the catalog. Does nothing for other scenes.
    pub(in crate::engine) fn set_access(&self, name: &str, access: SceneAccess) -> Result<()> {
        let Some(record) = self.find(name) else { return Ok(()) };
        self.add(name, &SceneRecord { access, ..record })
    }

    /// Removes the uploaded files of a scene, and then the scene from the catalog. Returns whether the scene was listed. A
    /// failure leaves the catalog unchanged.
    pub(in crate::engine) fn remove(&self, name: &str) -> Result<bool> {
        self.remove_upload(name);
        let entry = self.change_entries(|entries| entries.remove(name))?;
        // The next start removes a record that remains.
        self.file_system.remove_file(&self.paths.source(name)).ok();
        Ok(entry.is_some())
    }

    /// Removes the folder of an upload, if there is one.
    pub(in crate::engine) fn remove_upload(&self, name: &str) {
        let (folder, removed) = (self.upload_folder(name), self.uploads().join(format!(".{name}-removed")));
        // The rename is atomic, so that a crash leaves either all files or none.
        if folder.exists() && self.file_system.rename(&folder, &removed).is_ok() {
            self.file_system.sync_folder(&self.uploads()).ok();
            self.file_system.remove_folder(&removed).ok(); // The next start removes leftovers.
        }
    }

    /// All uploads. Blocks on the disk.
    pub(in crate::engine) fn stored_uploads(&self) -> Vec<UploadSize> {
        let uploads = self.entries().into_iter().filter(|(_, record)| record.is_upload());
        let to_size = |(scene, record): (String, SceneRecord)| {
            let bytes = folder_bytes(&self.upload_folder(&scene));
            UploadSize { scene, owner: record.access.owner, bytes }
        };
        uploads.map(to_size).collect()
    }

    /// The folders of the uploads that belong to a principal.
    pub(in crate::engine) fn upload_folders_of(&self, owner: &str) -> Vec<PathBuf> {
        let entries = self.lock_entries();
        let own = entries.iter().filter(|(_, record)| record.is_upload() && record.access.owner == owner);
        own.map(|(name, _)| self.upload_folder(name)).collect()
    }

    pub(in crate::engine) const fn file_system(&self) -> &Arc<dyn FileSystem> {
        &self.file_system
    }

    /// The folder of the checkpoints.
    pub(in crate::engine) fn checkpoint_folder(&self) -> PathBuf {
        self.paths.steps()
    }

    /// The folder of all uploads.
    pub(in crate::engine) fn uploads(&self) -> PathBuf {
        self.paths.uploads()
    }

    /// The folder of an upload's files.
    pub(in crate::engine) fn upload_folder(&self, name: &str) -> PathBuf {
        self.uploads().join(name)
    }

    /// Releases the lock, so that another server may use the folder.
    pub(in crate::engine) fn release(&self) {
        if let Some(file) = lock(&self.folder_lock).take() {
            // Closing the file is not enough: a process that is being started holds a copy of it for a moment.
            file.unlock().ok();
        }
    }

    /// Changes the catalog on disk, and in memory only if that succeeds, so that both agree.
    fn change_entries<T>(&self, change: impl FnOnce(&mut BTreeMap<String, SceneRecord>) -> T) -> Result<T> {
        let mut entries = self.lock_entries();
        let mut changed_entries = entries.clone();
        let result = change(&mut changed_entries);
        let text = serde_json::to_vec_pretty(&changed_entries).map_err(fault_in("writing scenes.json"))?;
        write_atomic(&*self.file_system, &self.paths.catalog(), &text).map_err(fault_in("writing scenes.json"))?;
        *entries = changed_entries;
        Ok(result)
    }

    fn lock_entries(&self) -> MutexGuard<'_, BTreeMap<String, SceneRecord>> {
        lock(&self.entries)
    }
}

/// Sum of the sizes of all files below a folder, in bytes.
pub(in crate::engine) fn folder_bytes(folder: &Path) -> u64 {
    let size = |entry: fs::DirEntry| match entry.file_type() {
        Ok(kind) if kind.is_dir() => folder_bytes(&entry.path()),
        _ => entry.metadata().map_or(0, |metadata| metadata.len()),
    };
    fs::read_dir(folder).into_iter().flatten().flatten().map(size).sum()
}

impl Drop for SceneCatalog {
    fn drop(&mut self) {
        self.release();
    }
}

#[cfg(test)]
mod tests {
    use super::super::file_system::DiskFileSystem;
    use super::super::provenance::SceneProvenance;
    use super::*;
    use crate::identity::Principal;

    fn record(provenance: SceneProvenance) -> SceneRecord {
        SceneRecord { provenance, access: SceneAccess::new(&Principal::owner()) }
    }

    fn strips() -> SceneRecord {
        record(SceneProvenance::Repository { source: "strips".into() })
    }

    fn open(folder: &Path) -> Result<SceneCatalog> {
        let disk: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
        SceneCatalog::open(folder, &disk)
    }

    #[test]
    fn damaged_catalog_is_renamed_and_an_unreadable_one_is_an_error() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let catalog_path = folder.path().join("scenes.json");
        let read_backup = |name: &str| fs::read(folder.path().join(name)).expect("expected a backup");
        fs::write(&catalog_path, b"{\"a\":").expect("expected a written file");
        let scene_catalog = open(folder.path()).expect("expected an empty catalog");
        assert!(scene_catalog.entries().is_empty() && !catalog_path.exists());
        assert_eq!(read_backup("scenes.json.damaged"), b"{\"a\":");
        drop(scene_catalog);
        fs::write(&catalog_path, b"[").expect("expected a written file");
        drop(open(folder.path()).expect("expected an empty catalog"));
        assert_eq!(read_backup("scenes.json.damaged"), b"{\"a\":", "expected the first backup to remain");
        assert_eq!(read_backup("scenes.json.damaged.1"), b"[");
        // A folder in place of the file is unreadable for every user, root included.
        fs::create_dir(&catalog_path).expect("expected a new folder");
        assert!(matches!(open(folder.path()), Err(Error::Unavailable { .. })));
    }

    #[test]
    fn lock_is_released_although_a_process_has_a_copy_of_the_file() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
        let file = lock(&scene_catalog.folder_lock).as_ref().map(File::try_clone);
        let _copy = file.expect("expected a lock").expect("expected a copy");
        assert!(matches!(open(folder.path()), Err(Error::Unavailable { .. })), "control: expected a locked folder");
        drop(scene_catalog);
        open(folder.path()).expect("expected an unlocked folder");
    }

    #[test]
    fn failed_write_leaves_the_catalog_unchanged() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
        scene_catalog.add("a", &strips()).expect("expected a written catalog");
        // A folder with the name of the temporary file makes every write fail.
        let obstacle = folder.path().join("scenes.new");
        fs::create_dir(&obstacle).expect("expected a new folder");
        assert!(matches!(scene_catalog.add("b", &strips()), Err(Error::Fault { .. })));
        assert!(matches!(scene_catalog.remove("a"), Err(Error::Fault { .. })));
        assert_eq!(scene_catalog.entries().into_keys().collect::<Vec<_>>(), ["a"]);
        fs::remove_dir(&obstacle).expect("expected to remove the folder");
        assert_eq!(scene_catalog.remove("a"), Ok(true));
    }

    #[test]
    fn uploads_and_entries_without_each_other_are_removed() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
        let upload = record(SceneProvenance::Upload { entry: String::new() });
        let tree = record(SceneProvenance::Repository { source: "tree".into() });
        for name in ["complete", "lost"] {
            fs::create_dir(scene_catalog.upload_folder(name)).expect("expected a new folder");
            scene_catalog.add(name, &upload).expect("expected a written catalog");
        }
        scene_catalog.add("tree", &tree).expect("expected a written catalog");
        fs::remove_dir(scene_catalog.upload_folder("lost")).expect("expected a removed folder");
        for leftover in ["uploads/.unfinished-0", "uploads/unlisted", "uploads/tree"] {
            fs::create_dir(folder.path().join(leftover)).expect("expected a new folder");
        }
        for leftover in ["steps/lost.step", "steps/tree.new", "sources/unlisted.json"] {
            fs::write(folder.path().join(leftover), "x").expect("expected a written file");
        }
        drop(scene_catalog);
        let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
        assert_eq!(scene_catalog.entries(), [("complete".to_owned(), upload), ("tree".to_owned(), tree)].into());
        let names = |path: &str| {
            let entries = fs::read_dir(folder.path().join(path)).expect("expected a folder").flatten();
            let mut names: Vec<_> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
            names.sort();
            names
        };
        assert_eq!(names("uploads"), ["complete"]);
        assert_eq!(names("sources"), ["complete.json", "tree.json"]);
        assert!(names("steps").is_empty());
    }

    #[test]
    fn access_survives_a_restart_and_a_damaged_catalog() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
        scene_catalog.add("a", &strips()).expect("expected a written catalog");
        let access = SceneAccess { owner: "anna".into(), shared_with: ["ben".to_owned()].into() };
        scene_catalog.set_access("a", access.clone()).expect("expected a written catalog");
        drop(scene_catalog);
        for is_damaged in [false, true] {
            if is_damaged {
                fs::write(folder.path().join("scenes.json"), "{").expect("expected a written file");
            }
            let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
            assert_eq!(scene_catalog.find("a").map(|record| record.access), Some(access.clone()), "{is_damaged}");
        }
    }

    #[test]
    fn only_uploads_of_a_principal_are_found() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene_catalog = open(folder.path()).expect("expected an unlocked folder");
        let upload = |owner: &str| SceneRecord {
            provenance: SceneProvenance::Upload { entry: String::new() },
            access: SceneAccess { owner: owner.into(), shared_with: ["*".to_owned()].into() },
        };
        for (name, record) in [("a", upload("anna")), ("b", upload("ben")), ("c", strips())] {
            scene_catalog.add(name, &record).expect("expected a written catalog");
        }
        assert_eq!(scene_catalog.upload_folders_of("anna"), [scene_catalog.upload_folder("a")]);
        assert!(scene_catalog.upload_folders_of("owner").is_empty());
    }

    #[test]
    fn catalog_persists_and_locks_its_folder() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let first_catalog = open(folder.path()).expect("expected an unlocked folder");
        first_catalog.add("a", &strips()).expect("expected a written catalog");
        first_catalog.add("b", &strips()).expect("expected a written catalog");
        assert_eq!(first_catalog.remove("b"), Ok(true));
        assert!(matches!(open(folder.path()), Err(Error::Unavailable { .. })));
        first_catalog.release();
        let second_catalog = open(folder.path()).expect("expected an unlocked folder");
        assert_eq!(second_catalog.entries().into_iter().collect::<Vec<_>>(), [("a".to_owned(), strips())]);
    }
}
