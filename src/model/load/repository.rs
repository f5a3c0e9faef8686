//! The server's folder of scenes: opens scenes by name and lists their names.

use std::path::{Path, PathBuf};

use super::asset_dir::{AssetDir, EntryKind};
use super::{OpenedScene, manifest, source};
use crate::error::{Error, Result};

/// Depth of folders, below the root, up to which scenes are listed. Deeper scenes can still be opened by their path.
const MAX_LIST_DEPTH: usize = 4;
/// The largest number of listed names.
const MAX_LISTED: usize = 4096;

/// The server's folder of scenes. Every path stays inside it, after symbolic links are resolved.
#[derive(Debug, Clone)]
pub struct SceneRepository {
    root: Option<PathBuf>,
}

impl SceneRepository {
    /// A repository with the built-in scenes and those in `root`.
    ///
    /// # Errors
    /// `Unavailable` if the folder does not exist.
    pub fn new(root: Option<&Path>) -> Result<Self> {
        let Some(root) = root else { return Ok(Self { root: None }) };
        let unavailable = |reason: String| Error::Unavailable {
            what: "scene repository",
            reason: format!("{}: {reason}", root.display()),
            remedy: "Name a folder that is there".into(),
        };
        let canonical = root.canonicalize().map_err(|error| unavailable(error.to_string()))?;
        if !canonical.is_dir() {
            return Err(unavailable("not a folder".into()));
        }
        Ok(Self { root: Some(canonical) })
    }

    /// Opens a built-in scene or a path inside the repository; `.` is the repository's root folder.
    ///
    /// # Errors
    /// As for [`super::open`], and `Invalid` for a path that leaves the repository.
    pub fn open(&self, source: &str) -> Result<OpenedScene> {
        match &self.root {
            Some(root) => OpenedScene::new(source::read(&AssetDir::confined_to(root), source)?),
            None if source::BUILT_IN.contains(&source) => super::open(source),
            None => Err(Error::NotFound { what: "scene", given: source.into() }),
        }
    }

    /// Names that [`Self::open`] accepts: built-in scenes, then folders and model files down to a limited depth,
    /// sorted.
    pub fn list(&self) -> Vec<String> {
        let mut names: Vec<String> = source::BUILT_IN.map(str::to_owned).to_vec();
        if let Some(root) = &self.root {
            let mut found = Vec::new();
            collect(&AssetDir::confined_to(root), "", MAX_LIST_DEPTH, &mut found);
            found.sort();
            names.append(&mut found);
        }
        names
    }
}

fn collect(folder: &AssetDir, prefix: &str, depth: usize, found: &mut Vec<String>) {
    let entries = folder.entries();
    let is_manifest = entries.contains(&(manifest::MANIFEST_FILE.to_owned(), EntryKind::File));
    if is_manifest || source::models(folder).len() == 1 {
        found.push(if prefix.is_empty() { ".".into() } else { prefix.trim_end_matches('/').into() });
    }
    for (name, kind) in entries {
        // Skip hidden entries: uploads in progress, version control.
        if found.len() >= MAX_LISTED || name.starts_with('.') {
            continue;
        }
        let path = format!("{prefix}{name}");
        match kind {
            EntryKind::File if source::recognize_model(&name).is_some() => found.push(path),
            EntryKind::Directory if depth > 0 => {
                if let Ok(sub) = folder.within(&name) {
                    collect(&sub, &format!("{path}/"), depth - 1, found);
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

    fn repository(files: &[(&str, &str)]) -> (tempfile::TempDir, SceneRepository) {
        let outer = tempfile::tempdir().expect("a folder");
        for (name, text) in files {
            let path = outer.path().join("root").join(name);
            std::fs::create_dir_all(path.parent().expect("a parent")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let repository = SceneRepository::new(Some(&outer.path().join("root"))).expect("there");
        (outer, repository)
    }

    #[test]
    fn what_is_listed_can_be_opened() {
        let (_keep, repository) = repository(&[
            ("one/a.obj", TRIANGLE),
            ("two/b.obj", TRIANGLE),
            ("two/c.obj", TRIANGLE),
            ("deep/er/scene/scene.toml", "model = '../../../one/a.obj'\n"),
            ("a/b/c/d/e/f/far.obj", TRIANGLE),
            (".hidden/x.obj", TRIANGLE),
            ("notes.txt", ""),
        ]);
        let names = repository.list();
        assert_eq!(names, ["tree", "deep/er/scene", "one", "one/a.obj", "two/b.obj", "two/c.obj"]);
        for name in &names[1..] {
            let scene = repository.open(name).unwrap_or_else(|error| panic!("{name}: {error}"));
            assert_eq!(scene.scene.domains.len(), 1);
        }
        assert_eq!(repository.open("deep/er/scene").expect("there").scene.name, "scene");
        assert!(repository.open("a/b/c/d/e/f/far.obj").is_ok(), "too deep for the list, not for its path");
    }

    #[test]
    fn paths_that_leave_the_repository_are_refused_alike_whether_something_is_there_or_not() {
        let (outer, repository) = repository(&[
            ("one/a.obj", TRIANGLE),
            ("out/scene.toml", "model = '../../secret.obj'\n"),
            ("far/scene.toml", "model = '/etc/hostname'\n"),
            ("map/a.obj", "mtllib ../../secret.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
            ("patch/scene.toml", "model = '../one/a.obj'\nmaterial.'*'.colour_texture = '../../x.png'\n"),
        ]);
        std::fs::write(outer.path().join("secret.obj"), TRIANGLE).expect("written");
        std::os::unix::fs::symlink(outer.path(), outer.path().join("root/link")).expect("linked");
        for source in [
            "../secret.obj",
            "../absent.obj",
            "/etc/passwd",
            "/absent",
            "one/../../secret.obj",
            "link/secret.obj",
            "link",
            "out",
            "far",
            "map",
            "patch",
        ] {
            let refusal = repository.open(source).expect_err(source).to_string();
            assert!(refusal.contains("expected a path inside the repository"), "{source}: {refusal}");
            let outside = outer.path().to_str().expect("utf-8");
            assert!(!refusal.contains(outside), "{source}: {refusal}");
        }
        assert!(!repository.list().iter().any(|name| name.starts_with("link")));
    }

    #[test]
    fn unknown_names_and_folders_are_told_apart() {
        let (outer, repository) = repository(&[("two/b.obj", TRIANGLE), ("two/c.obj", TRIANGLE), ("none/x.txt", "")]);
        let absent = repository.open("absent").expect_err("absent");
        assert_eq!(absent, Error::NotFound { what: "scene", given: "absent".into() });
        let ambiguous = repository.open("two").expect_err("two models").to_string();
        assert_eq!(ambiguous, "folder 'two': expected scene.toml, or one model to choose, got 2: b.obj, c.obj");
        let empty = repository.open("none").expect_err("no model").to_string();
        assert!(empty.ends_with("got none among: x.txt"), "{empty}");
        assert!(matches!(SceneRepository::new(Some(&outer.path().join("no"))), Err(Error::Unavailable { .. })));
        let built_in = SceneRepository::new(None).expect("built-in scenes only");
        assert_eq!(built_in.list(), ["tree"]);
        assert!(matches!(built_in.open("two"), Err(Error::NotFound { .. })));
    }
}
