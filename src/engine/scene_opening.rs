//! Opens and closes scenes: reserves a name, reads the files and the checkpoint, starts the scene's task, and updates the
//! catalog and the registry.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use tokio::sync::oneshot;

use super::blocking::run_blocking;
use super::device::command::SceneId;
use super::registry::{OpenRequest, RegistryEntry};
use super::running_scene::{SceneName, run_as};
use super::scene::handle::{OpenParams, SceneHandle};
use super::scene_memory::SceneMemory;
use super::source::StoredUpload;
use super::storage::provenance::SceneProvenance;
use super::storage::scene_catalog::folder_bytes;
use super::storage::scene_record::{SceneAccess, SceneRecord};
use super::storage::upload::CompleteUpload;
use super::storage::upload_record::read_hashes;
use super::{Engine, scene_not_open};
use crate::admission::{Account, Client};
use crate::identity::Principal;
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::load::{OpenedScene, modes_files};

/// The largest number of modes files, and of remarks, that are logged when a scene is opened.
const MAX_LOGGED_LINES: usize = 16;

impl Engine {
    /// Reserves the names of the scenes of the catalog, and reopens the scenes in the background. A scene that cannot
    /// be opened is logged, and its entry remains in the catalog, because its files may be available again at the next
    /// start. A scene that the crash log sets aside is not opened.
    pub(super) fn reopen_scenes(&self) {
        let mut openings = tokio::task::JoinSet::new();
        for (name, record) in self.shared.scene_catalog.entries() {
            if let Some(error) = self.shared.crash_log.reason(&name) {
                tracing::warn!(scene = name, %error, "a scene of the last run is set aside");
                self.shared.registry.record_failure(&name, &record, error);
                continue;
            }
            let account = Account { principal: Some(record.access.owner.as_str().into()), client: Client::Server };
            let request = OpenRequest { is_reopened: true, ..self.open_request(&name, &record, account) };
            let reserved = self.shared.registry.reserve(&request, &Principal::owner(), false);
            let engine = self.clone();
            openings.spawn(async move { engine.reopen_scene(reserved, &name, &record).await });
        }
        let engine = self.clone();
        tokio::spawn(async move {
            while openings.join_next().await.is_some() {}
            engine.shared.are_scenes_reopened.send_replace(true);
        });
    }

    async fn reopen_scene(&self, reserved: Result<Arc<RegistryEntry>>, name: &str, record: &SceneRecord) {
        let record_failure = |error: &Error| {
            tracing::warn!(scene = name, %error, "a scene of the last run could not be reopened");
            self.shared.registry.record_failure(name, record, error.clone());
        };
        match reserved {
            Err(error) => record_failure(&error),
            Ok(entry) => {
                let open = async || {
                    self.check_running()?;
                    self.open_or_discard(name.to_owned(), record.provenance.clone(), &entry, None).await
                };
                let opened = entry.get_or_open(open).await;
                // `end_opening` records the failure of a loaded scene. The failure of an opening is recorded before the
                // name is released, so that a list always contains the scene.
                if let Err(error) = opened
                    && entry.scene_handle().is_none()
                {
                    record_failure(&error);
                }
                self.end_opening(name, &entry);
            }
        }
    }

    pub(super) fn open_request(&self, name: &str, record: &SceneRecord, account: Account) -> OpenRequest {
        let is_built_in = matches!(&record.provenance, SceneProvenance::Repository { source } if self.shared.source.is_built_in(source));
        OpenRequest { name: name.to_owned(), record: record.clone(), account, is_reopened: false, is_built_in }
    }

    /// Opens a scene of the repository. Concurrent calls with the same name share one opening. The opening runs in a
    /// separate task, so that a cancelled caller does not cancel the opening.
    pub(super) async fn open_once(
        &self,
        name: String,
        record: SceneRecord,
        principal: &Principal,
        account: Account,
    ) -> Result<Arc<SceneHandle>> {
        self.check_running()?;
        let (engine, principal) = (self.clone(), principal.clone());
        let work = async move {
            let request = engine.open_request(&name, &record, account);
            let entry = engine.shared.registry.reserve(&request, &principal, false)?;
            engine.open_reserved(&entry, name, record.provenance, None).await
        };
        tokio::spawn(work).await.map_err(fault_in("open"))?
    }

    /// Opens a complete upload as a new scene of `principal`. If the caller is cancelled, the scene is closed and its files are removed:
    /// the caller does not know the scene, and could not upload it again under the same name.
    pub(super) async fn open_upload(&self, upload: CompleteUpload, principal: &Principal) -> Result<Arc<SceneHandle>> {
        self.check_running()?;
        self.check_replacement(&upload.scene, principal)?;
        let (engine, principal) = (self.clone(), principal.clone());
        // Dropped together with this future.
        let (caller, _waits) = oneshot::channel::<()>();
        let work = async move {
            let name = upload.scene.clone();
            let account = upload.account().cloned().unwrap_or_else(|| Account::new(&principal, Client::Server));
            let provenance = SceneProvenance::Upload { entry: upload.entry.clone() };
            let record = SceneRecord { provenance, access: SceneAccess::new(&principal) };
            let request = engine.open_request(&name, &record, account);
            let entry = engine.shared.registry.reserve(&request, &principal, true)?;
            let opened = engine.open_reserved(&entry, name.clone(), record.provenance, Some(upload)).await;
            if opened.is_ok() && caller.is_closed() {
                tracing::info!(scene = name, "the caller of an upload has gone; the scene is closed");
                engine.close_scene(&name).await?;
            }
            opened
        };
        tokio::spawn(work).await.map_err(fault_in("open"))?
    }

    /// Opens a scene whose name is reserved for this call.
    async fn open_reserved(
        &self,
        entry: &Arc<RegistryEntry>,
        name: String,
        provenance: SceneProvenance,
        upload: Option<CompleteUpload>,
    ) -> Result<Arc<SceneHandle>> {
        let opened = entry.get_or_open(|| self.open_or_discard(name.clone(), provenance, entry, upload)).await;
        self.end_opening(&name, entry);
        opened
    }

    /// Ends a call that opens a scene.
    pub(super) fn end_opening(&self, name: &str, entry: &Arc<RegistryEntry>) {
        self.shared.registry.release(name, entry);
        // The scene may have failed before the registry had its handle. Then the callback for failures did nothing.
        if let Some(scene_handle) = entry.scene_handle()
            && scene_handle.failure().is_some()
        {
            self.shared.registry.remove_failed_scene(name, scene_handle.id());
        }
    }

    /// Loads a scene. If that fails, removes the files of a new upload.
    async fn open_or_discard(
        &self,
        name: String,
        provenance: SceneProvenance,
        entry: &RegistryEntry,
        upload: Option<CompleteUpload>,
    ) -> Result<Arc<SceneHandle>> {
        let is_new_upload = upload.is_some();
        let result = self.load_scene(&name, &provenance, entry, upload).await;
        if result.is_err() && is_new_upload {
            let engine = self.clone();
            let remove = move || {
                engine.shared.scene_catalog.remove_upload(&name);
                engine.shared.upload_permits.remove(&name);
                Ok(())
            };
            run_blocking("upload", remove).await?;
        }
        result.map(Arc::new)
    }

    /// Reads a scene's files and its checkpoint, starts its task and adds it to the catalog.
    async fn load_scene(
        &self,
        name: &str,
        provenance: &SceneProvenance,
        entry: &RegistryEntry,
        upload: Option<CompleteUpload>,
    ) -> Result<SceneHandle> {
        let access = entry.access();
        let memory = self.shared.memory.new_scene(&access.borrow().owner);
        let is_built_in =
            matches!(provenance, SceneProvenance::Repository { source } if self.shared.source.is_built_in(source));
        let loads = if is_built_in { &self.shared.built_in_loads } else { &self.shared.loads };
        let turn = loads.member(entry.account()).acquire(1).await?;
        let OpenedScene { scene, backends } = self.read_scene_files(name, provenance, upload, &memory).await?;
        drop(turn);
        memory.reserve_loaded(name, &scene)?;
        let (engine, scene_name, shared_scene) = (self.clone(), name.to_owned(), Arc::clone(&scene));
        let restored_state =
            run_blocking("checkpoint", move || Ok(engine.shared.services.checkpoints.load(&scene_name, &shared_scene)))
                .await?;
        let restored_state = restored_state.unwrap_or_else(|error| {
            tracing::warn!(scene = name, %error, "the checkpoint could not be loaded; the scene starts at rest");
            None
        });
        if let Some(state) = &restored_state {
            self.shared.services.run_counter.continue_after(state.run);
        }
        let id = self.shared.next_scene_id.fetch_add(1, Ordering::Relaxed);
        let params = OpenParams {
            name: name.into(),
            provenance: provenance.clone(),
            access: Arc::clone(access),
            scene,
            backends,
            id,
            state: restored_state,
            on_failure: self.failure_callback(name, id),
            frames_unavailable: self.shared.info.renderer.as_ref().err().cloned(),
            memory,
        };
        let scene_handle = SceneHandle::open(params, self.shared.services.clone()).await?;
        let (engine, scene_name) = (self.clone(), name.to_owned());
        let record = SceneRecord { provenance: provenance.clone(), access: access.borrow().clone() };
        if let Err(error) =
            run_blocking("scenes.json", move || engine.shared.scene_catalog.add(&scene_name, &record)).await
        {
            scene_handle.stop(error.clone()).await;
            return Err(error);
        }
        let layout = &scene_handle.scene.layout;
        let modes = modes_files(&scene_handle.scene);
        let modes = modes.iter().take(MAX_LOGGED_LINES).map(String::as_str).collect::<Vec<_>>().join(", ");
        tracing::info!(scene = name, domains = layout.domains.len(), vertices = layout.vertices, modes, "opened");
        for remark in scene_handle.scene.remarks.iter().take(MAX_LOGGED_LINES) {
            tracing::warn!(scene = name, remark, "remark of the loader");
        }
        let remark_count = scene_handle.scene.remarks.len();
        if remark_count > MAX_LOGGED_LINES {
            tracing::warn!(scene = name, remarks = remark_count, "only the first remarks are logged");
        }
        Ok(scene_handle)
    }

    /// Creates the callback for the failure of a scene. It removes the scene from the registry. The catalog keeps the
    /// scene, so that the next start opens it again. The callback holds a weak reference to the engine.
    fn failure_callback(&self, name: &str, id: SceneId) -> Box<dyn FnOnce() + Send> {
        let (shared, name) = (Arc::downgrade(&self.shared), name.to_owned());
        Box::new(move || {
            if let Some(shared) = shared.upgrade() {
                shared.registry.remove_failed_scene(&name, id);
            }
        })
    }

    /// Reads a scene's files. First moves the files of a new `upload` to the upload folder. A panic in a loader becomes
    /// a `Fault` of this call.
    async fn read_scene_files(
        &self,
        name: &str,
        provenance: &SceneProvenance,
        upload: Option<CompleteUpload>,
        memory: &SceneMemory,
    ) -> Result<OpenedScene> {
        let memory = Arc::clone(&memory.host);
        let source = Arc::clone(&self.shared.source);
        let upload_folder = self.shared.scene_catalog.upload_folder(name);
        let (engine, scene_name, provenance) = (self.clone(), name.to_owned(), provenance.clone());
        let read = move || match provenance {
            SceneProvenance::Repository { source: path } => source.open(&path, &memory),
            SceneProvenance::Upload { entry } => {
                if let Some(upload) = upload {
                    // A checkpoint and crashes of an older scene with this name do not apply to the new one.
                    engine.shared.services.checkpoints.remove(&scene_name);
                    engine.shared.crash_log.forget(&scene_name);
                    let account = upload.account().cloned();
                    upload.commit(&upload_folder)?;
                    if let Some(account) = account {
                        let bytes = folder_bytes(&upload_folder);
                        engine.shared.upload_permits.store(&scene_name, account.principal, bytes);
                    }
                }
                let hashes = Arc::new(read_hashes(&upload_folder)?);
                source.open_upload(&StoredUpload { folder: upload_folder, entry, hashes }, &memory)
            }
        };
        let (crash_log, scene_name) = (Arc::clone(&self.shared.crash_log), name.to_owned());
        let load = move || {
            // Before the files are read, so that a crash meanwhile counts.
            crash_log.readmit(&scene_name);
            run_as(SceneName::new(&scene_name), read).map_err(Error::into_file_error)
        };
        run_blocking("load", load).await
    }

    /// Stops a scene and removes its checkpoint, its uploaded files, its catalog entry and its name.
    pub(super) async fn close_scene(&self, name: &str) -> Result<()> {
        // The outer `Option` tells whether the name is reserved, the inner one whether the scene is loaded.
        let entry = self.shared.registry.find_entry(name);
        match entry.as_ref().map(|entry| entry.scene_handle()) {
            Some(Some(scene_handle)) if scene_handle.is_closing() => return Err(scene_not_open(name)),
            Some(Some(scene_handle)) => scene_handle.stop(scene_not_open(name)).await,
            Some(None) => return Err(Error::Busy { queue: "queue for a scene that is being opened", limit: 1 }),
            None => {}
        }
        let (engine, scene_name) = (self.clone(), name.to_owned());
        let catalog_change = run_blocking("close", move || {
            engine.shared.services.checkpoints.remove(&scene_name);
            engine.shared.crash_log.forget(&scene_name);
            let is_removed = engine.shared.scene_catalog.remove(&scene_name);
            engine.shared.upload_permits.remove(&scene_name);
            is_removed
        })
        .await;
        // Release the name only after the files are removed, so that a new upload with this name does not lose its
        // files. Release it even if the catalog could not be written.
        if let Some(entry) = &entry {
            self.shared.registry.remove(name, entry);
        }
        self.shared.registry.forget_failure(name);
        let was_listed = catalog_change?;
        if entry.is_some() || was_listed { Ok(()) } else { Err(scene_not_open(name)) }
    }
}
