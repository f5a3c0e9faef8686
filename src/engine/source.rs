//! The trait of scene sources, which resolve a name or path to a validated scene.

use std::path::PathBuf;
use std::sync::Arc;

use modalcast_model::error::Result;
use modalcast_model::load::{FileHashes, OpenedScene, SceneRepository};
use modalcast_model::memory::MemoryReservation;

/// The files of an uploaded scene.
#[derive(Debug, Clone)]
pub struct StoredUpload {
    pub folder: PathBuf,
    /// The path in the folder to open. An empty path means the folder.
    pub entry: String,
    /// The hashes that the files must have.
    pub hashes: Arc<FileHashes>,
}

/// Opens scenes for the engine. The engine calls the methods on threads that may block on the disk.
pub trait SceneSource: Send + Sync + 'static {
    /// Opens a built-in scene or a path in the server's repository. Reserves in `memory` what it reads and decodes.
    ///
    /// # Errors
    /// `NotFound` when there is no such scene, `Invalid` naming the problem in the path or the files, `OutOfMemory`.
    fn open(&self, source: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene>;

    /// Opens an uploaded scene. Reads nothing outside its folder.
    ///
    /// # Errors
    /// As [`Self::open`], and `Invalid` with the name of a file that has changed since it was uploaded.
    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene>;

    /// Whether [`Self::open`] reads no files for the source. Such a source does not wait for others that do.
    fn is_built_in(&self, _source: &str) -> bool {
        false
    }

    /// The sources that [`Self::open`] accepts.
    fn list(&self) -> Vec<String>;
}

impl SceneSource for SceneRepository {
    fn open(&self, source: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        Self::open(self, source, memory)
    }

    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        self.open_upload(&upload.folder, &upload.entry, &upload.hashes, memory)
    }

    fn is_built_in(&self, source: &str) -> bool {
        Self::is_built_in(source)
    }

    fn list(&self) -> Vec<String> {
        Self::list(self)
    }
}
