//! The operations that change the state folder, as a trait: a test records them and restarts from every prefix, and another
//! one lets them fail as on a full disk. Files are read with `std::fs`.

use std::fmt::Debug;
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

/// The largest number of files and folders that are synced one after another. Each waits for the disk. More are synced
/// by one call for their whole file system, which also writes the files of other programs.
const MAX_SINGLE_SYNCS: usize = 64;

/// Permissions of the folders and files of the server: only its user can read them.
const FOLDER_MODE: u32 = 0o700;
const FILE_MODE: u32 = 0o600;

/// Changes files and folders.
pub(in crate::engine) trait FileSystem: Debug + Send + Sync {
    /// Creates a folder and those above it, unless they exist.
    fn create_folder(&self, path: &Path) -> io::Result<()>;

    /// Creates an empty file. Replaces an existing one unless `is_new`, which makes it an error.
    fn create_file(&self, path: &Path, is_new: bool) -> io::Result<Box<dyn StateFile>>;

    /// Makes the names in a folder durable: all files and folders that were created, renamed or removed in it.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;

    /// Makes everything below a folder durable: the content of all files, and the names in all folders.
    fn sync_tree(&self, path: &Path) -> io::Result<()>;

    /// Renames a file, replacing the file `to`, or a folder.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    fn remove_file(&self, path: &Path) -> io::Result<()>;

    /// Removes a folder with its content.
    fn remove_folder(&self, path: &Path) -> io::Result<()>;
}

/// A file that is written.
pub(in crate::engine) trait StateFile: Write + Debug + Send {
    /// Makes the content durable.
    fn sync(&mut self) -> io::Result<()>;
}

/// The file system of the machine.
#[derive(Debug)]
pub(in crate::engine) struct DiskFileSystem;

impl FileSystem for DiskFileSystem {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        fs::DirBuilder::new().recursive(true).mode(FOLDER_MODE).create(path)
    }

    fn create_file(&self, path: &Path, is_new: bool) -> io::Result<Box<dyn StateFile>> {
        let mut options = File::options();
        options.write(true).mode(FILE_MODE);
        let options = if is_new { options.create_new(true) } else { options.create(true).truncate(true) };
        Ok(Box::new(options.open(path)?))
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }

    fn sync_tree(&self, path: &Path) -> io::Result<()> {
        let paths = paths_below(path)?;
        if paths.len() > MAX_SINGLE_SYNCS {
            return Ok(rustix::fs::syncfs(File::open(path)?)?);
        }
        // On Linux, any descriptor of a file syncs all that was written to the file.
        paths.iter().try_for_each(|path| File::open(path)?.sync_all())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir_all(path)
    }
}

impl StateFile for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// Replaces a file atomically: writes a temporary file in the same folder, syncs it, renames it, and syncs the folder.
/// Readers see either the old or the new content, also after a power failure.
pub(super) fn write_atomic(file_system: &dyn FileSystem, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let temporary = path.with_extension("new");
    let mut file = file_system.create_file(&temporary, false)?;
    file.write_all(bytes)?;
    // Without this sync, a power failure after the rename could leave an empty file at `path`.
    file.sync()?;
    drop(file);
    file_system.rename(&temporary, path)?;
    path.parent().map_or(Ok(()), |folder| file_system.sync_folder(folder))
}

/// Removes the permissions of other users from a folder and everything below it, which earlier servers may have granted.
pub(super) fn make_private(folder: &Path) -> io::Result<()> {
    for path in paths_below(folder)? {
        let metadata = fs::symlink_metadata(&path)?;
        // The target of a link may be outside of the folder.
        if metadata.is_symlink() || metadata.mode() & 0o077 == 0 {
            continue;
        }
        let mode = if metadata.is_dir() { FOLDER_MODE } else { FILE_MODE };
        fs::set_permissions(&path, fs::Permissions::from_mode(mode))?;
    }
    Ok(())
}

/// All files and folders below a folder, and last the folder itself.
pub(super) fn paths_below(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        match entry.file_type()?.is_dir() {
            true => paths.append(&mut paths_below(&entry.path())?),
            false => paths.push(entry.path()),
        }
    }
    paths.push(folder.to_owned());
    Ok(paths)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_earlier_servers_become_private() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let outside = tempfile::NamedTempFile::new().expect("expected a temporary file");
        let set_mode = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).expect("expected new permissions");
        };
        let mode = |path: &Path| fs::metadata(path).expect("expected a file").mode() & 0o777;
        let (subfolder, file, link) =
            (folder.path().join("a"), folder.path().join("a").join("b"), folder.path().join("link"));
        fs::create_dir(&subfolder).expect("expected a new folder");
        fs::write(&file, "x").expect("expected a written file");
        std::os::unix::fs::symlink(outside.path(), &link).expect("expected a link");
        for (path, permissions) in [(outside.path(), 0o644), (&file, 0o644), (&subfolder, 0o755)] {
            set_mode(path, permissions);
        }
        make_private(folder.path()).expect("expected changed permissions");
        assert_eq!((mode(&subfolder), mode(&file), mode(folder.path())), (0o700, 0o600, 0o700));
        assert_eq!(mode(outside.path()), 0o644, "expected the target of the link to be unchanged");
        let (new_folder, new_file) = (subfolder.join("c").join("d"), subfolder.join("e"));
        DiskFileSystem.create_folder(&new_folder).expect("expected a new folder");
        DiskFileSystem.create_file(&new_file, true).expect("expected a new file");
        assert_eq!((mode(&new_folder), mode(&new_file)), (0o700, 0o600));
    }
}
