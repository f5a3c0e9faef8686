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

/// A folder whose files a loader may read. With a `root`, every path must stay inside the root after symbolic links are
/// resolved. Without a `root`, any path is allowed.
#[derive(Debug, Clone)]
pub(super) struct AssetDir {
    /// The folder to which paths are relative.
    base: PathBuf,
    root: Option<PathBuf>,
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
        Self { base: base.to_path_buf(), root, is_strict: false, memory, listings: Arc::default(), hashes: None }
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
    /// PNG, JPEG or WebP image.
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
