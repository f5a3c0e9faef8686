//! Input of the demo: the scene, the repository from which the server opens it, and the physics files next to it.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::super::options::with_spinner;
use modalcast_model::error::Result;
use modalcast_model::load;
use modalcast_model::scene::Scene;

/// The scene that the demo runs, and the options with which the processes find its files.
pub(super) struct DemoScene {
    pub(super) scene: Arc<Scene>,
    /// Name or path of the scene in the server's repository.
    pub(super) source: String,
    /// The server's repository. `None` for a built-in scene.
    pub(super) repository: Option<PathBuf>,
    /// Vega's cubic polynomial of the internal forces (`.cub`), if the model's folder contains exactly one such
    /// file.
    pub(super) cubic: Option<PathBuf>,
    /// Vega's simulation settings (`.config`), if the model's folder contains exactly one such file.
    pub(super) vega_config: Option<PathBuf>,
}

impl DemoScene {
    /// Loads a scene by built-in name or path.
    ///
    /// # Errors
    /// Those of loading the scene.
    pub(super) fn find(source: &str) -> Result<Self> {
        let scene = with_spinner("loading", || load::open(source))?.scene;
        let Ok(path) = Path::new(source).canonicalize() else {
            return Ok(Self { scene, source: source.into(), repository: None, cubic: None, vega_config: None });
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let folder = if path.is_dir() { path.clone() } else { path.parent().unwrap_or(&path).to_path_buf() };
        Ok(Self {
            scene,
            // With the leading "./" the name is never resolved as a built-in scene.
            source: format!("./{name}"),
            repository: path.parent().map(Path::to_path_buf),
            cubic: only_file(&folder, "cub"),
            vega_config: only_file(&folder, "config"),
        })
    }
}

/// The only file with this extension in a folder. `None` if there is no such file or more than one.
fn only_file(folder: &Path, extension: &str) -> Option<PathBuf> {
    let entries = std::fs::read_dir(folder).ok()?;
    let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let mut matches = paths.filter(|path| path.extension().is_some_and(|path_extension| path_extension == extension));
    let first_match = matches.next()?;
    matches.next().is_none().then_some(first_match)
}
