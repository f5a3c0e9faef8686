//! The folder in which a target writes its files. Targets include this file by its path.

use std::path::Path;

/// A temporary folder in memory, where the system has one.
///
/// # Panics
/// If there is no writable folder.
pub(crate) fn temporary_folder() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
    folder.expect("expected a writable folder")
}
