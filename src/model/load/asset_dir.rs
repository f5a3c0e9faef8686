//! File access of the loaders: which paths they may read, and how many bytes.

use std::fs::File;
use std::io::Read;
use std::path::{Component, Path, PathBuf};

use crate::domain::Texture;
use crate::error::{Result, invalid};

/// The largest mesh or matrix file in bytes.
pub(super) const MAX_MODEL_BYTES: u64 = 2 << 30;
/// The largest image file in bytes.
pub(super) const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// The largest text file other than a mesh or matrix in bytes, such as an MTL library.
pub(super) const MAX_TEXT_BYTES: u64 = 64 << 20;

/// The largest number of directory entries that are read.
const MAX_ENTRIES: usize = 10_000;

/// A folder whose files a loader may read. With a `root`, every path must stay inside the root after symbolic links are
/// resolved. Without a `root`, any path is allowed.
#[derive(Debug, Clone)]
pub(super) struct AssetDir {
    /// The folder to which paths are relative.
    base: PathBuf,
    root: Option<PathBuf>,
    /// Whether a file that another file refers to must exist.
    is_strict: bool,
}

/// The kind of an existing path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EntryKind {
    File,
    Directory,
}

impl AssetDir {
    /// Allows any path: absolute or relative to `base`.
    pub(super) fn unrestricted(base: &Path) -> Self {
        Self { base: base.to_path_buf(), root: None, is_strict: false }
    }

    /// Allows only paths relative to `root` that stay inside it. `root` must be canonical.
    pub(super) fn confined_to(root: &Path) -> Self {
        Self { base: root.to_path_buf(), root: Some(root.to_path_buf()), is_strict: false }
    }

    /// The same folder. [`Self::has_referenced_file`] fails for files that do not exist.
    pub(super) fn strict(&self) -> Self {
        Self { is_strict: true, ..self.clone() }
    }

    /// Whether a missing file or definition is an error instead of a remark.
    pub(super) const fn is_strict(&self) -> bool {
        self.is_strict
    }

    /// Whether a file exists that another file refers to. If it does not, the loader uses a stand-in and adds a remark.
    ///
    /// # Errors
    /// `Invalid` for a path that leaves the root and, in strict mode, for a file that does not exist.
    pub(super) fn has_referenced_file(&self, relative: &str) -> Result<bool> {
        match self.kind(relative)? {
            None if self.is_strict => Err(invalid(field_of(relative), "an existing file", "none (strict mode)")),
            kind => Ok(kind.is_some()),
        }
    }

    /// The reason why the image that another file refers to is not drawn, worded as the end of a remark. `None` for a
    /// PNG or JPEG image.
    ///
    /// # Errors
    /// As for [`Self::has_referenced_file`] and [`Self::read_start`]; in strict mode, also for other formats.
    pub(super) fn unusable_image(&self, relative: &str) -> Result<Option<&'static str>> {
        if !self.has_referenced_file(relative)? {
            return Ok(Some("does not exist"));
        }
        let start = self.read_start(relative, Texture::SIGNATURE_BYTES as u64)?;
        self.unsupported_image(relative, &start)
    }

    /// As [`Self::unusable_image`], for an image that starts with the bytes `start`.
    ///
    /// # Errors
    /// In strict mode, `Invalid` for other formats than PNG and JPEG.
    pub(super) fn unsupported_image(&self, name: &str, start: &[u8]) -> Result<Option<&'static str>> {
        match (Texture::is_supported(start), self.is_strict) {
            (true, _) => Ok(None),
            (false, false) => Ok(Some("is neither a PNG nor a JPEG image")),
            (false, true) => Err(invalid(field_of(name), "a PNG or JPEG image", "another format (strict mode)")),
        }
    }

    /// The folder `relative`, with the same confinement.
    ///
    /// # Errors
    /// As for [`Self::resolve`].
    pub(super) fn within(&self, relative: &str) -> Result<Self> {
        Ok(Self { base: self.resolve(relative)?, ..self.clone() })
    }

    /// The last component of the resolved path, or `scene` if it has none or does not resolve.
    pub(super) fn resolved_name(&self, relative: &str) -> String {
        let path = self.resolve(relative).ok();
        let name = path.as_deref().and_then(Path::file_name).and_then(|name| name.to_str());
        name.unwrap_or("scene").to_owned()
    }

    /// Reads a regular file of at most `limit` bytes.
    ///
    /// # Errors
    /// `Invalid` if the path is outside the root, does not exist, is not a regular file, is too large or unreadable.
    /// The error contains the unresolved path, so that it does not reveal the location of the root.
    pub(super) fn read(&self, relative: &str, limit: u64) -> Result<Vec<u8>> {
        let too_large = |size: u64| invalid(field_of(relative), format!("at most {limit} bytes"), size);
        let file_bytes = self.regular_file(relative)?.1;
        if file_bytes > limit {
            return Err(too_large(file_bytes));
        }
        let bytes = self.read_start(relative, limit.saturating_add(1))?;
        // The file may have grown after its size was read.
        if bytes.len() as u64 > limit {
            return Err(too_large(bytes.len() as u64));
        }
        Ok(bytes)
    }

    /// Reads at most the first `count` bytes of a regular file.
    ///
    /// # Errors
    /// As for [`Self::read`], except for the size.
    pub(super) fn read_start(&self, relative: &str, count: u64) -> Result<Vec<u8>> {
        let (path, _) = self.regular_file(relative)?;
        let mut bytes = Vec::new();
        let file = File::open(&path).map_err(|error| unreadable(relative, &error.kind()))?;
        file.take(count).read_to_end(&mut bytes).map_err(|error| unreadable(relative, &error.kind()))?;
        Ok(bytes)
    }

    /// The resolved path of a regular file, and its size in bytes.
    fn regular_file(&self, relative: &str) -> Result<(PathBuf, u64)> {
        let path = self.resolve(relative)?;
        // Check the type before the file is opened, because opening a pipe or a device may block, and reading it may
        // never end.
        let metadata = path.metadata().map_err(|error| unreadable(relative, &error.kind()))?;
        match metadata.is_file() {
            true => Ok((path, metadata.len())),
            false => Err(unreadable(relative, &"a folder or a special file")),
        }
    }

    /// The kind of the path, or `None` if it does not exist.
    ///
    /// # Errors
    /// `Invalid` for a path that leaves the root.
    pub(super) fn kind(&self, relative: &str) -> Result<Option<EntryKind>> {
        if !self.join(relative)?.exists() {
            return Ok(None);
        }
        let path = self.resolve(relative)?;
        Ok(if path.is_dir() { Some(EntryKind::Directory) } else { path.is_file().then_some(EntryKind::File) })
    }

    /// Names and kinds of the folder's direct entries, sorted. Reads at most [`MAX_ENTRIES`] entries.
    pub(super) fn entries(&self) -> Vec<(String, EntryKind)> {
        let Ok(listing) = std::fs::read_dir(&self.base) else { return Vec::new() };
        let names = listing.take(MAX_ENTRIES).filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let mut entries: Vec<_> =
            names.filter_map(|name| self.kind(&name).ok().flatten().map(|kind| (name, kind))).collect();
        entries.sort_by(|a, b| a.0.cmp(&b.0));
        entries
    }

    /// Names of the folder's files, sorted.
    pub(super) fn file_names(&self) -> Vec<String> {
        self.entries().into_iter().filter(|(_, kind)| *kind == EntryKind::File).map(|(name, _)| name).collect()
    }

    /// The canonical path of `relative`.
    ///
    /// # Errors
    /// `Invalid` if the path leaves the root or does not exist.
    pub(super) fn resolve(&self, relative: &str) -> Result<PathBuf> {
        let path = self.join(relative)?;
        let missing_file = |error: std::io::Error| invalid(field_of(relative), "an existing file", error.kind());
        let canonical = path.canonicalize().map_err(missing_file)?;
        match &self.root {
            Some(root) if !canonical.starts_with(root) => Err(outside_error(relative)),
            _ => Ok(canonical),
        }
    }

    /// Joins the path to `base` without access to the file system, so that an error reveals nothing about files outside
    /// the root.
    fn join(&self, relative: &str) -> Result<PathBuf> {
        if relative.is_empty() || relative.contains('\0') {
            return Err(invalid(field_of(relative), "a non-empty path without NUL", format!("{relative:?}")));
        }
        let Some(root) = &self.root else { return Ok(self.base.join(relative)) };
        let mut path = self.base.clone();
        for component in Path::new(relative).components() {
            match component {
                Component::Normal(name) => path.push(name),
                Component::CurDir => {}
                Component::ParentDir => {
                    path.pop();
                    if !path.starts_with(root) {
                        return Err(outside_error(relative));
                    }
                }
                Component::RootDir | Component::Prefix(_) => return Err(outside_error(relative)),
            }
        }
        Ok(path)
    }
}

/// The folder of a path; `.` if the path is only a file name.
pub(super) fn parent_of(path: &str) -> &str {
    match path.rsplit_once('/') {
        Some(("", _)) => "/",
        Some((folder, _)) => folder,
        None => ".",
    }
}

/// The last component of a path.
pub(super) fn file_name_of(path: &str) -> &str {
    path.rsplit_once('/').map_or(path, |(_, name)| name)
}

/// The name of a file without its extension.
pub(super) fn stem_of(name: &str) -> &str {
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

/// The extension of a file name in lower case; empty if the name has none.
pub(super) fn extension_of(name: &str) -> String {
    name.rsplit_once('.').map_or_else(String::new, |(_, extension)| extension.to_ascii_lowercase())
}

/// The field of an error about a file.
fn field_of(relative: &str) -> String {
    format!("file '{relative}'")
}

fn unreadable(relative: &str, given: &dyn std::fmt::Display) -> crate::error::Error {
    invalid(field_of(relative), "a regular, readable file", given)
}

fn outside_error(relative: &str) -> crate::error::Error {
    invalid(field_of(relative), "a path inside the repository", "a path outside of it")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confined_reads_reject_paths_outside_without_revealing_files() {
        let outer = tempfile::tempdir().expect("a temporary folder");
        let root = outer.path().join("root");
        std::fs::create_dir_all(root.join("sub")).expect("a new folder");
        std::fs::write(outer.path().join("secret.txt"), "secret").expect("a writable file");
        std::fs::write(root.join("inside.txt"), "inside").expect("a writable file");
        std::os::unix::fs::symlink(outer.path().join("secret.txt"), root.join("link.txt")).expect("a symbolic link");
        std::os::unix::fs::symlink(outer.path(), root.join("folder")).expect("a symbolic link");
        let root = root.canonicalize().expect("an existing folder");
        let files = AssetDir::confined_to(&root).within("sub").expect("an existing folder");
        assert_eq!(files.read("../inside.txt", 6).expect("a file inside the root"), b"inside");
        let secret = outer.path().join("secret.txt");
        for path in ["../../secret.txt", "../link.txt", "../folder/secret.txt", secret.to_str().expect("a UTF-8 path")]
        {
            let message = files.read(path, 100).expect_err(path).to_string();
            let expected = format!("file '{path}': expected a path inside the repository, got a path outside of it");
            assert_eq!(message, expected);
        }
        let absent = files.read("../../absent.txt", 100).expect_err("a missing file outside").to_string();
        assert!(absent.ends_with("expected a path inside the repository, got a path outside of it"), "{absent}");
        assert_eq!(AssetDir::unrestricted(&root).read("../secret.txt", 100).expect("a readable file"), b"secret");
    }

    #[test]
    fn unreadable_files_are_rejected_with_the_requested_path() {
        let root = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(root.path().join("a.bin"), [0; 5]).expect("a writable file");
        std::fs::create_dir(root.path().join("d")).expect("a new folder");
        let files = AssetDir::unrestricted(root.path());
        for (path, message) in [
            ("a.bin", "file 'a.bin': expected at most 4 bytes, got 5"),
            ("b.bin", "file 'b.bin': expected an existing file, got entity not found"),
            ("d", "file 'd': expected a regular, readable file, got a folder or a special file"),
            ("", "file '': expected a non-empty path without NUL, got \"\""),
            ("a\0b", "file 'a\0b': expected a non-empty path without NUL, got \"a\\0b\""),
        ] {
            assert_eq!(files.read(path, 4).expect_err(path).to_string(), message);
        }
        assert_eq!(files.read("a.bin", 5).expect("a readable file").len(), 5);
    }
}
