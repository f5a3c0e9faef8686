//! The engine: loads scenes, applies steps to them, and produces frames, picks and vertices. It runs one device thread
//! and one task per open scene, and persists uploads, the list of open scenes and their last steps across restarts.
//!
//! The task of a scene serializes all operations on the scene (`scene::actor`). A writer sends steps through a bounded
//! queue (`scene::step_queue`). A subscriber receives results through a bounded channel (`scene::subscriber`).
//! Exceeding a bound, or blocking the writer for too long, yields an error that names the limit.
//!
//! # From q to a picture
//! | where | what happens | in |
//! |---|---|---|
//! | call of the writer | q and T are parsed and queued | `scene::step_queue` |
//! | task of the scene | the state after the step is computed; commands to deform it and to draw each picture go to the device; the readers get the pictures at once, before they are drawn | `scene::actor`, `scene::output_producer` |
//! | device thread | the state is deformed and the pictures are drawn, in turn with those of other scenes | `device::device_loop` |
//! | copy threads | the pixels leave the memory of the device | `output::rendered_picture` |
//! | encoder threads | the pixels become a file, once for all readers of a format | `output::frame_encoder` |
//! | call of the reader | waits for the pictures, lets them be encoded, and sends them | `output::frame_queue` |
//!
//! Vertices and picks take the same path without the encoder threads. Batches of small views have a path of their own
//! (`views`): copies of a scene that one caller moves, without a task.

mod blocking;
mod catch_unwind;
mod content;
mod crash_signals;
#[cfg(test)]
mod crash_tests;
mod device;
mod lock;
mod memory_limits;
mod output;
mod registry;
mod running_scene;
mod scene;
mod scene_memory;
mod scene_opening;
mod source;
mod storage;
#[cfg(test)]
mod testing;
mod upload_permits;
mod views;

pub(crate) use blocking::run_blocking;
pub use content::{ContentHash, ContentHashes, SceneContent, ShapeArray, hex, parse_hash};
pub use device::context::{DeviceContext, EngineInfo, share_pictures};
pub use device::device_loss::DeviceLoss;
pub use device::handle::PendingReply;
pub use device::loaded_scene::LoadedScene;
pub use device::loaded_worlds::{DrawnViews, ExportedSlots};
pub use device::scalar_field::validate_mode;
pub use memory_limits::MemoryLimits;
pub use output::frame_encoder::FrameEncoder;
pub use output::frame_format::{FrameFormat, JpegQuality};
pub use output::frame_queue::{EncodedFrame, FrameQueue};
pub use output::output_spec::{FrameOutput, OutputSpec, PictureSpec};
pub use output::pack::{Origins, PackedVertices, Section, VertexPacker};
pub use output::pick_result::{PickResult, resolve_picks};
pub use output::rendered_picture::{Pixels, RenderedPicture};
pub use output::state_packing::{PackedState, StateContent, StateSection, pack_state};
pub use output::step_output::{ModalHit, OutputBody, SharedPicture, StepFrames, StepId, StepOutput};
pub use output::step_vertices::StepVertices;
pub use output::vertex_encoding::Encoding;
pub use output::vertex_selection::{Attribute, VertexSelection};
pub use registry::{FailedScene, SceneList};
pub use scene::delivery::{Delivery, StreamDelivery};
pub use scene::encoded_subscription::EncodedSubscription;
pub use scene::force_subscription::{ForceReport, ForceSubscription};
pub use scene::forces::{AppliedForce, Force, ForceKind, ForceOwner, ForceReceipt, ForceUpdate, check_force_count};
pub use scene::frame_stream::{CameraControl, FrameStreamEntry, FrameStreamRegistration, StreamId};
pub use scene::handle::{SceneHandle, WriterSession};
pub use scene::lease::{InitialState, LeaseRequest, LeaseToken};
pub use scene::message::StepSelector;
pub use scene::step_queue::{Overflow, StepReport};
pub use scene::subscriber::Subscription;
pub use scene::work_timer::WorkTimer;
pub use scene_memory::MemoryUse;
pub use source::{SceneSource, StoredUpload};
pub use storage::array_upload::{ArrayUpload, ArrayUploadHeader, UploadedDomain, UploadedShape};
pub use storage::provenance::{SceneProvenance, validate_scene_name};
pub use storage::scene_record::{EVERYONE, SceneAccess, SceneRight};
pub use storage::upload::{Upload, UploadHeader};
pub use views::{Pairing, PendingViews, ViewSession, ViewSettings, ViewStep, ViewUpdate};

#[cfg(test)]
pub(crate) use testing::lossless_lease;

pub use modalcast_render::{FrameInfo, FrameLook, RasterBackend};

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use tokio::sync::watch;

use self::device::handle::DeviceThread;
use self::device::work_owners::WorkOwners;
pub(crate) use self::lock::lock;
use self::registry::Registry;
use self::scene::actor::SceneServices;
use self::scene::frame_stream::FrameStreamRegistry;
use self::scene_memory::MemoryBudgets;
use self::storage::checkpoint_store::CheckpointStore;
use self::storage::crash_log::CrashLog;
use self::storage::file_system::{DiskFileSystem, FileSystem};
use self::storage::run_counter::RunCounter;
use self::storage::scene_catalog::SceneCatalog;
use self::storage::scene_record::SceneRecord;
use self::storage::upload_record::find_uploaded_files;
use self::upload_permits::{UploadPermit, UploadPermits};
use crate::admission::{Account, Admission, Client, Limit, PermitPool, Queue};
use crate::config::{Config, ValidatedConfig};
use crate::identity::Principal;
use modalcast_model::error::{Error, Result, invalid};

/// Handle to the engine. A clone is shallow: all clones share one device thread and one set of scenes.
#[derive(Clone)]
pub struct Engine {
    shared: Arc<Shared>,
}

struct Shared {
    config: Arc<ValidatedConfig>,
    source: Arc<dyn SceneSource>,
    info: EngineInfo,
    encoder: FrameEncoder,
    vertex_packer: VertexPacker,
    services: SceneServices,
    memory: MemoryBudgets,
    registry: Registry,
    frame_streams: Arc<FrameStreamRegistry>,
    loads: Queue,
    built_in_loads: Queue,
    upload_permits: Arc<UploadPermits>,
    view_calls: PermitPool,
    /// Whether every scene of the last run is open or has failed.
    are_scenes_reopened: watch::Sender<bool>,
    next_scene_id: AtomicU64,
    is_stopping: AtomicBool,
    device_thread: Mutex<Option<JoinHandle<()>>>,
    crash_log: Arc<CrashLog>,
    // Last field, so that its lock on the state folder is released only after the fields that write into the folder
    // are dropped.
    scene_catalog: SceneCatalog,
}

impl Engine {
    /// Opens the state folder and the devices, and begins to reopen every scene in the folder's list of open scenes.
    /// Until such a scene is open, [`Self::find_opened`] waits for it.
    ///
    /// # Errors
    /// `Unavailable` when a backend requested by name cannot be opened, or another server uses the state folder.
    pub async fn start(config: ValidatedConfig, source: Arc<dyn SceneSource>) -> Result<Self> {
        let config = Arc::new(config);
        let device_config = Arc::clone(&config);
        Self::start_with_device(config, source, move || DeviceContext::open(&device_config)).await
    }

    /// An engine with the open scene "strips", and a step that makes its device report a loss.
    #[cfg(test)]
    pub(crate) async fn with_losable_device(
        config: ValidatedConfig,
    ) -> Result<(Self, modalcast_model::scene::RawStepUpdate)> {
        let open = || DeviceContext::with_deformer(testing::FaultyDeformer::boxed);
        let engine = Self::start_with_device(Arc::new(config), Arc::new(testing::StripsSource), open).await?;
        engine.open("strips", "strips", &Principal::owner(), Client::Server).await?;
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[testing::InjectedFault::DeviceLost.q(), 0.0]));
        let step = modalcast_model::scene::RawStepUpdate { number: 1, q_domains: vec![0], q, ..Default::default() };
        Ok((engine, step))
    }

    /// [`Self::start`], but `open_device` opens the devices. It runs on the device thread.
    async fn start_with_device(
        config: Arc<ValidatedConfig>,
        source: Arc<dyn SceneSource>,
        open_device: impl FnOnce() -> Result<DeviceContext> + Send + 'static,
    ) -> Result<Self> {
        let state = config.state.clone();
        let (scene_catalog, crash_log, checkpoints, run_counter, stored_uploads) =
            run_blocking("state folder", move || {
                let file_system: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
                let scene_catalog = SceneCatalog::open(&state, &file_system)?;
                let scenes = scene_catalog.entries();
                let crash_log = CrashLog::open(&state, &file_system, |scene| scenes.contains_key(scene));
                let run_counter = Arc::new(RunCounter::open(&state, &file_system)?);
                let checkpoints = CheckpointStore::start(scene_catalog.checkpoint_folder(), &file_system)?;
                let stored_uploads = scene_catalog.stored_uploads();
                Ok((scene_catalog, Arc::new(crash_log), Arc::new(checkpoints), run_counter, stored_uploads))
            })
            .await?;
        if let Some(Err(error)) = crash_log.file().map(crash_signals::install) {
            tracing::warn!(%error, "crashes by signals are not recorded");
        }
        let owners = WorkOwners::new(Some(Arc::clone(&crash_log)));
        let DeviceThread { handle, info, thread: device_thread } =
            DeviceThread::start(open_device, config.device_work_limit, owners).await?;
        let admission = Admission::default();
        let upload_permits = UploadPermits::new(&config, &admission);
        for upload in stored_uploads {
            upload_permits.store(&upload.scene, Some(upload.owner.into()), upload.bytes);
        }
        let view_calls = admission.pool(Limit::VIEW_CALLS, (Limit::VIEW_CALLS.total)(&config));
        let [loads, built_in_loads] = [Limit::LOADS, Limit::BUILT_IN_LOADS].map(|limit| Queue::new(limit, &config));
        let shared = Shared {
            services: SceneServices {
                device: handle,
                checkpoints,
                run_counter,
                config: Arc::clone(&config),
                admission: admission.clone(),
            },
            memory: MemoryBudgets::new(info.memory, info.renderer.is_ok()),
            registry: Registry::new(admission.pool(Limit::OPEN_SCENES, config.open_scenes)),
            frame_streams: Arc::default(),
            config,
            source,
            info,
            encoder: FrameEncoder::per_core()?,
            vertex_packer: VertexPacker::start()?,
            loads,
            built_in_loads,
            upload_permits,
            view_calls,
            are_scenes_reopened: watch::Sender::new(false),
            next_scene_id: AtomicU64::new(1),
            is_stopping: AtomicBool::new(false),
            device_thread: Mutex::new(Some(device_thread)),
            crash_log,
            scene_catalog,
        };
        let engine = Self { shared: Arc::new(shared) };
        engine.reopen_scenes();
        Ok(engine)
    }

    /// The backend and the renderer in use.
    pub fn info(&self) -> &EngineInfo {
        &self.shared.info
    }

    /// The counters of refused and preempted permits.
    pub fn admission(&self) -> &Admission {
        &self.shared.services.admission
    }

    /// The server's configuration.
    pub fn config(&self) -> &Config {
        &self.shared.config
    }

    /// The frame encoder. All its clones share one limit on threads.
    pub fn encoder(&self) -> &FrameEncoder {
        &self.shared.encoder
    }

    /// Packs vertices. All clones share one pool of threads.
    pub fn vertex_packer(&self) -> &VertexPacker {
        &self.shared.vertex_packer
    }

    /// The largest image side in pixels that both the configuration and the renderer allow.
    pub fn frame_side(&self) -> u32 {
        let max_renderer_side = self.shared.info.renderer.as_ref().map_or(u32::MAX, |info| info.max_side);
        self.shared.config.frame_side.min(max_renderer_side)
    }

    /// Whether every scene of the last run is open or has failed.
    pub fn watch_reopening(&self) -> watch::Receiver<bool> {
        self.shared.are_scenes_reopened.subscribe()
    }

    /// The memory of all scenes, by its kind: `host` and, with a GPU, `device`.
    pub fn memory_use(&self) -> impl Iterator<Item = (&'static str, MemoryUse)> {
        self.shared.memory.in_use()
    }

    /// Whether the last steps cannot be written to disk. The scenes continue.
    pub fn watch_storage(&self) -> watch::Receiver<bool> {
        self.shared.services.checkpoints.watch_degraded()
    }

    /// The scenes that have failed, or that could not be opened again, since this server was started, sorted by name. A
    /// scene that is open again or deleted is not among them.
    pub fn failed_scenes(&self) -> Vec<FailedScene> {
        self.shared.registry.failed()
    }

    /// Opens a source of the repository under a name; an empty name means the last path component of the source. If the
    /// name is already open from the same source and the principal may use that scene, returns it. With an empty source,
    /// opens a scene of the catalog again, for example one that has failed or that the crash log sets aside. A new scene
    /// belongs to `principal` and counts to `client`.
    ///
    /// # Errors
    /// `NameTaken` when the name belongs to another source or to a scene that the principal may not use, `LimitReached`
    /// when too many scenes are open, and the errors of [`SceneSource::open`].
    pub async fn open(
        &self,
        source: &str,
        name: &str,
        principal: &Principal,
        client: Client,
    ) -> Result<Arc<SceneHandle>> {
        let name = if name.is_empty() {
            storage::provenance::default_scene_name(source)?
        } else {
            validate_scene_name(name)?.to_owned()
        };
        let provenance = SceneProvenance::Repository { source: source.into() };
        let is_same_scene = |listed: &SceneRecord| source.is_empty() || listed.provenance == provenance;
        let record = match self.listed_record(&name, principal)? {
            Some(listed) if is_same_scene(&listed) => listed,
            _ => SceneRecord { provenance, access: SceneAccess::new(principal) },
        };
        self.open_once(name, record, principal, Account::new(principal, client)).await
    }

    /// The record of a scene in the catalog, which may be one that has failed. `None` if the name is free.
    ///
    /// # Errors
    /// `NameTaken` when the principal may not know of the scene.
    fn listed_record(&self, name: &str, principal: &Principal) -> Result<Option<SceneRecord>> {
        let listed = self.shared.scene_catalog.find(name);
        match &listed {
            Some(record) if record.access.right_of(principal).is_none() => Err(registry::hidden_name_error(name)),
            _ => Ok(listed),
        }
    }

    /// Checks that a principal may upload a scene with this name. The upload replaces a scene of the catalog that has
    /// failed.
    ///
    /// # Errors
    /// `NameTaken` when the principal does not control that scene.
    fn check_replacement(&self, name: &str, principal: &Principal) -> Result<()> {
        match self.listed_record(name, principal)? {
            Some(record) if record.access.right_of(principal) < Some(SceneRight::Control) => {
                Err(Error::NameTaken { name: name.into(), owner: record.provenance.label() })
            }
            _ => Ok(()),
        }
    }

    /// Checks that a principal has a right to a scene that is open, being opened or in the catalog.
    ///
    /// # Errors
    /// `NotFound` when there is no such scene or the principal may not know of it; `NotPermitted` when the principal may
    /// only use the scene.
    fn check_right(&self, name: &str, principal: &Principal, right: SceneRight) -> Result<()> {
        let access = self.shared.registry.find_entry(name).map(|entry| entry.access().borrow().clone());
        let access = access.or_else(|| self.shared.scene_catalog.find(name).map(|record| record.access));
        access.ok_or_else(|| scene_not_open(name))?.check(name, principal, right)
    }

    /// The open scene with this name, for the server itself.
    ///
    /// # Errors
    /// `NotFound` when no open scene has this name, `Busy` while it is being opened, `ShuttingDown` when the server is
    /// shutting down, `DeviceLost`.
    pub fn find(&self, name: &str) -> Result<Arc<SceneHandle>> {
        self.check_running()?;
        self.shared.registry.find(name)
    }

    /// The open scene with this name, for a principal that needs a right to it. Waits for a scene that is being opened.
    ///
    /// # Errors
    /// As for [`Self::find`]; `NotFound` when the opening fails or the principal may not know of the scene;
    /// `NotPermitted` when the principal may only use the scene.
    pub async fn find_opened(&self, name: &str, principal: &Principal, right: SceneRight) -> Result<Arc<SceneHandle>> {
        self.check_running()?;
        self.check_right(name, principal, right)?;
        self.shared.registry.wait_until_opened(name).await;
        self.find(name)
    }

    /// Shares a scene with other principals, in place of those with whom it was shared: [`EVERYONE`], or names. Returns
    /// who may use the scene now.
    ///
    /// # Errors
    /// Those of [`Self::find_opened`]; `Invalid` for a malformed name; `Fault` when the catalog cannot be written.
    pub async fn share(&self, name: &str, principal: &Principal, principals: Vec<String>) -> Result<SceneAccess> {
        let scene_handle = self.find_opened(name, principal, SceneRight::Control).await?;
        let access = scene_handle.access().share_with(principals)?;
        let (engine, name, new_access) = (self.clone(), name.to_owned(), access.clone());
        let change = move || {
            engine.shared.scene_catalog.set_access(&name, new_access.clone())?;
            engine.shared.registry.set_access(&name, &new_access);
            Ok(())
        };
        run_blocking("scenes.json", change).await?;
        Ok(access)
    }

    /// Registers a frame stream, so that its cameras can be moved until the registration is dropped.
    ///
    /// # Errors
    /// `Fault` when the operating system returns no random bytes.
    pub fn register_frame_stream(&self, entry: FrameStreamEntry) -> Result<FrameStreamRegistration> {
        self.shared.frame_streams.register(entry)
    }

    /// The running frame stream with this id.
    ///
    /// # Errors
    /// `StreamNotFound` when there is none.
    pub fn find_frame_stream(&self, id: StreamId) -> Result<Arc<FrameStreamEntry>> {
        self.shared.frame_streams.find(id)
    }

    /// The scenes that a principal may use, sorted by name.
    pub fn list(&self, principal: &Principal) -> SceneList {
        self.shared.registry.list(principal)
    }

    /// The scenes that have a writer, by the client that drives them.
    pub fn driven_scenes(&self) -> BTreeMap<Account, Vec<String>> {
        let mut by_client = BTreeMap::<Account, Vec<String>>::new();
        for scene_handle in self.list(&Principal::owner()).open {
            if let Some(account) = scene_handle.writer() {
                by_client.entry(account).or_default().push(scene_handle.name.clone());
            }
        }
        by_client
    }

    /// The sources that [`Self::open`] accepts.
    ///
    /// # Errors
    /// `Fault` when listing the repository panics.
    pub async fn sources(&self) -> Result<Vec<String>> {
        let source = Arc::clone(&self.shared.source);
        run_blocking("repository", move || Ok(source.list())).await
    }

    /// Begins an upload of `principal`, which counts to `client`.
    ///
    /// # Errors
    /// `Invalid` for a malformed name or entry path and for counts or sizes over the limits; `NameTaken` when the name
    /// is in use; `LimitReached` when the client has its share of the uploads in progress, or the principal has its share
    /// of the stored bytes; `Fault` of the disk.
    pub async fn begin_upload(&self, header: UploadHeader, principal: &Principal, client: Client) -> Result<Upload> {
        self.check_running()?;
        validate_scene_name(&header.scene)?;
        let config = &self.shared.config;
        if header.files == 0 || header.files > config.upload_files {
            return Err(invalid("header.files", format!("1 to {} files", config.upload_files), header.files));
        }
        self.check_upload_bytes(header.total_bytes)?;
        let permit = self.permit_upload(&header.scene, principal, client, header.total_bytes)?;
        let (upload_folder, file_system) = (self.shared.scene_catalog.uploads(), self.file_system());
        let reusable = self.shared.scene_catalog.upload_folders_of(&principal.name);
        run_blocking("upload", move || Upload::begin(&upload_folder, &file_system, header, permit, reusable)).await
    }

    /// Begins an upload of arrays.
    ///
    /// # Errors
    /// As for [`Self::begin_upload`].
    pub async fn begin_array_upload(
        &self,
        header: ArrayUploadHeader,
        principal: &Principal,
        client: Client,
    ) -> Result<ArrayUpload> {
        self.check_running()?;
        validate_scene_name(&header.scene)?;
        self.check_upload_bytes(header.total_bytes)?;
        let permit = self.permit_upload(&header.scene, principal, client, header.total_bytes)?;
        let (upload_folder, file_system) = (self.shared.scene_catalog.uploads(), self.file_system());
        let memory = self.shared.memory.new_scene(&principal.name).host;
        run_blocking("upload", move || ArrayUpload::begin(&upload_folder, &file_system, header, permit, memory)).await
    }

    fn file_system(&self) -> Arc<dyn FileSystem> {
        Arc::clone(self.shared.scene_catalog.file_system())
    }

    fn check_upload_bytes(&self, total_bytes: u64) -> Result<()> {
        let max_bytes = self.shared.config.upload_bytes;
        match total_bytes <= max_bytes {
            true => Ok(()),
            false => Err(invalid("header.total_bytes", format!("at most {max_bytes} bytes"), total_bytes)),
        }
    }

    /// Checks that a client of `principal` may upload a scene with this name, and counts the upload until the permit is
    /// dropped.
    fn permit_upload(&self, scene: &str, principal: &Principal, client: Client, bytes: u64) -> Result<UploadPermit> {
        let account = Account::new(principal, client);
        self.check_replacement(scene, principal)?;
        self.shared.registry.check_upload(scene, principal, &account)?;
        self.shared.upload_permits.admit(account, bytes)
    }

    /// For each hash, whether a file of a principal's uploads has this content.
    ///
    /// # Errors
    /// `Fault` when the search panics.
    pub async fn find_uploaded_files(&self, hashes: Vec<ContentHash>, principal: &Principal) -> Result<Vec<bool>> {
        let folders = self.shared.scene_catalog.upload_folders_of(&principal.name);
        let find = move || {
            let files = find_uploaded_files(&folders);
            Ok(hashes.iter().map(|hash| files.contains_key(hash)).collect())
        };
        run_blocking("upload", find).await
    }

    /// Opens a complete upload as a scene of `principal`. On failure, and when the caller is cancelled, the uploaded files are removed.
    ///
    /// # Errors
    /// `Invalid` naming the missing or malformed file; `NameTaken` when another scene was opened under the name since
    /// [`Self::begin_upload`].
    pub async fn finish_upload(&self, upload: Upload, principal: &Principal) -> Result<Arc<SceneHandle>> {
        self.open_upload(run_blocking("upload", move || upload.finish()).await?, principal).await
    }

    /// Opens a complete upload of arrays as a scene of `principal`. On failure, and when the caller is cancelled, the
    /// uploaded files are removed.
    ///
    /// # Errors
    /// As for [`Self::finish_upload`].
    pub async fn finish_array_upload(&self, upload: ArrayUpload, principal: &Principal) -> Result<Arc<SceneHandle>> {
        self.open_upload(run_blocking("upload", move || upload.finish()).await?, principal).await
    }

    /// Closes a scene and ends its streams; removes its persisted step and, for an upload, its files.
    ///
    /// # Errors
    /// `NotFound` when the name is neither open nor in the list of open scenes, or the principal may not know of it;
    /// `NotPermitted` when the principal does not control the scene; `Busy` while the scene is being opened.
    pub async fn close(&self, name: &str, principal: &Principal) -> Result<()> {
        let engine = self.clone();
        let name = validate_scene_name(name)?.to_owned();
        self.check_right(&name, principal, SceneRight::Control)?;
        // A separate task, so that closing completes even if the caller is cancelled.
        let work = async move { engine.close_scene(&name).await };
        tokio::spawn(work).await.map_err(modalcast_model::error::fault_in("close"))?
    }

    /// Ends every stream with `ShuttingDown`, writes outstanding checkpoints, joins the device thread and releases the
    /// state folder.
    pub async fn shutdown(&self) {
        if self.shared.is_stopping.swap(true, Ordering::AcqRel) {
            return;
        }
        for scene_handle in self.list(&Principal::owner()).open {
            scene_handle.stop(Error::ShuttingDown).await;
        }
        let engine = self.clone();
        let stop_threads = move || {
            engine.shared.services.checkpoints.finish();
            let device_thread = lock(&engine.shared.device_thread).take();
            engine.shared.services.device.quit();
            // The thread of a lost device may be in a call that does not return.
            if engine.shared.services.device.loss().error().is_none() {
                device_thread.map(JoinHandle::join);
            }
            engine.shared.scene_catalog.release();
            Ok(())
        };
        if let Err(error) = run_blocking("shutdown", stop_threads).await {
            tracing::error!(%error, "the engine did not stop cleanly");
        }
    }

    /// Whether [`Self::shutdown`] was called.
    pub fn is_stopping(&self) -> bool {
        self.shared.is_stopping.load(Ordering::Acquire)
    }

    /// Waits until the device is lost and returns the error. Every open scene then fails with this error, and opening a
    /// scene returns it. Cancel-safe.
    pub async fn device_lost(&self) -> Error {
        self.shared.services.device.loss().wait().await
    }

    /// The observer of the device, which tells whether it and the renderer work.
    pub fn observe_device(&self) -> DeviceLoss {
        self.shared.services.device.loss().clone()
    }

    /// Checks that scenes can be opened and used.
    ///
    /// # Errors
    /// `ShuttingDown`, `DeviceLost`.
    fn check_running(&self) -> Result<()> {
        if self.is_stopping() {
            return Err(Error::ShuttingDown);
        }
        self.shared.services.device.loss().error().map_or(Ok(()), Err)
    }
}

fn scene_not_open(name: &str) -> Error {
    Error::NotFound { what: "scene", given: format!("'{name}'") }
}

#[cfg(test)]
mod tests {
    use modalcast_model::deform::VertexAttributes;
    use modalcast_model::load::OpenedScene;
    use modalcast_model::memory::MemoryReservation;
    use modalcast_model::scene::RawStepUpdate;
    use sha2::Digest as _;

    use super::testing::{FaultyDeformer, InjectedFault, StripsSource};
    use super::*;
    use crate::hang_guard::HANG_GUARD;

    const POSITIONS: OutputSpec =
        OutputSpec::Vertices(VertexAttributes { positions: true, normals: false, displacements: false, boxes: false });

    /// Starts an engine whose deformer injects faults, and opens the scenes "faulty" and "control".
    async fn start_faulty_engine(state_folder: &std::path::Path) -> (Engine, Arc<SceneHandle>, Arc<SceneHandle>) {
        let config = Config { state: state_folder.to_owned(), stall_budget: HANG_GUARD, ..Config::default() }
            .validated()
            .expect("expected a valid configuration");
        let open_device = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let engine = Engine::start_with_device(Arc::new(config), Arc::new(StripsSource), open_device)
            .await
            .expect("expected a running engine");
        let faulty_scene =
            engine.open("strips", "faulty", &Principal::owner(), Client::Server).await.expect("expected an open scene");
        let control_scene = engine
            .open("strips", "control", &Principal::owner(), Client::Server)
            .await
            .expect("expected an open scene");
        (engine, faulty_scene, control_scene)
    }

    /// A step that sets the two coordinates of the first domain to `q` and 0.
    fn step(number: u64, q: f32) -> RawStepUpdate {
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[q, 0.0]));
        RawStepUpdate { number, q_domains: vec![0], q, ..RawStepUpdate::default() }
    }

    /// Sends one step and waits for its report.
    async fn send_step(writer: &mut WriterSession, number: u64, q: f32) -> Result<StepReport> {
        writer.push_step(step(number, q)).await?;
        await_within_limit(writer.next_report()).await
    }

    async fn await_within_limit<T>(work: impl Future<Output = T>) -> T {
        tokio::time::timeout(HANG_GUARD, work).await.expect("expected an answer")
    }

    async fn acquire_writer(scene_handle: &SceneHandle) -> WriterSession {
        scene_handle.drive("test", lossless_lease(4)).await.expect("expected the writer lease")
    }

    fn is_done(report: &Result<StepReport>) -> bool {
        matches!(report, Ok(StepReport::Done { .. }))
    }

    #[tokio::test]
    async fn panicking_scene_fails_alone_and_can_be_reopened() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let (engine, faulty_scene, control_scene) = start_faulty_engine(folder.path()).await;
        let mut faulty_writer = acquire_writer(&faulty_scene).await;
        let mut control_writer = acquire_writer(&control_scene).await;
        let mut subscription = faulty_scene
            .subscribe(&Account::server(), POSITIONS, Delivery::Lossless)
            .await
            .expect("expected a subscription");
        assert!(is_done(&send_step(&mut faulty_writer, 1, 0.25).await));
        assert!(is_done(&send_step(&mut control_writer, 1, 0.25).await));
        await_within_limit(subscription.next()).await.expect("control: expected the first step");
        let account = Account::server();
        let request = faulty_scene.request_output(&account, StepSelector::Exact { run: 0, number: 99 }, POSITIONS);
        let (output, ()) = await_within_limit(async { tokio::join!(request, faulty_scene.inject_panic()) }).await;

        let is_panic = |error: &Error| matches!(error, Error::Fault { reason, .. } if reason.contains("panicked"));
        assert!(output.as_ref().is_err_and(is_panic), "pending request: expected the panic, got {output:?}");
        let report = await_within_limit(faulty_writer.next_report()).await;
        assert!(report.as_ref().is_err_and(is_panic), "writer: expected the panic, got {report:?}");
        assert!(faulty_writer.push_step(step(2, 0.5)).await.is_err_and(|error| is_panic(&error)));
        let end = await_within_limit(subscription.next()).await;
        assert!(end.as_ref().is_err_and(is_panic), "subscription: expected the panic, got {end:?}");
        let new_subscription =
            await_within_limit(faulty_scene.subscribe(&Account::server(), POSITIONS, Delivery::Latest)).await;
        assert!(new_subscription.as_ref().is_err_and(is_panic), "expected the panic, got {new_subscription:?}");

        let error = engine.find("faulty").expect_err("expected an error for a failed scene");
        assert!(matches!(error, Error::NotFound { .. }), "expected NotFound, got {error}");
        let names = engine.list(&Principal::owner()).open.iter().map(|scene| scene.name.clone()).collect::<Vec<_>>();
        assert_eq!(names, ["control"]);
        let rest_state = Arc::new(modalcast_model::scene::SceneState::rest(&faulty_scene.scene));
        let deformation = engine.shared.services.device.deform(faulty_scene.id(), &rest_state, None);
        let error = await_within_limit(deformation.wait()).await.expect_err("expected an unloaded scene").to_string();
        assert!(error.contains("not loaded"), "expected 'not loaded', got {error}");
        assert!(is_done(&send_step(&mut control_writer, 2, 0.5).await), "expected the control scene to continue");
        let reopened_scene = await_within_limit(engine.open("strips", "faulty", &Principal::owner(), Client::Server))
            .await
            .expect("expected to reopen the scene");
        let restored_step = reopened_scene.last_step().map(|step| step.number);
        assert_eq!(restored_step, Some(1), "expected the step of the checkpoint");
        engine.shutdown().await;
    }

    /// Otherwise a client that waits for the scenes of a restarted server would miss one.
    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn scene_that_is_opened_is_never_missing_from_the_list() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let (engine, _, _) = start_faulty_engine(folder.path()).await;
        let opening_engine = engine.clone();
        let opening = tokio::spawn(async move {
            opening_engine.open("strips", "late", &Principal::owner(), Client::Server).await.map(drop)
        });
        let is_listed = |names: &[&str]| names.contains(&"late");
        await_within_limit(async {
            let mut was_listed = false;
            loop {
                let list = engine.list(&Principal::owner());
                let open = is_listed(&list.open.iter().map(|scene| scene.name.as_str()).collect::<Vec<_>>());
                let opening = is_listed(&list.opening.iter().map(String::as_str).collect::<Vec<_>>());
                assert!(!(open && opening) && (open || opening || !was_listed), "expected the scene in one list");
                was_listed |= opening;
                if open {
                    break;
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
        await_within_limit(opening).await.expect("expected no panic").expect("expected an open scene");
        engine.shutdown().await;
    }

    /// A source whose uploads are opened when the test allows it.
    struct WaitingSource(Mutex<std::sync::mpsc::Receiver<()>>);

    impl SceneSource for WaitingSource {
        fn open(&self, source: &str, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
            StripsSource.open(source, memory)
        }

        fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
            lock(&self.0).recv_timeout(HANG_GUARD).expect("expected the permission to open");
            self.open(&upload.entry, memory)
        }

        fn list(&self) -> Vec<String> {
            Vec::new()
        }
    }

    /// A caller that has gone does not know the scene, which would hold its name.
    #[tokio::test]
    async fn upload_whose_caller_has_gone_leaves_no_scene_and_no_folder() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let config = Config { state: folder.path().to_owned(), ..Config::default() };
        let (allow, allowed) = std::sync::mpsc::sync_channel(1);
        let source = Arc::new(WaitingSource(Mutex::new(allowed)));
        let open_device = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let config = Arc::new(config.validated().expect("expected a valid configuration"));
        let engine = Engine::start_with_device(config, source, open_device).await.expect("expected a running engine");
        let uploads = folder.path().join("uploads");
        let wait_until = async |condition: &dyn Fn() -> bool| {
            await_within_limit(async {
                while !condition() {
                    tokio::time::sleep(std::time::Duration::from_millis(1)).await;
                }
            })
            .await;
        };
        for is_canceled in [true, false] {
            let header = UploadHeader { scene: "upload".into(), entry: String::new(), files: 1, total_bytes: 0 };
            let upload = engine.begin_upload(header, &Principal::owner(), Client::Server).await;
            let mut upload = upload.expect("expected an accepted upload");
            upload.begin_file("a.obj", 0, &sha2::Sha256::digest(b"")).expect("expected an accepted file");
            let opening_engine = engine.clone();
            let caller =
                tokio::spawn(async move { opening_engine.finish_upload(upload, &Principal::owner()).await.map(drop) });
            // The files are at their place when the source is asked to open them.
            wait_until(&|| uploads.join("upload").exists()).await;
            if is_canceled {
                caller.abort();
            }
            allow.send(()).expect("expected a source");
            match caller.await {
                Ok(opened) => opened.expect("expected an open scene"),
                Err(_) => wait_until(&|| engine.shared.registry.find_entry("upload").is_none()).await,
            }
            let expected = usize::from(!is_canceled);
            assert_eq!(std::fs::read_dir(&uploads).expect("expected a folder").count(), expected);
            assert_eq!(
                (engine.shared.scene_catalog.entries().len(), engine.list(&Principal::owner()).open.len()),
                (expected, expected)
            );
        }
        engine.shutdown().await;
    }

    /// A scene can fail before the registry has its handle.
    #[tokio::test]
    async fn scene_that_fails_while_it_is_opened_is_listed_as_failed() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let (engine, faulty_scene, _) = start_faulty_engine(folder.path()).await;
        let writer = acquire_writer(&faulty_scene).await;
        faulty_scene.inject_panic().await;
        let panic = await_within_limit(writer.next_report()).await.expect_err("expected the panic");
        let provenance = SceneProvenance::Repository { source: "strips".into() };
        let record = SceneRecord { provenance, access: SceneAccess::new(&Principal::owner()) };
        let request = engine.open_request("late", &record, Account::server());
        let entry = engine.shared.registry.reserve(&request, &Principal::owner(), true).expect("expected a place");
        let opened = entry.get_or_open(async || Ok(Arc::clone(&faulty_scene))).await;
        assert_eq!(opened.expect_err("expected the error of the scene"), panic);
        engine.end_opening("late", &entry);
        let list = engine.list(&Principal::owner());
        let is_late = |failed: &FailedScene| failed.name == "late" && failed.error == panic;
        assert!(list.failed.iter().any(is_late) && list.opening.is_empty(), "{:?}", list.failed);
        await_within_limit(engine.open("strips", "late", &Principal::owner(), Client::Server))
            .await
            .expect("expected that the name is free");
        engine.shutdown().await;
    }

    #[tokio::test]
    async fn panicking_device_command_rejects_only_its_step() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let (engine, faulty_scene, control_scene) = start_faulty_engine(folder.path()).await;
        let mut faulty_writer = acquire_writer(&faulty_scene).await;
        let mut control_writer = acquire_writer(&control_scene).await;
        let report = send_step(&mut faulty_writer, 1, InjectedFault::PanicInDeform.q()).await;
        assert!(matches!(report, Ok(StepReport::Rejected { step: 1, error: Error::Fault { .. } })), "{report:?}");
        assert!(is_done(&send_step(&mut control_writer, 1, 0.25).await));
        assert!(is_done(&send_step(&mut faulty_writer, 2, 0.25).await), "expected the faulty scene to continue");
        engine.shutdown().await;
    }

    /// The third step is taken from the queue while the second one is computed. Its state must not contain the q of the
    /// second step, which is rejected; with it, the third step would be rejected, too.
    #[tokio::test]
    async fn step_after_a_rejected_one_starts_from_the_last_valid_state() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let (engine, faulty_scene, _) = start_faulty_engine(folder.path()).await;
        let mut writer = acquire_writer(&faulty_scene).await;
        writer.push_step(step(1, 0.25)).await.expect("expected capacity");
        writer.push_step(step(2, InjectedFault::PanicInDeform.q())).await.expect("expected capacity");
        writer.push_step(RawStepUpdate { q_domains: vec![1], ..step(3, 0.5) }).await.expect("expected capacity");
        assert!(is_done(&await_within_limit(writer.next_report()).await));
        let report = await_within_limit(writer.next_report()).await;
        assert!(matches!(report, Ok(StepReport::Rejected { step: 2, .. })), "{report:?}");
        let report = await_within_limit(writer.next_report()).await;
        assert!(matches!(report, Ok(StepReport::Done { step: 3, .. })), "{report:?}");
        engine.shutdown().await;
    }

    #[tokio::test]
    async fn lost_device_fails_every_scene_and_rejects_new_ones() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let (engine, faulty_scene, control_scene) = start_faulty_engine(folder.path()).await;
        let mut faulty_writer = acquire_writer(&faulty_scene).await;
        let mut control_writer = acquire_writer(&control_scene).await;
        let mut subscription = control_scene
            .subscribe(&Account::server(), POSITIONS, Delivery::Latest)
            .await
            .expect("expected a subscription");
        assert!(is_done(&send_step(&mut control_writer, 1, 0.25).await));
        await_within_limit(subscription.next()).await.expect("control: expected the first step");
        let report = send_step(&mut faulty_writer, 1, InjectedFault::DeviceLost.q()).await;
        let loss = testing::device_lost_error();
        assert_eq!(report, Ok(StepReport::Rejected { step: 1, error: loss.clone() }));
        assert_eq!(await_within_limit(faulty_writer.next_report()).await, Err(loss.clone()));
        let idle_report = await_within_limit(control_writer.next_report()).await;
        assert_eq!(idle_report, Err(loss.clone()), "expected the idle scene to fail, too");
        assert_eq!(await_within_limit(subscription.next()).await.expect_err("expected the loss"), loss);
        assert_eq!(await_within_limit(engine.device_lost()).await, loss);
        assert_eq!(engine.find("control").expect_err("expected the loss"), loss);
        assert_eq!(
            await_within_limit(engine.open("strips", "new", &Principal::owner(), Client::Server))
                .await
                .expect_err("expected the loss"),
            loss
        );
        await_within_limit(engine.shutdown()).await;
    }
}
