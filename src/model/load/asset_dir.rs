//! File access of the loaders: which paths they may read, how many bytes, and the memory that they reserve.

use std::fs::File;
use std::io::Read;
use std::ops::Deref;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use super::file_hashes::FileHashes;
pub(super) use super::folder_listing::EntryKind;
use super::folder_listing::{FolderListing, ListingCache};
use crate::domain::Texture;
use crate::error::{Result, invalid};
use crate::memory::{MemoryReservation, TemporaryReservation};

/// The largest mesh or matrix file in bytes.
pub(super) const MAX_MODEL_BYTES: u64 = 2 << 30;
/// The largest image file in bytes.
pub(super) const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// The largest text file other than a mesh or matrix in bytes, such as an MTL library.
pub(super) const MAX_TEXT_BYTES: u64 = 64 << 20;

/// The largest number of directory entries that are read.
const MAX_ENTRIES: usize = 10_000;
/// The largest length of a path in a model file in bytes. No file has a longer path.
const MAX_REFERENCE_BYTES: usize = 4096;
/// Reasons of a remark on a path in a model file.
const MISSING: &str = "does not exist";
const OUTSIDE: &str = "is outside of the folder of the scene";
/// The largest number of last components of a path in a model file by which its file is searched.
const MAX_SEARCHED_NAMES: usize = 8;

/// A folder whose files a loader may read. With a `root`, every path must stay inside the root after symbolic links are
/// resolved. Without a `root`, any path is allowed.
#[derive(Debug, Clone)]
pub(super) struct AssetDir {
    /// The folder to which paths are relative.
    base: PathBuf,
    root: Option<PathBuf>,
    /// The folder of the scene: paths in model files cannot leave it. `None` before a scene is chosen: `base` is used.
    scene_folder: Option<PathBuf>,
    /// Whether a file that another file refers to must exist.
    is_strict: bool,
    /// The memory of the scene that is loaded. Clones of the folder share it.
    memory: Arc<MemoryReservation>,
    /// Clones of the folder share it.
    listings: Arc<ListingCache>,
    /// The hashes of all files in the root, if the files were uploaded. Files that are read whole are verified. The start
    /// of a file, which only decides whether the file is used, is not.
    hashes: Option<Arc<FileHashes>>,
}

/// The file to which a path in a model file refers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ReferencedFile {
    /// The path of a file.
    Exact(String),
    /// No file has the path, for this reason, but another file has a similar path.
    Similar { path: String, reason: &'static str },
    /// No file has the path, for this reason, or a similar one.
    Missing { reason: &'static str },
}

/// A normalized path in a model file: the parents that it starts with, then names of folders and the file.
#[derive(Debug, Clone, Copy)]
struct ReferencePath<'a> {
    parents: usize,
    names: &'a [&'a str],
}

/// The bytes of a file. Their memory is reserved until this is dropped.
#[derive(Debug)]
pub(super) struct FileContent {
    bytes: Vec<u8>,
    _memory: TemporaryReservation,
}

impl FileContent {
    /// The bytes, whose memory is no longer reserved.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }
}

impl Deref for FileContent {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes
    }
}

impl AssetDir {
    /// Allows any path, absolute or relative to `base`, and any amount of memory.
    pub(super) fn unrestricted(base: &Path) -> Self {
        Self::new(base, None, MemoryReservation::unlimited())
    }

    /// Allows only paths relative to `root` that stay inside it. `root` must be canonical. The loaders reserve their memory
    /// in `memory`.
    pub(super) fn confined_to(root: &Path, memory: &Arc<MemoryReservation>) -> Self {
        Self::new(root, Some(root.to_path_buf()), Arc::clone(memory))
    }

    fn new(base: &Path, root: Option<PathBuf>, memory: Arc<MemoryReservation>) -> Self {
        Self {
            base: base.to_path_buf(),
            root,
            scene_folder: None,
            is_strict: false,
            memory,
            listings: Arc::default(),
            hashes: None,
        }
    }

    /// The same folder, whose files must have these hashes.
    pub(super) fn with_hashes(self, hashes: Arc<FileHashes>) -> Self {
        Self { hashes: Some(hashes), ..self }
    }

    /// The memory of the scene that is loaded.
    pub(super) const fn memory(&self) -> &Arc<MemoryReservation> {
        &self.memory
    }

    /// Reserves memory for an object of the scene.
    ///
    /// # Errors
    /// `OutOfMemory` with the name of the object.
    pub(super) fn reserve(&self, object: &str, bytes: u64) -> Result<()> {
        self.memory.reserve(object, bytes)
    }

    /// Reserves the memory of a mesh that is parsed from `file_bytes` bytes until the returned guard is dropped. Lists of
    /// vertices have at most 12 bytes per 8 bytes of a text, and a list that grows has twice its length. Faces reserve more.
    ///
    /// # Errors
    /// As for [`Self::reserve`].
    pub(super) fn reserve_polygons(&self, relative: &str, file_bytes: usize) -> Result<Option<TemporaryReservation>> {
        self.reserve_temporary(&field_of(relative), 3 * file_bytes as u64).map(Some)
    }

    /// Reserves memory until the returned guard is dropped.
    ///
    /// # Errors
    /// As for [`Self::reserve`].
    pub(super) fn reserve_temporary(&self, object: &str, bytes: u64) -> Result<TemporaryReservation> {
        self.memory.reserve_temporary(object, bytes)
    }

    /// The same folder. [`Self::find_referenced`] fails for files that do not exist.
    pub(super) fn strict(&self) -> Self {
        Self { is_strict: true, ..self.clone() }
    }

    /// Whether a missing file or definition is an error instead of a remark.
    pub(super) const fn is_strict(&self) -> bool {
        self.is_strict
    }

    /// The path of the file to which a model file refers as `reference`: an image or a material library. All formats,
    /// programs and uploads share this rule:
    ///
    /// - A path relative to this folder that stays in the folder of the scene is read. The other paths are absolute, with
    ///   a drive or a scheme, or lead to a parent of the folder of the scene: nothing outside is read.
    /// - If no such file exists, a file of this path in other letter case is read, with a remark, or else a file in or
    ///   below this folder whose path is the longest end of `reference`: `C:\work\maps\a.png` is `maps/a.png` or `a.png`.
    /// - Otherwise, the result is `None`: the loader uses the stand-in that the remark names.
    ///
    /// A remark begins with `subject`.
    ///
    /// # Errors
    /// In strict mode, `Invalid` for a file that does not exist or has another path.
    pub(super) fn find_referenced(
        &self,
        reference: &str,
        subject: &str,
        stand_in: &str,
        remarks: &mut Vec<String>,
    ) -> Result<Option<String>> {
        let (path, reason) = match self.locate(reference) {
            ReferencedFile::Exact(path) => return Ok(Some(path)),
            ReferencedFile::Similar { path, reason } => (Some(path), reason),
            ReferencedFile::Missing { reason } => (None, reason),
        };
        if self.is_strict {
            let (expected, given) = match reason {
                OUTSIDE => ("a path in the folder of the scene", "a path outside of it".to_owned()),
                _ => match &path {
                    Some(path) => ("a file of exactly this path", format!("only '{path}'")),
                    None => ("an existing file", "none".to_owned()),
                },
            };
            return Err(invalid(field_of(reference), expected, format!("{given} (strict mode)")));
        }
        let advice = if reason == OUTSIDE { "; copy the file into this folder" } else { "" };
        let treatment = path.as_ref().map_or_else(|| format!("{stand_in}{advice}"), |path| format!("'{path}' is read"));
        remarks.push(format!("{subject} {reason}: {treatment}"));
        Ok(path)
    }

    /// As [`Self::find_referenced`], for an image. `None` also for an image that is not drawn because of its format.
    ///
    /// # Errors
    /// As for [`Self::find_referenced`] and [`Self::read_start`]; in strict mode, also for other formats than PNG, JPEG
    /// and WebP.
    pub(super) fn find_image(
        &self,
        reference: &str,
        subject: &str,
        stand_in: &str,
        remarks: &mut Vec<String>,
    ) -> Result<Option<String>> {
        let Some(path) = self.find_referenced(reference, subject, stand_in, remarks)? else { return Ok(None) };
        let start = self.read_start(&path, Texture::SIGNATURE_BYTES as u64)?;
        let unsupported = self.unsupported_image(&path, &start)?;
        remarks.extend(unsupported.map(|reason| format!("{subject} {reason}: {stand_in}")));
        Ok(unsupported.is_none().then_some(path))
    }

    /// Finds the file to which a model file refers by the rule of [`Self::find_referenced`], without access to files
    /// outside of the folder of the scene.
    pub(super) fn locate(&self, reference: &str) -> ReferencedFile {
        if reference.len() > MAX_REFERENCE_BYTES {
            return ReferencedFile::Missing { reason: MISSING };
        }
        let text = reference.replace('\\', "/");
        let (mut parents, mut names) = (0, Vec::new());
        for name in text.split('/').filter(|name| !matches!(*name, "" | ".")) {
            match name {
                ".." if names.pop().is_none() => parents += 1,
                ".." => {}
                name => names.push(name),
            }
        }
        let path = ReferencePath { parents, names: &names };
        let is_inside = !text.starts_with('/') && self.is_in_scene_folder(parents);
        if is_inside && self.has_file(&path.to_string()) {
            return ReferencedFile::Exact(path.to_string());
        }
        // `C:/`, `file:///` and `https://`.
        let has_prefix = text.split('/').next().is_some_and(|name| name.contains(':'));
        let reason = if is_inside && !has_prefix { MISSING } else { OUTSIDE };
        let first_start = names.len().saturating_sub(MAX_SEARCHED_NAMES);
        let ends = (first_start..names.len()).map(|start| ReferencePath { parents: 0, names: &names[start..] });
        let mut searches = is_inside.then_some(path).into_iter().chain(ends);
        match searches.find_map(|path| self.find_ignoring_case(path)) {
            Some(path) => ReferencedFile::Similar { path, reason },
            None => ReferencedFile::Missing { reason },
        }
    }

    /// Whether the parent of this folder of the given order is in the folder of the scene.
    fn is_in_scene_folder(&self, parents: usize) -> bool {
        let scene_folder = self.scene_folder.as_ref().unwrap_or(&self.base);
        self.base.ancestors().nth(parents).is_some_and(|parent| parent.starts_with(scene_folder))
    }

    /// The path of a file whose names equal those of `path` in any letter case.
    fn find_ignoring_case(&self, path: ReferencePath<'_>) -> Option<String> {
        let (file, folders) = path.names.split_last()?;
        let mut names = vec!["..".to_owned(); path.parents];
        let mut folder = if path.parents == 0 { self.clone() } else { self.within(&names.join("/")).ok()? };
        for name in folders {
            let name = folder.name_ignoring_case(name, EntryKind::Directory)?;
            folder = folder.within(&name).ok()?;
            names.push(name);
        }
        names.push(folder.name_ignoring_case(file, EntryKind::File)?);
        Some(names.join("/"))
    }

    /// The name of an entry of this folder that equals `name` in any letter case; `name` itself if there is an entry of
    /// this name.
    fn name_ignoring_case(&self, name: &str, kind: EntryKind) -> Option<String> {
        match self.kind(name) == Ok(Some(kind)) {
            true => Some(name.to_owned()),
            false => self.listing().names_ignoring_case(name, kind).next().map(str::to_owned),
        }
    }

    /// The reason why an image that starts with the bytes `start` is not drawn, worded as the middle of a remark. `None`
    /// for a PNG, JPEG or WebP image.
    ///
    /// # Errors
    /// In strict mode, `Invalid` for other formats than PNG, JPEG and WebP.
    pub(super) fn unsupported_image(&self, name: &str, start: &[u8]) -> Result<Option<&'static str>> {
        match (Texture::is_supported(start), self.is_strict) {
            (true, _) => Ok(None),
            (false, false) => Ok(Some("is no PNG, JPEG or WebP image")),
            (false, true) => Err(invalid(field_of(name), "a PNG, JPEG or WebP image", "another format (strict mode)")),
        }
    }

    /// The folder `relative`, with the same confinement.
    ///
    /// # Errors
    /// As for [`Self::resolve`].
    pub(super) fn within(&self, relative: &str) -> Result<Self> {
        Ok(Self { base: self.resolve(relative)?, ..self.clone() })
    }

    /// The folder `relative` of a scene or a model. A folder outside of the folder of the scene becomes the new folder of
    /// the scene, which paths in model files cannot leave.
    ///
    /// # Errors
    /// As for [`Self::resolve`].
    pub(super) fn within_scene(&self, relative: &str) -> Result<Self> {
        let folder = self.within(relative)?;
        let is_inside = folder.scene_folder.as_ref().is_some_and(|scene_folder| folder.base.starts_with(scene_folder));
        let scene_folder = if is_inside { folder.scene_folder } else { Some(folder.base.clone()) };
        Ok(Self { scene_folder, ..folder })
    }

    /// The folder to which paths are relative.
    pub(super) fn folder(&self) -> &Path {
        &self.base
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
    /// `Invalid` if the path is outside the root, does not exist, is not a regular file, is too large or unreadable, or
    /// if an uploaded file has changed.
    /// `OutOfMemory` if the memory of the scene is too small for it. The error contains the unresolved path, so that it
    /// does not reveal the location of the root.
    pub(super) fn read(&self, relative: &str, limit: u64) -> Result<FileContent> {
        let too_large = |size: u64| invalid(field_of(relative), format!("at most {limit} bytes"), size);
        let (path, file_bytes) = self.regular_file(relative)?;
        if file_bytes > limit {
            return Err(too_large(file_bytes));
        }
        let memory = self.reserve_temporary(&field_of(relative), file_bytes)?;
        // One byte more than the size, to notice a file that has grown.
        let bytes = self.read_start(relative, file_bytes + 1)?;
        if bytes.len() as u64 > file_bytes {
            return Err(unreadable(relative, &"a file that grows while it is read"));
        }
        self.check_hash(relative, &path, &bytes)?;
        Ok(FileContent { bytes, _memory: memory })
    }

    /// Verifies the content of the file with the canonical path `path`.
    fn check_hash(&self, relative: &str, path: &Path, content: &[u8]) -> Result<()> {
        let (Some(hashes), Some(root)) = (&self.hashes, &self.root) else { return Ok(()) };
        let path_in_root = path.strip_prefix(root).unwrap_or(path).to_string_lossy();
        hashes.check(&path_in_root, &field_of(relative), content)
    }

    /// Reads at most the first `count` bytes of a regular file, for which it allocates memory.
    ///
    /// # Errors
    /// As for [`Self::read`], except for the size.
    pub(super) fn read_start(&self, relative: &str, count: u64) -> Result<Vec<u8>> {
        let (file, _) = self.open(relative)?;
        // A list that grows would have up to twice the size of the file.
        let mut bytes = Vec::with_capacity(count as usize);
        file.take(count).read_to_end(&mut bytes).map_err(|error| unreadable(relative, &error.kind()))?;
        Ok(bytes)
    }

    /// Opens a regular file. Returns it with its size in bytes.
    ///
    /// # Errors
    /// As for [`Self::read`], except for the size.
    pub(super) fn open(&self, relative: &str) -> Result<(File, u64)> {
        let (path, file_bytes) = self.regular_file(relative)?;
        let file = File::open(&path).map_err(|error| unreadable(relative, &error.kind()))?;
        Ok((file, file_bytes))
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

    /// The kind of the path, or `None` if it does not exist. A path whose symbolic links leave the root does not exist,
    /// whether or not its target does, so that the answer reveals nothing about files outside the root.
    ///
    /// # Errors
    /// `Invalid` for a path whose own components leave the root.
    pub(super) fn kind(&self, relative: &str) -> Result<Option<EntryKind>> {
        self.join(relative)?;
        let Ok(path) = self.resolve(relative) else { return Ok(None) };
        Ok(if path.is_dir() { Some(EntryKind::Directory) } else { path.is_file().then_some(EntryKind::File) })
    }

    /// Names and kinds of the folder's direct entries. Reads at most [`MAX_ENTRIES`] entries, when the load first lists
    /// the folder.
    pub(super) fn listing(&self) -> Arc<FolderListing> {
        self.listings.get_or_list(&self.base, || FolderListing::new(self.read_entries()))
    }

    /// How often a folder was listed since the load began.
    #[cfg(test)]
    pub(super) fn listing_count(&self) -> usize {
        self.listings.count()
    }

    fn read_entries(&self) -> Vec<(String, EntryKind)> {
        let Ok(listing) = std::fs::read_dir(&self.base) else { return Vec::new() };
        let names = listing.take(MAX_ENTRIES).filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        names.filter_map(|name| self.kind(&name).ok().flatten().map(|kind| (name, kind))).collect()
    }

    /// Whether `relative` is a file.
    pub(super) fn has_file(&self, relative: &str) -> bool {
        self.kind(relative) == Ok(Some(EntryKind::File))
    }

    /// The canonical path of `relative`. A symbolic link that leaves the root has the same error as a missing file, so
    /// that the error does not reveal whether its target exists.
    ///
    /// # Errors
    /// `Invalid` if the path leaves the root or does not exist.
    pub(super) fn resolve(&self, relative: &str) -> Result<PathBuf> {
        let path = self.join(relative)?;
        let Some(root) = &self.root else {
            return path.canonicalize().map_err(|error| invalid(field_of(relative), "an existing file", error.kind()));
        };
        let canonical = path.canonicalize().ok().filter(|canonical| canonical.starts_with(root));
        canonical.ok_or_else(|| invalid(field_of(relative), "an existing file in the repository", "none of this name"))
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

impl std::fmt::Display for ReferencePath<'_> {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names = std::iter::repeat_n("..", self.parents).chain(self.names.iter().copied());
        formatter.write_str(&names.collect::<Vec<_>>().join("/"))
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
        std::os::unix::fs::symlink(outer.path().join("absent.txt"), root.join("dangling.txt"))
            .expect("a symbolic link");
        let files = AssetDir::confined_to(&root, &MemoryReservation::unlimited());
        let files = files.within("sub").expect("an existing folder");
        assert_eq!(files.read("../inside.txt", 6).expect("a file inside the root")[..], b"inside"[..]);
        assert_eq!(files.kind("../inside.txt"), Ok(Some(EntryKind::File)));
        let [secret, absent] = ["secret.txt", "absent.txt"].map(|name| outer.path().join(name).display().to_string());
        for path in ["../../secret.txt", "../../absent.txt", &secret, &absent] {
            let message = files.read(path, 100).expect_err(path).to_string();
            let expected = format!("file '{path}': expected a path inside the repository, got a path outside of it");
            assert_eq!(message, expected);
            assert_eq!(files.kind(path).expect_err(path).to_string(), expected);
        }
        // Links out of the root, to files that exist and that do not, and a file that does not exist in the root.
        let links = ["../link.txt", "../folder/secret.txt", "../dangling.txt", "../folder/absent.txt", "../none.txt"];
        for path in links {
            let message = files.read(path, 100).expect_err(path).to_string();
            let expected = format!("file '{path}': expected an existing file in the repository, got none of this name");
            assert_eq!(message, expected);
            assert_eq!(files.kind(path), Ok(None), "{path}");
        }
        assert_eq!(AssetDir::unrestricted(&root).read("../secret.txt", 100).expect("a file")[..], b"secret"[..]);
    }

    #[test]
    fn referenced_files_are_exact_then_similar_then_missing() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let root = folder.path().canonicalize().expect("an existing folder");
        std::fs::create_dir_all(root.join("scene/maps/deep")).expect("a new folder");
        for path in ["out.png", "scene/a.png", "scene/A.PNG", "scene/maps/a.png", "scene/maps/deep/b.png"] {
            std::fs::write(root.join(path), "").expect("a writable file");
        }
        let files = AssetDir::unrestricted(&root).within_scene("scene").expect("an existing folder");
        let in_maps = files.within_scene("maps").expect("an existing folder");
        let exact = |path: &str| ReferencedFile::Exact(path.to_owned());
        let similar = |path: &str, reason| ReferencedFile::Similar { path: path.to_owned(), reason };
        let missing = |reason| ReferencedFile::Missing { reason };
        let long_path = "a/".repeat(1 << 20);
        for (files, reference, expected) in [
            (&files, "maps//./a.png", exact("maps/a.png")),
            (&in_maps, "../a.png", exact("../a.png")),
            (&in_maps, "deep/../../maps/deep/b.png", exact("../maps/deep/b.png")),
            (&in_maps, "../Maps/Deep/B.png", similar("../maps/deep/b.png", MISSING)),
            // A name in other letter case is better than the end of the path, and `A.PNG` precedes `a.png`.
            (&files, "MAPS/a.png", similar("maps/a.png", MISSING)),
            (&files, "no/A.png", similar("A.PNG", MISSING)),
            (&files, "no/a.png", similar("a.png", MISSING)),
            (&files, "/no/maps/a.png", similar("maps/a.png", OUTSIDE)),
            (&in_maps, "../../out.png", missing(OUTSIDE)),
            (&in_maps, "../../scene/a.png", similar("a.png", OUTSIDE)),
            (&files, "maps", missing(MISSING)),
            (&files, "maps/", missing(MISSING)),
            (&files, "", missing(MISSING)),
            (&files, "/", missing(OUTSIDE)),
            (&files, "a.png\0", missing(MISSING)),
            (&files, long_path.as_str(), missing(MISSING)),
        ] {
            assert_eq!(files.locate(reference), expected, "{}", reference.get(..40).unwrap_or(reference));
        }
    }

    #[test]
    fn memory_of_a_file_is_reserved_until_it_is_dropped() {
        use crate::memory::{MemoryBudget, MemoryKind};
        let root = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(root.path().join("a.bin"), [0; 60]).expect("a writable file");
        let root = root.path().canonicalize().expect("an existing folder");
        let budget = MemoryBudget::new(MemoryKind::Host, 100, 100);
        let files = AssetDir::confined_to(&root, &MemoryReservation::new(&budget));
        let content = files.read("a.bin", 60).expect("a readable file");
        let message = files.read("a.bin", 60).expect_err("too little memory").to_string();
        let expected = "file 'a.bin': expected at most 40 bytes (host memory of one scene, in total 100), got 60";
        assert_eq!((message.as_str(), budget.reserved()), (expected, 60));
        drop(content);
        assert_eq!(budget.reserved(), 0);
        assert_eq!(files.read("a.bin", 60).expect("a readable file").into_bytes().len(), 60);
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
