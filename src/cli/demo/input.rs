//! Input of the demo: the scene, the repository from which the server opens it, and the files of the FEM library Vega
//! next to it.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::super::options::with_spinner;
use modalcast_model::error::Result;
use modalcast_model::load;
use modalcast_model::scene::Scene;

/// The scene that the demo runs, and the options with which the processes find its files.
pub(in crate::cli) struct DemoScene {
    pub(in crate::cli) scene: Arc<Scene>,
    /// Name or path of the scene in the server's repository.
    pub(in crate::cli) source: String,
    /// The server's repository. `None` for a built-in scene.
    pub(in crate::cli) repository: Option<PathBuf>,
    /// Vega's cubic polynomial of the internal forces (`.cub`), if a file with the model's name exists.
    pub(in crate::cli) cubic: Option<PathBuf>,
    /// Vega's simulation settings (`.config`) beside `cubic`.
    pub(in crate::cli) vega_config: Option<PathBuf>,
}

impl DemoScene {
    /// Loads a scene by built-in name or path.
    ///
    /// # Errors
    /// Those of loading the scene.
    pub(in crate::cli) fn find(source: &str) -> Result<Self> {
        let scene = with_spinner("loading", || load::open(source))?.scene;
        Ok(Self::locate(scene, source, Path::new(".")))
    }

    /// Finds the files of a scene that was opened as `source`, which is relative to `base`.
    fn locate(scene: Arc<Scene>, source: &str, base: &Path) -> Self {
        let path = base.join(source).canonicalize().ok();
        // `load::open` prefers the built-in scene, even if a folder has its name.
        let Some(path) = path.filter(|_| !load::is_built_in(source)) else {
            return Self { scene, source: source.into(), repository: None, cubic: None, vega_config: None };
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let folder = if path.is_dir() { path.clone() } else { path.parent().unwrap_or(&path).to_path_buf() };
        let cubic = cubic_file(&scene, &folder);
        let vega_config = cubic.as_ref().map(|path| path.with_extension("config")).filter(|path| path.is_file());
        Self {
            scene,
            // With the leading "./" the name is never resolved as a built-in scene.
            source: format!("./{name}"),
            repository: path.parent().map(Path::to_path_buf),
            cubic,
            vega_config,
        }
    }
}

/// The file of cubic polynomials that belongs to the model. The loader stores the file's name as a note of the domain.
/// `None` if not exactly one domain has this note, or the file is not in the folder.
fn cubic_file(scene: &Scene, folder: &Path) -> Option<PathBuf> {
    let mut names = scene.domains.iter().filter_map(|domain| domain.metadata.notes.get("vega.cubic"));
    let name = names.next()?;
    let path = folder.join(name);
    (names.next().is_none() && path.is_file()).then_some(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_found_by_model_name_but_not_for_built_in_scenes() {
        let outer = tempfile::tempdir().expect("expected a temporary folder");
        for name in ["tree", "beam", "other"] {
            let folder = outer.path().join(name);
            std::fs::create_dir(&folder).expect("expected a new folder");
            let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("a written file");
            write("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
            write(if name == "other" { "unrelated.cub" } else { "a.cub" }, "");
            write("unrelated.config", "");
            write("a.config", "*baseFrequency\n1\n");
        }
        let locate = |source: &str| {
            let path = outer.path().join(source);
            let scene = load::open(&path.to_string_lossy()).expect("expected a scene").scene;
            DemoScene::locate(scene, source, outer.path())
        };
        let beam = locate("beam");
        assert_eq!(beam.source, "./beam");
        let file_name = |path: &Option<PathBuf>| path.as_ref().and_then(|path| path.file_name()).map(ToOwned::to_owned);
        assert_eq!(
            (file_name(&beam.cubic), file_name(&beam.vega_config)),
            (Some("a.cub".into()), Some("a.config".into()))
        );
        let other = locate("other");
        assert_eq!((other.cubic, other.vega_config), (None, None), "expected no guess");
        // `tree` is the built-in scene, although a folder has this name. `./tree` is the folder.
        let built_in = locate("tree");
        assert_eq!((built_in.source.as_str(), built_in.repository, built_in.cubic), ("tree", None, None));
        assert!(locate("./tree").repository.is_some());
    }
}
