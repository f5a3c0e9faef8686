//! Files to scenes.

mod files;
mod gltf;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::error::{Error, Result};
use crate::scene::Scene;

/// Opens `SCENE` of the command line: a built-in name, a folder with `scene.toml`, a `.glb`, `.gltf` or `.obj` file, or
/// a folder with one recognisable model. Paths are taken as they are.
///
/// # Errors
/// `NotFound` when nothing of that name is there; `Invalid` naming file, field, expected and given otherwise.
pub fn open(source: &str) -> Result<Arc<Scene>> {
    Err(Error::NotFound { what: "scene", given: source.into() })
}

/// The server's folder of scenes; every path stays inside it.
#[derive(Debug, Clone)]
pub struct Repository {
    root: Option<PathBuf>,
}

impl Repository {
    /// A repository of the built-in scenes and of what lies in `root`.
    ///
    /// # Errors
    /// `Unavailable` when the folder is not there.
    pub fn new(root: Option<&Path>) -> Result<Self> {
        Ok(Self { root: root.map(Path::to_path_buf) })
    }

    /// Opens a built-in name or a path inside the repository.
    ///
    /// # Errors
    /// As [`open`], and `Invalid` for a path that leaves the repository.
    pub fn open(&self, source: &str) -> Result<Arc<Scene>> {
        Err(Error::NotFound { what: "scene", given: format!("{source} in {:?}", self.root) })
    }

    /// All names that [`Self::open`] accepts, sorted.
    pub fn list(&self) -> Vec<String> {
        vec!["tree".into()]
    }
}
