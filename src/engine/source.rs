//! The trait of scene sources, which resolve a name or path to a validated scene.

use std::path::Path;
use std::sync::Arc;

use modalcast_model::error::Result;
use modalcast_model::load::{OpenedScene, SceneRepository};
use modalcast_model::memory::MemoryReservation;

/// Opens scenes for the engine. The engine calls the methods on threads that may block on the disk.
pub trait SceneSource: Send + Sync + 'static {
    /// Opens a built-in scene or a path in the server's repository. Reserves in `memory` what it reads and decodes.
    ///
    /// # Errors
    /// `NotFound` when there is no such scene, `Invalid` naming the problem in the path or the files, `OutOfMemory`.
    fn open(&self, source: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene>;

    /// Opens `entry` of an uploaded folder, or the folder itself if `entry` is empty. Reads nothing outside the folder.
    ///
    /// # Errors
    /// As [`Self::open`].
    fn open_within(&self, folder: &Path, entry: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene>;

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

    fn open_within(&self, folder: &Path, entry: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        // With the leading "./" a file name is never resolved as a built-in name.
        Self::new(Some(folder))?.open(&format!("./{entry}"), memory)
    }

    fn is_built_in(&self, source: &str) -> bool {
        Self::is_built_in(source)
    }

    fn list(&self) -> Vec<String> {
        Self::list(self)
    }
}
