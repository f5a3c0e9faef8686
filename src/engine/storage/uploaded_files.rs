//! The hashes of uploaded files: one list per uploaded scene, so that clients need not send files that the server
//! already has. A list may be missing or outdated: the hash of a file is verified before it is reused, so a wrong list
//! costs only an upload of the content. A list is removed with its scene. The server stores no content other than that
//! of open scenes.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io;
use std::path::PathBuf;

use super::atomic_file::write_atomic;
use crate::engine::content::{ContentHash, hex};

/// Paths of uploaded files by their hashes. Several files can have equal content.
pub(in crate::engine) type UploadedFiles = HashMap<ContentHash, Vec<PathBuf>>;

/// The lists of hashes, in a folder next to the folder of the uploads.
#[derive(Debug, Clone)]
pub(in crate::engine) struct HashLists {
    /// One JSON file per uploaded scene: hexadecimal hashes by the paths of the files.
    folder: PathBuf,
    /// One folder per uploaded scene.
    uploads: PathBuf,
}

impl HashLists {
    pub(in crate::engine) const fn new(folder: PathBuf, uploads: PathBuf) -> Self {
        Self { folder, uploads }
    }

    fn path(&self, scene: &str) -> PathBuf {
        self.folder.join(format!("{scene}.json"))
    }

    /// Writes the list of a scene.
    pub(in crate::engine) fn write(&self, scene: &str, hashes: &BTreeMap<String, ContentHash>) -> io::Result<()> {
        let hex_by_path: BTreeMap<&str, String> =
            hashes.iter().map(|(path, hash)| (path.as_str(), hex(hash))).collect();
        fs::create_dir_all(&self.folder)?;
        write_atomic(&self.path(scene), &serde_json::to_vec(&hex_by_path)?)
    }

    /// Removes the list of a scene, if there is one.
    pub(in crate::engine) fn remove(&self, scene: &str) {
        fs::remove_file(self.path(scene)).ok(); // Without the scene's files, the list finds nothing.
    }

    /// Reads all lists. Leaves out unreadable lists and files that no longer exist. Removes lists of scenes without a
    /// folder, which a server leaves behind if it is killed while it deletes a scene.
    pub(in crate::engine) fn read(&self) -> UploadedFiles {
        let mut files = UploadedFiles::new();
        for entry in fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let list_path = entry.path();
            let Some(scene) = list_path.file_stem().filter(|_| list_path.extension().is_some_and(|end| end == "json"))
            else {
                continue;
            };
            if !self.uploads.join(scene).is_dir() {
                fs::remove_file(&list_path).ok(); // The next call tries again.
                continue;
            }
            let bytes = fs::read(&list_path).unwrap_or_default();
            let Ok(hex_by_path) = serde_json::from_slice::<BTreeMap<String, String>>(&bytes) else { continue };
            for (path, digits) in hex_by_path {
                let path = self.uploads.join(scene).join(path);
                if let Some(hash) = parse_hex(&digits).filter(|_| path.is_file()) {
                    files.entry(hash).or_default().push(path);
                }
            }
        }
        files
    }
}

fn parse_hex(digits: &str) -> Option<ContentHash> {
    let mut hash = ContentHash::default();
    if digits.len() != 2 * hash.len() {
        return None;
    }
    for (index, byte) in hash.iter_mut().enumerate() {
        *byte = u8::from_str_radix(digits.get(2 * index..2 * index + 2)?, 16).ok()?;
    }
    Some(hash)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_find_only_files_that_exist() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let uploads = folder.path().join("uploads");
        let lists = HashLists::new(folder.path().join("lists"), uploads.clone());
        assert!(lists.read().is_empty());
        fs::create_dir_all(uploads.join("a.b")).expect("expected a new folder");
        fs::write(uploads.join("a.b/x"), b"content").expect("expected a written file");
        let hashes = [("x".to_owned(), [1; 32]), ("gone".to_owned(), [2; 32])].into();
        lists.write("a.b", &hashes).expect("expected a written list");
        fs::create_dir_all(uploads.join("damaged")).expect("expected a new folder");
        for list in ["lists/damaged.json", "lists/removed.json"] {
            fs::write(folder.path().join(list), b"{").expect("expected a written file");
        }
        assert_eq!(lists.read(), [([1; 32], vec![uploads.join("a.b/x")])].into());
        let names = fs::read_dir(folder.path().join("lists")).expect("expected a folder").count();
        assert_eq!(names, 2, "expected the list without a folder of files to be removed");
        lists.remove("a.b");
        assert!(lists.read().is_empty());
    }

    #[test]
    fn only_complete_hexadecimal_hashes_are_parsed() {
        assert_eq!(parse_hex(&hex(&[0xa7; 32])), Some([0xa7; 32]));
        for digits in ["", "a7", &"g0".repeat(32), &"é".repeat(32)] {
            assert_eq!(parse_hex(digits), None, "{digits}");
        }
    }
}
