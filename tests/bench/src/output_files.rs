//! Writes the files of a report.

use std::path::Path;

use modalcast_model::error::{Result, fault_in};

/// Writes files into a folder, which is created. Each file is written under a temporary name and then renamed, so that
/// files with the final names are complete.
///
/// # Errors
/// `Fault` when a file cannot be written.
pub(crate) fn write_files<'a>(folder: &Path, files: impl IntoIterator<Item = (&'a str, Vec<u8>)>) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(fault_in("report"))?;
    for (name, bytes) in files {
        let (path, temporary_path) = (folder.join(name), folder.join(format!("{name}.part")));
        std::fs::write(&temporary_path, bytes)
            .and_then(|()| std::fs::rename(&temporary_path, path))
            .map_err(fault_in("report"))?;
    }
    Ok(())
}
