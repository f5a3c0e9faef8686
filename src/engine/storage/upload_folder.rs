//! The temporary folder of an upload in progress. It moves to its final place when the upload is complete. Dropping it
//! earlier removes it in the background; [`UploadFolder::discard`] removes it before it returns.

use std::fs;
use std::mem;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::OwnedSemaphorePermit;

use modalcast_model::error::{Result, fault_in};

/// Number of uploads so far. Makes the names of temporary folders unique.
static UPLOAD_COUNTER: AtomicU64 = AtomicU64::new(0);

/// A temporary folder next to the finished uploads.
#[derive(Debug)]
pub(super) struct UploadFolder {
    /// Empty after the folder was moved or removed.
    path: PathBuf,
    /// Counts against the limit on concurrent uploads until the folder is moved or removed.
    permit: Option<OwnedSemaphorePermit>,
}

impl UploadFolder {
    /// Creates a folder in the folder `uploads`. Its name starts with a dot, which no scene name does.
    ///
    /// # Errors
    /// `Fault` of the disk.
    pub(super) fn create(uploads: &Path, scene: &str, permit: OwnedSemaphorePermit) -> Result<Self> {
        let count = UPLOAD_COUNTER.fetch_add(1, Ordering::Relaxed);
        let path = uploads.join(format!(".{scene}-{count}"));
        fs::create_dir_all(&path).map_err(fault_in("upload"))?;
        Ok(Self { path, permit: Some(permit) })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Moves the folder to `target_folder`. Replaces the earlier upload in that folder.
    ///
    /// # Errors
    /// `Fault` of the disk.
    pub(super) fn move_to(mut self, target_folder: &Path) -> Result<()> {
        if target_folder.exists() {
            fs::remove_dir_all(target_folder).map_err(fault_in("upload"))?;
        }
        fs::rename(&self.path, target_folder).map_err(fault_in("upload"))?;
        self.path = PathBuf::new();
        Ok(())
    }

    /// Removes the folder. Blocks on the disk.
    pub(super) fn discard(mut self) {
        fs::remove_dir_all(mem::take(&mut self.path)).ok(); // The next start removes leftovers.
    }
}

impl Drop for UploadFolder {
    /// Removes the folder. On a thread of a tokio runtime, removes it on the blocking pool.
    fn drop(&mut self) {
        let folder = mem::take(&mut self.path);
        if folder.as_os_str().is_empty() {
            return;
        }
        let permit = self.permit.take();
        let remove = move || {
            fs::remove_dir_all(folder).ok(); // The next start removes leftovers.
            drop(permit);
        };
        match tokio::runtime::Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(remove)),
            Err(_) => remove(),
        }
    }
}
