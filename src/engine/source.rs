//! Where scenes come from: a name or a path becomes a checked scene.

use std::path::Path;
use std::sync::Arc;

use modalcast_model::error::Result;
use modalcast_model::load::Repository;
use modalcast_model::scene::Scene;

/// Opens scenes for the engine. Called on threads that may wait for the disk.
pub trait SceneSource: Send + Sync + 'static {
    /// Opens a built-in name or a path of the server's repository.
    ///
    /// # Errors
    /// `NotFound`, or `Invalid` with what is wrong with the files or the path.
    fn open(&self, source: &str) -> Result<Arc<Scene>>;

    /// Opens `entry` of an uploaded folder, or the folder itself when it is empty, without leaving the folder.
    ///
    /// # Errors
    /// As [`Self::open`].
    fn open_within(&self, folder: &Path, entry: &str) -> Result<Arc<Scene>>;

    /// What [`Self::open`] accepts.
    fn list(&self) -> Vec<String>;
}

impl SceneSource for Repository {
    fn open(&self, source: &str) -> Result<Arc<Scene>> {
        Self::open(self, source)
    }

    fn open_within(&self, folder: &Path, entry: &str) -> Result<Arc<Scene>> {
        // The dot in front keeps an upload's file from being taken for a built-in name.
        Self::new(Some(folder))?.open(&format!("./{entry}"))
    }

    fn list(&self) -> Vec<String> {
        Self::list(self)
    }
}
