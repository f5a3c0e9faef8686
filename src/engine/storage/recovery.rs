//! Brings the state folder into a consistent state when a server starts, also after a crash or a power loss: rebuilds a
//! damaged or missing catalog, adopts or removes uploads without an entry, and removes entries without files.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use sha2::{Digest as _, Sha256};

use super::file_system::{FileSystem, write_atomic};
use super::provenance::{SceneProvenance, validate_scene_name};
use super::scene_record::{SceneAccess, SceneRecord};
use super::upload_record::UploadRecord;
use crate::engine::content::hex;
use crate::identity::Principal;

/// The scenes of a state folder by name.
type Entries = BTreeMap<String, SceneRecord>;

/// The record of a scene in a file of its own, so that a damaged catalog can be rebuilt.
#[derive(Debug, serde::Serialize, serde::Deserialize)]
struct HashedRecord {
    #[serde(rename = "provenance")]
    record: SceneRecord,
    /// Hash of the record as JSON.
    sha256: String,
}

/// The paths of a state folder.
#[derive(Debug, Clone)]
pub(super) struct StatePaths {
    pub(super) folder: PathBuf,
}

impl StatePaths {
    pub(super) fn catalog(&self) -> PathBuf {
        self.folder.join("scenes.json")
    }

    pub(super) fn uploads(&self) -> PathBuf {
        self.folder.join("uploads")
    }

    pub(super) fn steps(&self) -> PathBuf {
        self.folder.join("steps")
    }

    /// The folder of the records of single scenes.
    pub(super) fn sources(&self) -> PathBuf {
        self.folder.join("sources")
    }

    pub(super) fn source(&self, name: &str) -> PathBuf {
        self.sources().join(format!("{name}.json"))
    }
}

/// Writes the record of a scene.
pub(super) fn write_record(file_system: &dyn FileSystem, path: &Path, record: &SceneRecord) -> io::Result<()> {
    let record = HashedRecord { record: record.clone(), sha256: hash_record(record)? };
    write_atomic(file_system, path, &serde_json::to_vec_pretty(&record)?)
}

fn hash_record(record: &SceneRecord) -> io::Result<String> {
    Ok(hex(&Sha256::digest(serde_json::to_vec(record)?)))
}

/// The recovery of one state folder.
pub(super) struct Recovery<'a> {
    pub(super) paths: &'a StatePaths,
    pub(super) file_system: &'a dyn FileSystem,
}

impl Recovery<'_> {
    /// Recovers the folder. Returns the scenes to open.
    pub(super) fn run(&self) -> io::Result<Entries> {
        let listed = self.read_catalog()?;
        let mut entries = listed.clone().unwrap_or_else(|| self.read_records());
        self.recover_uploads(&mut entries);
        self.remove_entries_without_files(&mut entries);
        self.remove_leftovers(&entries);
        let is_unchanged = listed.as_ref().map_or(entries.is_empty(), |listed| *listed == entries);
        if !is_unchanged {
            write_atomic(self.file_system, &self.paths.catalog(), &serde_json::to_vec_pretty(&entries)?)?;
        }
        Ok(entries)
    }

    /// The catalog; `None` if it is missing or damaged. A damaged one is renamed to [`unused_backup_path`].
    fn read_catalog(&self) -> io::Result<Option<Entries>> {
        let path = self.paths.catalog();
        let bytes = match fs::read(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            result => result?,
        };
        match serde_json::from_slice(&bytes) {
            Ok(entries) => Ok(Some(entries)),
            Err(error) => {
                let backup = unused_backup_path(&path);
                tracing::warn!(%error, "scenes.json is damaged: renamed to {} and rebuilt", backup.display());
                self.file_system.rename(&path, &backup)?;
                Ok(None)
            }
        }
    }

    /// The scenes that have a record.
    fn read_records(&self) -> Entries {
        let mut entries = Entries::new();
        for name in names_in(&self.paths.sources()) {
            let Some(scene) = name.to_str().and_then(|name| name.strip_suffix(".json")) else { continue };
            let bytes = fs::read(self.paths.source(scene)).unwrap_or_default();
            let hashed = serde_json::from_slice::<HashedRecord>(&bytes).ok();
            let record = hashed
                .filter(|hashed| hash_record(&hashed.record).is_ok_and(|hash| hash == hashed.sha256))
                .map(|hashed| hashed.record);
            match (validate_scene_name(scene), record) {
                (Ok(scene), Some(record)) => drop(entries.insert(scene.to_owned(), record)),
                _ => tracing::warn!(scene, "the record of the scene is damaged; the scene is not opened"),
            }
        }
        entries
    }

    /// Removes unfinished uploads. Adopts a finished upload without an entry if its files match its record, else removes
    /// it: a server that is killed between the two writes leaves one behind.
    fn recover_uploads(&self, entries: &mut Entries) {
        for name in names_in(&self.paths.uploads()) {
            let folder = self.paths.uploads().join(&name);
            let scene = name.to_str().and_then(|name| validate_scene_name(name).ok());
            if scene.is_some_and(|scene| entries.get(scene).is_some_and(SceneRecord::is_upload)) {
                continue;
            }
            let record = UploadRecord::read(&folder).filter(|record| record.matches(&folder));
            match (scene, record) {
                (Some(scene), Some(record)) if !entries.contains_key(scene) => {
                    tracing::warn!(scene, "an upload without an entry in scenes.json is adopted");
                    // Nothing tells who has uploaded the files, so that only the user of the server gets them.
                    let access = SceneAccess::new(&Principal::owner());
                    let provenance = SceneProvenance::Upload { entry: record.entry };
                    entries.insert(scene.to_owned(), SceneRecord { provenance, access });
                }
                _ => {
                    if let Some(scene) = scene {
                        tracing::warn!(scene, "an incomplete upload without an entry in scenes.json is removed");
                    }
                    self.file_system.remove_folder(&folder).ok(); // The next start tries again.
                }
            }
        }
    }

    /// Removes the entries of uploads without a folder.
    fn remove_entries_without_files(&self, entries: &mut Entries) {
        entries.retain(|scene, record| {
            let is_lost = record.is_upload() && !self.paths.uploads().join(scene).is_dir();
            if is_lost {
                tracing::warn!(scene, "the files of an uploaded scene do not exist; its entry is removed");
            }
            !is_lost
        });
    }

    /// Removes steps and records of scenes that are not open, and temporary files.
    fn remove_leftovers(&self, entries: &Entries) {
        for (folder, ending) in [(self.paths.steps(), ".step"), (self.paths.sources(), ".json")] {
            for name in names_in(&folder) {
                let scene = name.to_str().and_then(|name| name.strip_suffix(ending));
                if scene.is_none_or(|scene| !entries.contains_key(scene)) {
                    self.file_system.remove_file(&folder.join(name)).ok(); // The next start tries again.
                }
            }
        }
    }
}

/// The names in a folder; none if it does not exist.
fn names_in(folder: &Path) -> Vec<OsString> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name()).collect()
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
