//! The registry of scenes by name. A name is reserved before its scene is loaded, so that concurrent openings of one
//! name share one load.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use tokio::sync::OnceCell;

use super::lock::lock;
use super::scene_not_open;
use crate::engine::device::command::SceneId;
use crate::engine::scene::handle::SceneHandle;
use crate::engine::storage::scene_catalog::SceneProvenance;
use modalcast_model::error::{Error, Result};

/// A reserved name, and its scene once the scene is loaded.
pub(super) struct RegistryEntry {
    provenance: SceneProvenance,
    cell: OnceCell<Arc<SceneHandle>>,
    /// Number of concurrent openings; modified only under the registry's lock.
    open_calls: AtomicUsize,
}

impl RegistryEntry {
    /// Returns the scene. The first caller loads it while the others wait. If the load fails, the next caller retries
    /// it.
    ///
    /// # Errors
    /// The error of `load`; `Busy` when the scene is being closed.
    pub(super) async fn get_or_open<F>(&self, load: impl FnOnce() -> F) -> Result<Arc<SceneHandle>>
    where
        F: Future<Output = Result<Arc<SceneHandle>>>,
    {
        let scene_handle = self.cell.get_or_try_init(load).await?;
        match scene_handle.is_closing() {
            false => Ok(Arc::clone(scene_handle)),
            true => Err(Error::Busy { queue: "queue for a scene that is being closed", limit: 1 }),
        }
    }

    /// The scene; `None` while it is not loaded.
    pub(super) fn scene_handle(&self) -> Option<&Arc<SceneHandle>> {
        self.cell.get()
    }
}

/// All reserved names.
pub(super) struct Registry {
    max_scenes: usize,
    entries: Mutex<BTreeMap<String, Arc<RegistryEntry>>>,
}

impl Registry {
    pub(super) const fn new(max_scenes: usize) -> Self {
        Self { max_scenes, entries: Mutex::new(BTreeMap::new()) }
    }

    /// Reserves a name for a call that opens it, or joins an existing reservation with the same provenance. With
    /// `must_be_new` an existing reservation is an error. The call ends with [`Self::release`].
    ///
    /// # Errors
    /// `NameTaken` when the name is reserved for another provenance, `LimitReached` when too many scenes are open.
    pub(super) fn reserve(
        &self,
        name: &str,
        provenance: &SceneProvenance,
        must_be_new: bool,
    ) -> Result<Arc<RegistryEntry>> {
        let mut entries = self.lock();
        if let Some(entry) = entries.get(name) {
            return match !must_be_new && entry.provenance == *provenance {
                true => {
                    entry.open_calls.fetch_add(1, Ordering::Relaxed);
                    Ok(Arc::clone(entry))
                }
                false => Err(name_taken_error(name, entry)),
            };
        }
        if entries.len() >= self.max_scenes {
            return Err(Error::LimitReached { objects: "open scenes", limit: self.max_scenes });
        }
        let entry = Arc::new(RegistryEntry {
            provenance: provenance.clone(),
            cell: OnceCell::new(),
            open_calls: AtomicUsize::new(1),
        });
        entries.insert(name.to_owned(), Arc::clone(&entry));
        Ok(entry)
    }

    /// Checks that the name is free.
    ///
    /// # Errors
    /// `NameTaken` when the name is reserved.
    pub(super) fn check_name_free(&self, name: &str) -> Result<()> {
        self.lock().get(name).map_or(Ok(()), |entry| Err(name_taken_error(name, entry)))
    }

    pub(super) fn find_entry(&self, name: &str) -> Option<Arc<RegistryEntry>> {
        self.lock().get(name).cloned()
    }

    /// The open scene with this name.
    ///
    /// # Errors
    /// `NotFound` when the scene is not loaded or is being closed.
    pub(super) fn find(&self, name: &str) -> Result<Arc<SceneHandle>> {
        let entries = self.lock();
        let scene_handle =
            entries.get(name).and_then(|entry| entry.scene_handle()).filter(|scene_handle| !scene_handle.is_closing());
        scene_handle.cloned().ok_or_else(|| scene_not_open(name))
    }

    /// The open scenes, sorted by name.
    pub(super) fn list(&self) -> Vec<Arc<SceneHandle>> {
        self.lock()
            .values()
            .filter_map(|entry| entry.scene_handle().cloned())
            .filter(|scene_handle| !scene_handle.is_closing())
            .collect()
    }

    /// Ends one call that opens the name. The last such call releases the name if no scene was loaded.
    pub(super) fn release(&self, name: &str, entry: &Arc<RegistryEntry>) {
        let mut entries = self.lock();
        let is_last = entry.open_calls.fetch_sub(1, Ordering::Relaxed) == 1;
        if is_last && entry.scene_handle().is_none() {
            entries.remove(name);
        }
    }

    /// Releases the name of a closed scene unless another opening has reserved it since.
    pub(super) fn remove(&self, name: &str, entry: &Arc<RegistryEntry>) {
        let mut entries = self.lock();
        if entries.get(name).is_some_and(|registered| Arc::ptr_eq(registered, entry)) {
            entries.remove(name);
        }
    }

    /// Releases the name of a scene that has failed.
    pub(super) fn remove_scene(&self, name: &str, id: SceneId) {
        let mut entries = self.lock();
        if entries.get(name).and_then(|entry| entry.scene_handle()).is_some_and(|registered| registered.id() == id) {
            entries.remove(name);
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Arc<RegistryEntry>>> {
        lock(&self.entries)
    }
}

fn name_taken_error(name: &str, entry: &RegistryEntry) -> Error {
    Error::NameTaken { name: name.into(), owner: entry.provenance.label() }
}
