//! Input of the demo: the scene, the repository from which the server opens it, and the files of the FEM library Vega
//! next to it.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::super::options::with_spinner;
use modalcast_model::error::Result;
use modalcast_model::load;
use modalcast_model::scene::Scene;

/// Deflection of a body with cubic forces in the demo, as a fraction of the diagonal. Without it, no load would act on
/// a model of `modalcast model --large`.
const DEMO_DEFLECTION: &str = "0.03";

/// Where a scene is, without its content.
pub(in crate::cli) struct SceneLocation {
    /// Name or path of the scene in the server's repository.
    pub(in crate::cli) source: String,
    /// The server's repository. `None` for a built-in scene.
    pub(in crate::cli) repository: Option<PathBuf>,
    /// The folder of the scene's files. `None` for a built-in scene.
    folder: Option<PathBuf>,
}

/// Files of the FEM library Vega that belong to a scene.
pub(in crate::cli) struct ForceFiles {
    /// Cubic polynomial of the internal forces (`.cub`), if a file with the model's name exists.
    pub(in crate::cli) cubic: Option<PathBuf>,
    /// Simulation settings (`.config`) beside `cubic`.
    pub(in crate::cli) config: Option<PathBuf>,
    /// Name of the domain that the forces of `cubic` act on.
    domain: Option<String>,
}

impl ForceFiles {
    /// Options with which `modalcast-sim` finds the files and their domain.
    pub(in crate::cli) fn flags(&self) -> Vec<String> {
        let text = |path: &Option<PathBuf>| path.as_ref().map(|path| path.to_string_lossy().into_owned());
        let options =
            [("--cubic", text(&self.cubic)), ("--config", text(&self.config)), ("--domain", self.domain.clone())];
        options.into_iter().filter_map(|(flag, value)| Some([flag.to_owned(), value?])).flatten().collect()
    }

    /// [`Self::flags`], with a load for a body with cubic forces.
    pub(super) fn demo_flags(&self) -> Vec<String> {
        let load = self.cubic.iter().flat_map(|_| ["--deflection".to_owned(), DEMO_DEFLECTION.to_owned()]);
        self.flags().into_iter().chain(load).collect()
    }
}

impl SceneLocation {
    /// Finds a scene by built-in name or path.
    ///
    /// # Errors
    /// That of loading the scene if nothing has this name.
    pub(in crate::cli) fn find(source: &str) -> Result<Self> {
        if !load::is_built_in(source) && !Path::new(source).exists() {
            load::open(source)?;
        }
        Ok(Self::locate(source, Path::new(".")))
    }

    /// As [`Self::find`], for a path that is relative to `base`.
    fn locate(source: &str, base: &Path) -> Self {
        let path = base.join(source).canonicalize().ok();
        // `load::open` prefers the built-in scene, even if a folder has its name.
        let Some(path) = path.filter(|_| !load::is_built_in(source)) else {
            return Self { source: source.into(), repository: None, folder: None };
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let folder = if path.is_dir() { path.clone() } else { path.parent().unwrap_or(&path).to_path_buf() };
        // With the leading "./" the name is never resolved as a built-in scene.
        Self { source: format!("./{name}"), repository: path.parent().map(Path::to_path_buf), folder: Some(folder) }
    }

    /// The force files in the folder of the scene that is here.
    pub(in crate::cli) fn force_files(&self, scene: &Scene) -> ForceFiles {
        let found = self.folder.as_ref().and_then(|folder| cubic_file(scene, folder));
        let (cubic, domain) = found.unzip();
        let config = cubic.as_ref().map(|path| path.with_extension("config")).filter(|path| path.is_file());
        ForceFiles { cubic, config, domain }
    }
}

/// The scene that the demo runs, and the options with which the processes find its files.
pub(in crate::cli) struct DemoScene {
    pub(in crate::cli) scene: Arc<Scene>,
    pub(in crate::cli) location: SceneLocation,
    pub(in crate::cli) force_files: ForceFiles,
}

impl DemoScene {
    /// Loads a scene by built-in name or path.
    ///
    /// # Errors
    /// Those of loading the scene.
    pub(in crate::cli) fn load(source: &str) -> Result<Self> {
        let scene = with_spinner("loading", || load::open(source))?.scene;
        let location = SceneLocation::find(source)?;
        let force_files = location.force_files(&scene);
        Ok(Self { scene, location, force_files })
    }
}

/// The file of cubic polynomials that belongs to the model, and the name of its domain. The loader stores the file's
/// name as a note of the domain. `None` if not exactly one domain has this note, or the file is not in the folder.
fn cubic_file(scene: &Scene, folder: &Path) -> Option<(PathBuf, String)> {
    let mut domains =
        scene.domains.iter().filter_map(|domain| Some((domain, domain.metadata.notes.get("vega.cubic")?)));
    let (domain, file_name) = domains.next()?;
    let path = folder.join(file_name);
    (domains.next().is_none() && path.is_file()).then(|| (path, domain.name.clone()))
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
            let location = SceneLocation::locate(source, outer.path());
            let force_files = location.force_files(&scene);
            (location, force_files)
        };
        let (location, beam) = locate("beam");
        assert_eq!(location.source, "./beam");
        let file_name = |path: &Option<PathBuf>| path.as_ref().and_then(|path| path.file_name()).map(ToOwned::to_owned);
        assert_eq!((file_name(&beam.cubic), file_name(&beam.config)), (Some("a.cub".into()), Some("a.config".into())));
        let flags = beam.flags();
        assert_eq!((flags.len(), &flags[4..]), (6, &["--domain".to_owned(), "a".to_owned()][..]));
        assert_eq!(beam.demo_flags(), [&flags[..], &["--deflection".to_owned(), "0.03".to_owned()]].concat());
        let (_, other) = locate("other");
        assert_eq!((other.flags(), other.demo_flags()), (vec![], vec![]), "expected no guess and no load");
        // `tree` is the built-in scene, although a folder has this name. `./tree` is the folder.
        let (built_in, files) = locate("tree");
        assert_eq!((built_in.source.as_str(), built_in.repository, files.cubic), ("tree", None, None));
        assert!(locate("./tree").0.repository.is_some());
    }

    #[test]
    fn missing_scene_is_an_error() {
        let error = SceneLocation::find("no/such/scene.obj").err().expect("expected an error").to_string();
        assert!(error.contains("no/such/scene.obj"), "{error}");
    }
}
