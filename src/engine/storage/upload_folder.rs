//! The temporary folder of an upload in progress. It moves to its final place when the upload is complete. Dropping it
//! earlier removes it in the background; [`UploadFolder::discard`] removes it before it returns.

use std::mem;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::file_system::FileSystem;
use crate::admission::{Account, PermitHandle};
use crate::engine::upload_permits::UploadPermit;
use modalcast_model::error::{Result, fault, fault_in};

/// Number of uploads so far. Makes the names of temporary folders unique.
static UPLOAD_COUNTER: AtomicU64 = AtomicU64::new(0);

/// A temporary folder next to the finished uploads.
#[derive(Debug)]
pub(super) struct UploadFolder {
    file_system: Arc<dyn FileSystem>,
    /// Empty after the folder was moved or removed.
    path: PathBuf,
    /// Counts against the limits on uploads until the folder is moved or removed.
    permit: Option<UploadPermit>,
}

impl UploadFolder {
    /// Creates a folder in the folder `uploads`. Its name starts with a dot, which no scene name does.
    ///
    /// # Errors
    /// `Fault` of the disk.
    pub(super) fn create(
        uploads: &Path,
        file_system: &Arc<dyn FileSystem>,
        scene: &str,
        permit: UploadPermit,
    ) -> Result<Self> {
        let count = UPLOAD_COUNTER.fetch_add(1, Ordering::Relaxed);
        let path = uploads.join(format!(".{scene}-{count}"));
        file_system.create_folder(&path).map_err(fault_in("upload"))?;
        Ok(Self { file_system: Arc::clone(file_system), path, permit: Some(permit) })
    }

    pub(super) fn file_system(&self) -> &dyn FileSystem {
        &*self.file_system
    }

    /// The permit of the upload. `None` after the folder was moved or removed.
    pub(super) fn permit(&self) -> Option<&PermitHandle> {
        self.permit.as_ref().map(|permit| permit.upload.handle())
    }

    /// The client that uploads.
    pub(super) fn account(&self) -> Option<&Account> {
        self.permit.as_ref().map(|permit| &permit.account)
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Makes all files durable.
    ///
    /// # Errors
    /// `Fault` of the disk.
    pub(super) fn sync(&self) -> Result<()> {
        self.file_system.sync_tree(&self.path).map_err(fault_in("upload"))
    }

    /// Moves the folder to `target_folder`, also beyond a power loss. Replaces the earlier upload in that folder.
    ///
    /// # Errors
    /// `Fault` of the disk.
    pub(super) fn move_to(mut self, target_folder: &Path) -> Result<()> {
        let uploads =
            target_folder.parent().ok_or_else(|| fault("upload", "expected a folder of uploads, got none"))?;
        if target_folder.exists() {
            self.file_system.remove_folder(target_folder).map_err(fault_in("upload"))?;
        }
        self.file_system.rename(&self.path, target_folder).map_err(fault_in("upload"))?;
        self.path = PathBuf::new();
        self.file_system.sync_folder(uploads).map_err(fault_in("upload"))
    }

    /// Removes the folder. Blocks on the disk.
    pub(super) fn discard(mut self) {
        self.file_system.remove_folder(&mem::take(&mut self.path)).ok(); // The next start removes leftovers.
    }
}

impl Drop for UploadFolder {
    /// Removes the folder. On a thread of a tokio runtime, removes it on the blocking pool.
    fn drop(&mut self) {
        let folder = mem::take(&mut self.path);
        if folder.as_os_str().is_empty() {
            return;
        }
        let (file_system, permit) = (Arc::clone(&self.file_system), self.permit.take());
        let remove = move || {
            file_system.remove_folder(&folder).ok(); // The next start removes leftovers.
            drop(permit);
        };
        match tokio::runtime::Handle::try_current() {
            Ok(runtime) => drop(runtime.spawn_blocking(remove)),
            Err(_) => remove(),
        }
    }
}
