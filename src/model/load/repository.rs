//! The server's folder of scenes: opens scenes by name and lists their names.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::asset_dir::{AssetDir, EntryKind};
use super::file_hashes::FileHashes;
use super::{LoadOptions, OpenedScene, manifest, source};
use crate::error::{Error, Result};
use crate::memory::MemoryReservation;

/// The largest depth of listed folders below the root. Deeper scenes can still be opened by their path.
const MAX_LIST_DEPTH: usize = 4;
/// The largest number of listed names, without built-in scenes.
const MAX_LISTED_NAMES: usize = 4096;

/// The server's folder of scenes. Paths cannot leave it, because symbolic links are resolved before the check.
#[derive(Debug, Clone)]
pub struct SceneRepository {
    /// The canonical path of the folder. `None`: the repository has only the built-in scenes.
    root: Option<PathBuf>,
    options: LoadOptions,
}

impl SceneRepository {
    /// A repository with the built-in scenes and those in `root`.
    ///
    /// # Errors
    /// `Unavailable` if the folder does not exist.
    pub fn new(root: Option<&Path>) -> Result<Self> {
        Ok(Self { root: root.map(canonical_folder).transpose()?, options: LoadOptions::default() })
    }

    /// The same repository, whose scenes are read with these options. Only [`LoadOptions::is_strict`] also applies to
    /// uploads, because they come from other programs, which set the unit and the up axis themselves.
    #[must_use]
    pub fn with_options(self, options: LoadOptions) -> Self {
        Self { options, ..self }
    }

    /// Opens a built-in scene or a path inside the repository; `.` is the repository's root folder. The loaders reserve
    /// memory for contents in `memory` before they read or decode them.
    ///
    /// # Errors
    /// As for [`super::open`], `Invalid` for a path that leaves the repository, and `OutOfMemory`.
    pub fn open(&self, source: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        match &self.root {
            Some(root) => OpenedScene::new(source::read(&AssetDir::confined_to(root, memory), source, &self.options)?),
            None if source::is_built_in(source) => super::open_with(source, &self.options),
            None => Err(Error::NotFound { what: "scene", given: source.into() }),
        }
    }

    /// Opens `entry` of a folder of uploaded files, or the folder itself if `entry` is empty. Nothing outside the folder is
    /// read. Each file that is read must have its hash in `hashes`.
    ///
    /// # Errors
    /// As for [`Self::open`], and `Invalid` with the name of a file that has changed.
    pub fn open_upload(
        &self,
        folder: &Path,
        entry: &str,
        hashes: &Arc<FileHashes>,
        memory: &Arc<MemoryReservation>,
    ) -> Result<OpenedScene> {
        let files = AssetDir::confined_to(&canonical_folder(folder)?, memory).with_hashes(Arc::clone(hashes));
        // With the leading "./" a file name is never resolved as a built-in name.
        let options = LoadOptions { is_strict: self.options.is_strict, ..LoadOptions::default() };
        OpenedScene::new(source::read(&files, &format!("./{entry}"), &options)?)
    }

    /// Whether a source names a built-in scene.
    pub fn is_built_in(source: &str) -> bool {
        source::is_built_in(source)
    }

    /// Names that [`Self::open`] accepts: built-in scenes, then folders and model files down to a limited depth,
    /// sorted.
    pub fn list(&self) -> Vec<String> {
        let mut names: Vec<String> = source::BUILT_IN.map(str::to_owned).to_vec();
        if let Some(root) = &self.root {
            let mut root_names = Vec::new();
            let files = AssetDir::confined_to(root, &MemoryReservation::unlimited());
            collect_names(&files, "", MAX_LIST_DEPTH, &mut root_names);
            root_names.sort();
            // A built-in scene hides a folder of the same name, unless its path begins with `./`.
            for name in root_names.iter_mut().filter(|name| source::is_built_in(name)) {
                name.insert_str(0, "./");
            }
            names.append(&mut root_names);
        }
        names
    }
}

/// The canonical path of a folder.
///
/// # Errors
/// `Unavailable` if the folder does not exist.
fn canonical_folder(folder: &Path) -> Result<PathBuf> {
    let unavailable = |reason: String| Error::Unavailable {
        what: "scene repository",
        reason: format!("{}: {reason}", folder.display()),
        remedy: "Pass an existing folder".into(),
    };
    let canonical = folder.canonicalize().map_err(|error| unavailable(error.to_string()))?;
    match canonical.is_dir() {
        true => Ok(canonical),
        false => Err(unavailable("not a folder".into())),
    }
}

/// Appends the scenes in `folder` to `names`. `prefix` is the path of the folder below the root with a final `/`, or
/// empty. Subfolders are searched down to `depth` levels.
fn collect_names(folder: &AssetDir, prefix: &str, depth: usize, names: &mut Vec<String>) {
    if folder.has_file(manifest::MANIFEST_FILE) || source::find_models(folder).len() == 1 {
        names.push(if prefix.is_empty() { ".".into() } else { prefix.trim_end_matches('/').into() });
    }
    for (name, kind) in folder.listing().entries() {
        // Skip hidden entries: uploads in progress, version control.
        if names.len() >= MAX_LISTED_NAMES || name.starts_with('.') {
            continue;
        }
        let path = format!("{prefix}{name}");
        match kind {
            EntryKind::File if source::find_model(folder, name).is_some() => names.push(path),
            EntryKind::Directory if depth > 0 => {
                if let Ok(subfolder) = folder.within(name) {
                    collect_names(&subfolder, &format!("{path}/"), depth - 1, names);
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use sha2::Digest as _;

    use super::*;

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

    /// Writes files to the folder `root` inside a temporary folder. Returns the temporary folder and a repository of
    /// `root`.
    fn repository(files: &[(&str, &str)]) -> (tempfile::TempDir, SceneRepository) {
        let outer = tempfile::tempdir().expect("a temporary folder");
        for (name, text) in files {
            let path = outer.path().join("root").join(name);
            std::fs::create_dir_all(path.parent().expect("a parent")).expect("a new folder");
            std::fs::write(path, text).expect("a writable file");
        }
        let repository = SceneRepository::new(Some(&outer.path().join("root"))).expect("an existing folder");
        (outer, repository)
    }

    #[test]
    fn listed_scenes_can_be_opened() {
        let (_folder, repository) = repository(&[
            ("one/a.obj", TRIANGLE),
            ("two/b.obj", TRIANGLE),
            ("two/c.obj", TRIANGLE),
            ("deep/er/scene/scene.toml", "model = '../../../one/a.obj'\n"),
            ("a/b/c/d/e/f/far.obj", TRIANGLE),
            (".hidden/x.obj", TRIANGLE),
            ("notes.txt", ""),
            ("tree/d.obj", TRIANGLE),
            ("data/results.npz", ""),
        ]);
        // The folder `two` has two models, so it is not a scene. `far.obj` is six folders deep; the listing ends at
        // four.
        let names = repository.list();
        let expected = ["tree", "deep/er/scene", "one", "one/a.obj", "./tree", "tree/d.obj", "two/b.obj", "two/c.obj"];
        assert_eq!(names, expected, "expected ./tree for the folder whose name is that of a built-in scene");
        // All names but that of the built-in tree.
        for name in &names[1..] {
            let opened = repository
                .open(name, &MemoryReservation::unlimited())
                .unwrap_or_else(|error| panic!("{name}: {error}"));
            assert_eq!(opened.scene.domains.len(), 1);
        }
        assert_eq!(
            repository.open("deep/er/scene", &MemoryReservation::unlimited()).expect("a valid scene").scene.name,
            "scene"
        );
        assert!(
            repository.open("a/b/c/d/e/f/far.obj", &MemoryReservation::unlimited()).is_ok(),
            "expected an unlisted path to open"
        );
    }

    #[test]
    fn archives_are_listed_if_they_contain_a_mesh() {
        use crate::load::modes::test_archives::{archive, npy};
        let (outer, repository) = repository(&[("parts/notes.txt", ""), ("results/notes.txt", "")]);
        let mesh = [
            ("vertices", npy(&ndarray::arr2(&[[0.0_f32; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))),
            ("faces", npy(&ndarray::arr2(&[[0_i64, 1, 2]]))),
        ];
        let write = |path: &str, arrays: &[(&str, Vec<u8>)]| {
            let bytes = archive(arrays, zip::CompressionMethod::Deflated);
            std::fs::write(outer.path().join("root").join(path), bytes).expect("a writable file");
        };
        write("parts/part.npz", &mesh);
        write("parts/stress.npz", &mesh[..1]);
        write("results/stress.npz", &mesh[..1]);
        let names = repository.list();
        assert_eq!(names, ["tree", "parts", "parts/part.npz"]);
        for name in &names[1..] {
            let opened = repository.open(name, &MemoryReservation::unlimited()).expect("a scene");
            assert_eq!(opened.scene.domains.len(), 1, "{name}");
        }
        let error = repository.open("results", &MemoryReservation::unlimited()).expect_err("no mesh").to_string();
        assert!(error.contains("no model among: notes.txt, stress.npz"), "{error}");
    }

    #[test]
    fn paths_outside_are_rejected_without_revealing_files() {
        let (outer, repository) = repository(&[
            ("one/a.obj", TRIANGLE),
            ("out/scene.toml", "model = '../../secret.obj'\n"),
            ("far/scene.toml", "model = '/etc/hostname'\n"),
            ("map/a.obj", "mtllib ../../secret.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            ("patch/scene.toml", "model = '../one/a.obj'\nmaterial.'*'.color_texture = '../../x.png'\n"),
        ]);
        std::fs::write(outer.path().join("secret.obj"), TRIANGLE).expect("a writable file");
        std::os::unix::fs::symlink(outer.path(), outer.path().join("root/link")).expect("a symbolic link");
        for source in
            ["../secret.obj", "../absent.obj", "/etc/passwd", "/absent", "one/../../secret.obj", "out", "far", "patch"]
        {
            let message = repository.open(source, &MemoryReservation::unlimited()).expect_err(source).to_string();
            assert!(message.contains("expected a path inside the repository"), "{source}: {message}");
            let outside = outer.path().to_str().expect("a UTF-8 path");
            assert!(!message.contains(outside), "{source}: {message}");
        }
        let opened = repository.open("map", &MemoryReservation::unlimited()).expect("a scene without the library");
        let remark = "material library '../../secret.mtl' is outside of the folder of the scene: the default color is drawn for its materials; copy the file into this folder";
        assert_eq!(opened.scene.remarks, [remark]);
        // Links out of the repository are not found, whether or not their targets exist.
        for source in ["link", "link/secret.obj", "link/absent.obj"] {
            let error = repository.open(source, &MemoryReservation::unlimited()).expect_err(source);
            assert_eq!(error, Error::NotFound { what: "scene", given: source.into() });
        }
        assert!(!repository.list().iter().any(|name| name.starts_with("link")));
    }

    #[test]
    fn options_apply_to_scenes_and_only_strictness_to_uploads() {
        let text = format!("mtllib absent.mtl\n{TRIANGLE}");
        let (outer, lenient) = repository(&[("a.obj", &text), ("b.obj", TRIANGLE)]);
        let root = outer.path().join("root").canonicalize().expect("a folder");
        let hash = |text: &str| -> [u8; 32] { sha2::Sha256::digest(text).into() };
        let hashes: FileHashes =
            [("a.obj".to_owned(), hash(&text)), ("b.obj".to_owned(), hash(TRIANGLE))].into_iter().collect();
        let hashes = Arc::new(hashes);
        let memory = MemoryReservation::unlimited();
        let unit = Some("mm".parse().expect("a unit"));
        let options =
            LoadOptions { is_strict: true, unit, up: Some(crate::scene::UpAxis::Z), ..LoadOptions::default() };
        let strict = lenient.clone().with_options(options);
        let conventions = |opened: OpenedScene| (opened.scene.unit, opened.scene.up.name());
        assert_eq!(strict.open("b.obj", &memory).map(conventions), Ok((0.001, "z")));
        assert_eq!(strict.open_upload(&root, "b.obj", &hashes, &memory).map(conventions), Ok((1.0, "y")));
        assert!(
            lenient.open("a.obj", &memory).is_ok() && lenient.open_upload(&root, "a.obj", &hashes, &memory).is_ok()
        );
        for result in [strict.open("a.obj", &memory), strict.open_upload(&root, "a.obj", &hashes, &memory)] {
            let message = result.expect_err("strict mode").to_string();
            assert!(message.contains("absent.mtl"), "{message}");
        }
        let built_in = SceneRepository::new(None).expect("built-in scenes").with_options(options);
        assert_eq!(built_in.open("tree", &memory).map(conventions), Ok((0.001, "z")));
    }

    #[test]
    fn missing_ambiguous_and_empty_folders_have_different_errors() {
        let (outer, repository) = repository(&[("two/b.obj", TRIANGLE), ("two/c.obj", TRIANGLE), ("none/x.txt", "")]);
        let absent = repository.open("absent", &MemoryReservation::unlimited()).expect_err("a missing scene");
        assert_eq!(absent, Error::NotFound { what: "scene", given: "absent".into() });
        let ambiguous = repository.open("two", &MemoryReservation::unlimited()).expect_err("two models").to_string();
        assert_eq!(
            ambiguous,
            "folder 'two': expected scene.toml or one .glb, .gltf, .obj, .ply, .stl, .npz or .structure.json file, got 2: b.obj, c.obj"
        );
        let empty =
            repository.open("none", &MemoryReservation::unlimited()).expect_err("a folder without models").to_string();
        assert!(empty.ends_with("got no model among: x.txt"), "{empty}");
        assert!(matches!(SceneRepository::new(Some(&outer.path().join("no"))), Err(Error::Unavailable { .. })));
        let built_in = SceneRepository::new(None).expect("built-in scenes only");
        assert_eq!(built_in.list(), ["tree"]);
        assert!(matches!(built_in.open("two", &MemoryReservation::unlimited()), Err(Error::NotFound { .. })));
    }
}
