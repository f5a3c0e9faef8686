//! The engine: loads scenes, applies steps to them, and produces frames, picks and vertices. It runs one device thread
//! and one task per open scene, and persists uploads, the list of open scenes and their last steps across restarts.
//!
//! A scene's task serializes all operations on the scene (`scene_actor`). A writer sends steps through a bounded queue
//! (`step_queue`) and a subscriber receives results through a bounded channel (`subscriber`). Exceeding a bound, or blocking the
//! writer for too long, yields an error that names the limit.

mod blocking;
mod catch_unwind;
mod device;
mod lock;
mod output;
mod registry;
mod scene;
mod source;
mod storage;
#[cfg(test)]
mod testing;

pub use device::context::{DeviceContext, EngineInfo};
pub use device::loaded_scene::LoadedScene;
pub use device::scalar_field::validate_mode;
pub use output::color_frame::ColorFrame;
pub use output::frame_encoder::{EncodedOutput, FrameEncoder, FrameFormat};
pub use output::pack::{PackedVertices, VertexSelection, pack_vertices, validate_domains};
pub use output::pick_result::{PickResult, resolve_picks};
pub use output::step_output::{FrameOutput, ModalHit, OutputBody, OutputSpec, StepId, StepOutput};
pub use scene::encoded_subscription::EncodedSubscription;
pub use scene::handle::{SceneHandle, WriterSession};
pub use scene::message::StepSelector;
pub use scene::step_queue::{Policy, StepReport};
pub use scene::subscriber::{Delivery, Subscription};
pub use source::SceneSource;
pub use storage::scene_catalog::{SceneProvenance, validate_scene_name};
pub use storage::upload::{Upload, UploadHeader};

pub use modalcast_render::{RasterBackend, RasterBackends};

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use tokio::sync::Semaphore;

use self::blocking::run_blocking;
use self::device::command::SceneId;
use self::device::handle::DeviceThread;
use self::lock::lock;
use self::registry::Registry;
use self::scene::actor::SceneServices;
use self::scene::handle::OpenParams;
use self::storage::checkpoint_store::CheckpointStore;
use self::storage::scene_catalog::SceneCatalog;
use crate::config::{Config, ValidatedConfig};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::load::OpenedScene;

/// Scenes that are read from disk concurrently.
const MAX_CONCURRENT_LOADS: usize = 2;

/// Uploads that may be in progress at a time.
const MAX_CONCURRENT_UPLOADS: usize = 8;

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
    services: SceneServices,
    registry: Registry,
    loads: Semaphore,
    uploads: Arc<Semaphore>,
    next_id: AtomicU64,
    stopping: AtomicBool,
    device: Mutex<Option<JoinHandle<()>>>,
    // Last field, so that its lock on the state folder is released only after every writer above is dropped.
    scene_catalog: SceneCatalog,
}

impl Engine {
    /// Opens the state folder and the devices, then reopens every scene in the folder's list of open scenes.
    ///
    /// # Errors
    /// `Unavailable` when a backend requested by name cannot be opened, or another server uses the state folder.
    pub async fn start(config: ValidatedConfig, source: Arc<dyn SceneSource>) -> Result<Self> {
        let config = Arc::new(config);
        let device_config = Arc::clone(&config);
        Self::start_with_device(config, source, move || DeviceContext::open(&device_config)).await
    }

    /// An engine with the open scene "strips", whose device is lost as soon as the returned step is driven.
    #[cfg(test)]
    pub(crate) async fn with_losable_device(
        config: ValidatedConfig,
    ) -> Result<(Self, modalcast_model::scene::RawStepUpdate)> {
        let open = || DeviceContext::with_deformer(testing::FaultyDeformer::boxed);
        let engine = Self::start_with_device(Arc::new(config), Arc::new(testing::StripsSource), open).await?;
        engine.open("strips", "strips").await?;
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[testing::InjectedFault::DeviceLost.q(), 0.0]));
        let step = modalcast_model::scene::RawStepUpdate { number: 1, q_domains: vec![0], q, ..Default::default() };
        Ok((engine, step))
    }

    /// [`Self::start`] with the function that opens the devices on the device thread.
    async fn start_with_device(
        config: Arc<ValidatedConfig>,
        source: Arc<dyn SceneSource>,
        open_device: impl FnOnce() -> Result<DeviceContext> + Send + 'static,
    ) -> Result<Self> {
        let state = config.state.clone();
        let (scene_catalog, checkpoints) = run_blocking("state folder", move || {
            let scene_catalog = SceneCatalog::open(&state)?;
            let checkpoints = CheckpointStore::start(scene_catalog.checkpoint_folder())?;
            Ok((scene_catalog, Arc::new(checkpoints)))
        })
        .await?;
        let DeviceThread { handle, info, thread: device } =
            DeviceThread::start(config.open_scenes, open_device).await?;
        let shared = Shared {
            services: SceneServices { device: handle, checkpoints, config: Arc::clone(&config) },
            registry: Registry::new(config.open_scenes),
            config,
            source,
            info,
            encoder: FrameEncoder::per_core(),
            loads: Semaphore::new(MAX_CONCURRENT_LOADS),
            uploads: Arc::new(Semaphore::new(MAX_CONCURRENT_UPLOADS)),
            next_id: AtomicU64::new(1),
            stopping: AtomicBool::new(false),
            device: Mutex::new(Some(device)),
            scene_catalog,
        };
        let engine = Self { shared: Arc::new(shared) };
        engine.restore().await;
        Ok(engine)
    }

    /// The backend that deforms and the renderer that draws.
    pub fn info(&self) -> &EngineInfo {
        &self.shared.info
    }

    /// The server's configuration.
    pub fn config(&self) -> &Config {
        &self.shared.config
    }

    /// The frame encoder. All its clones share one limit on threads.
    pub fn encoder(&self) -> &FrameEncoder {
        &self.shared.encoder
    }

    /// The largest image side in pixels that both the configuration and the renderer allow.
    pub fn frame_side(&self) -> u32 {
        let renderer = self.shared.info.renderer.as_ref().map_or(u32::MAX, |info| info.max_side);
        self.shared.config.frame_side.min(renderer)
    }

    /// Opens a source of the repository under a name; an empty name means the source's own name. If the name is already
    /// open from the same source, returns the open scene.
    ///
    /// # Errors
    /// `Taken` when the name belongs to another source, `Busy` when too many scenes are open, and the errors of
    /// [`SceneSource::open`].
    pub async fn open(&self, source: &str, name: &str) -> Result<Arc<SceneHandle>> {
        let name = if name.is_empty() {
            storage::scene_catalog::default_scene_name(source)?
        } else {
            validate_scene_name(name)?.to_owned()
        };
        self.open_once(name, SceneProvenance::Repository { source: source.into() }, None).await
    }

    /// The open scene with this name.
    ///
    /// # Errors
    /// `NotFound` when no open scene has this name, `Unavailable` when the server is shutting down, `DeviceLost`.
    pub fn find(&self, name: &str) -> Result<Arc<SceneHandle>> {
        self.check_running()?;
        self.shared.registry.find(name)
    }

    /// All open scenes, sorted by name.
    pub fn list(&self) -> Vec<Arc<SceneHandle>> {
        self.shared.registry.list()
    }

    /// The sources that [`Self::open`] accepts.
    ///
    /// # Errors
    /// `Fault` when listing the repository panics.
    pub async fn sources(&self) -> Result<Vec<String>> {
        let source = Arc::clone(&self.shared.source);
        run_blocking("repository", move || Ok(source.list())).await
    }

    /// Begins an upload.
    ///
    /// # Errors
    /// `Invalid` for a malformed name or entry path and for counts or sizes over the limits; `Taken` when the name is
    /// in use; `Busy` when too many uploads are in progress; `Fault` of the disk.
    pub async fn begin_upload(&self, header: UploadHeader) -> Result<Upload> {
        self.check_running()?;
        validate_scene_name(&header.scene)?;
        let config = &self.shared.config;
        if header.files == 0 || header.files > config.upload_files {
            return Err(invalid("header.files", format!("1 to {}", config.upload_files), header.files));
        }
        if header.total_bytes > config.upload_bytes {
            let expected = format!("at most {}", config.upload_bytes);
            return Err(invalid("header.total_bytes", expected, header.total_bytes));
        }
        self.shared.registry.check_free(&header.scene)?;
        let full = |_| Error::Busy { queue: "uploads under way", limit: MAX_CONCURRENT_UPLOADS };
        let place = Arc::clone(&self.shared.uploads).try_acquire_owned().map_err(full)?;
        let uploads = config.state.join("uploads");
        run_blocking("upload", move || Upload::begin(&uploads, header, place)).await
    }

    /// Opens a complete upload as a scene. On failure the uploaded files are removed.
    ///
    /// # Errors
    /// `Invalid` naming the missing or malformed file; `Taken` when the name was claimed in the meantime.
    pub async fn finish_upload(&self, mut upload: Upload) -> Result<Arc<SceneHandle>> {
        let finish = move || match upload.finish() {
            Ok(()) => Ok(upload),
            Err(error) => {
                upload.discard();
                Err(error)
            }
        };
        let upload = run_blocking("upload", finish).await?;
        let (name, entry) = (upload.header.scene.clone(), upload.header.entry.clone());
        self.open_once(name, SceneProvenance::Upload { entry }, Some(upload)).await
    }

    /// Closes a scene and ends its streams; removes its persisted step and, for an upload, its files.
    ///
    /// # Errors
    /// `NotFound` when the name is neither open nor in the list of open scenes, `Busy` while the scene is being opened.
    pub async fn close(&self, name: &str) -> Result<()> {
        let engine = self.clone();
        let name = validate_scene_name(name)?.to_owned();
        // A separate task, so that closing completes even if the caller is cancelled.
        let work = async move { engine.close_scene(&name).await };
        tokio::spawn(work).await.map_err(modalcast_model::error::fault_in("close"))?
    }

    /// Ends every stream with `Unavailable`, writes outstanding checkpoints, joins the device thread and releases the
    /// state folder.
    pub async fn shutdown(&self) {
        if self.shared.stopping.swap(true, Ordering::AcqRel) {
            return;
        }
        for scene_handle in self.list() {
            scene_handle.stop(stopping()).await;
        }
        let engine = self.clone();
        let finish = move || {
            engine.shared.services.checkpoints.finish();
            let device = lock(&engine.shared.device).take();
            engine.shared.services.device.quit();
            device.map(JoinHandle::join);
            engine.shared.scene_catalog.release();
            Ok(())
        };
        if let Err(error) = run_blocking("shutdown", finish).await {
            tracing::error!(%error, "the engine did not stop cleanly");
        }
    }

    /// Whether [`Self::shutdown`] was called.
    pub fn is_stopping(&self) -> bool {
        self.shared.stopping.load(Ordering::Acquire)
    }

    /// Waits until the device is lost: the server cannot go on, every scene fails with this error, and new ones are
    /// refused. Cancel-safe.
    pub async fn device_lost(&self) -> Error {
        self.shared.services.device.loss().wait().await
    }

    /// # Errors
    /// `Unavailable` when the server is shutting down, `DeviceLost`.
    fn check_running(&self) -> Result<()> {
        if self.is_stopping() {
            return Err(stopping());
        }
        self.shared.services.device.loss().error().map_or(Ok(()), Err)
    }

    async fn restore(&self) {
        let mut openings = tokio::task::JoinSet::new();
        for (name, provenance) in self.shared.scene_catalog.entries() {
            let engine = self.clone();
            openings.spawn(async move {
                if let Err(error) = engine.open_once(name.clone(), provenance, None).await {
                    // The entry remains in the list, because the files may be available again at the next start.
                    tracing::warn!(scene = name, %error, "a kept scene could not be opened");
                }
            });
        }
        openings.join_all().await;
    }

    /// Opens a scene, once for all concurrent callers. Runs in a separate task, so that a cancelled caller does not
    /// cancel the opening.
    async fn open_once(
        &self,
        name: String,
        provenance: SceneProvenance,
        upload: Option<Upload>,
    ) -> Result<Arc<SceneHandle>> {
        self.check_running()?;
        let engine = self.clone();
        let work = async move {
            let entry = engine.shared.registry.entry(&name, &provenance, upload.is_some())?;
            let opened = entry.get_or_open(|| engine.open_or_discard(name.clone(), provenance, upload)).await;
            engine.shared.registry.release(&name, &entry);
            // The scene may have failed before the registry had its handle.
            if opened.as_ref().is_ok_and(|scene_handle| scene_handle.failure().is_some()) {
                engine.shared.registry.remove(&name, &entry);
            }
            opened
        };
        tokio::spawn(work).await.map_err(modalcast_model::error::fault_in("open"))?
    }

    async fn open_or_discard(
        &self,
        name: String,
        provenance: SceneProvenance,
        upload: Option<Upload>,
    ) -> Result<Arc<SceneHandle>> {
        let is_new_upload = upload.is_some();
        let hosted = self.load_and_stage(&name, &provenance, upload).await;
        if hosted.is_err() && is_new_upload {
            let place = self.shared.scene_catalog.upload_folder(&name);
            run_blocking("upload", move || Ok(std::fs::remove_dir_all(place).ok())).await?;
        }
        hosted.map(Arc::new)
    }

    async fn load_and_stage(
        &self,
        name: &str,
        provenance: &SceneProvenance,
        upload: Option<Upload>,
    ) -> Result<SceneHandle> {
        let OpenedScene { scene, backends } = self.load(name, provenance, upload).await?;
        let (engine, key, kept) = (self.clone(), name.to_owned(), Arc::clone(&scene));
        let state = run_blocking("kept step", move || Ok(engine.shared.services.checkpoints.load(&key, &kept))).await?;
        let state = state.unwrap_or_else(|error| {
            tracing::warn!(scene = name, %error, "the scene begins at rest");
            None
        });
        let id = self.shared.next_id.fetch_add(1, Ordering::Relaxed);
        let params = OpenParams {
            name: name.into(),
            provenance: provenance.clone(),
            scene,
            backends,
            id,
            state,
            on_failure: self.release_name_of(name, id),
            frames_unavailable: self.shared.info.renderer.as_ref().err().cloned(),
        };
        let scene_handle = SceneHandle::open(params, self.shared.services.clone()).await?;
        let (engine, key, provenance) = (self.clone(), name.to_owned(), provenance.clone());
        if let Err(error) =
            run_blocking("scenes.json", move || engine.shared.scene_catalog.add(&key, &provenance)).await
        {
            scene_handle.stop(error.clone()).await;
            return Err(error);
        }
        let layout = &scene_handle.scene.layout;
        tracing::info!(scene = name, domains = layout.domains.len(), vertices = layout.vertices, "opened");
        Ok(scene_handle)
    }

    /// What a failing scene calls: removes it from the registry. The catalog keeps the scene, so that the next start
    /// opens it again. The callback does not keep the engine alive.
    fn release_name_of(&self, name: &str, id: SceneId) -> Box<dyn FnOnce() + Send> {
        let (shared, name) = (Arc::downgrade(&self.shared), name.to_owned());
        Box::new(move || {
            if let Some(shared) = shared.upgrade() {
                shared.registry.remove_scene(&name, id);
            }
        })
    }

    /// Reads a scene's files. A panic in a loader becomes a `Fault` of this call.
    async fn load(&self, name: &str, provenance: &SceneProvenance, upload: Option<Upload>) -> Result<OpenedScene> {
        let stopped = |_| stopping();
        let _permit = self.shared.loads.acquire().await.map_err(stopped)?;
        let source = Arc::clone(&self.shared.source);
        let place = self.shared.scene_catalog.upload_folder(name);
        let (engine, key, provenance) = (self.clone(), name.to_owned(), provenance.clone());
        let read = move || match provenance {
            SceneProvenance::Repository { source: path } => source.open(&path),
            SceneProvenance::Upload { entry } => {
                if let Some(upload) = upload {
                    // A checkpoint of an older scene with this name does not apply to the new one.
                    engine.shared.services.checkpoints.remove(&key);
                    upload.commit(&place)?;
                }
                source.open_within(&place, &entry)
            }
        };
        run_blocking("load", read).await
    }

    async fn close_scene(&self, name: &str) -> Result<()> {
        let entry = self.shared.registry.find_entry(name);
        match entry.as_ref().map(|entry| entry.scene_handle()) {
            Some(Some(scene_handle)) if scene_handle.is_closing() => return Err(scene_not_open(name)),
            Some(Some(scene_handle)) => scene_handle.stop(scene_not_open(name)).await,
            Some(None) => return Err(Error::Busy { queue: "the name of a scene that is being opened", limit: 1 }),
            None => {}
        }
        let (engine, key) = (self.clone(), name.to_owned());
        let removed = run_blocking("close", move || {
            engine.shared.services.checkpoints.remove(&key);
            std::fs::remove_dir_all(engine.shared.scene_catalog.upload_folder(&key)).ok(); // Only uploads have a folder.
            engine.shared.scene_catalog.remove(&key)
        })
        .await;
        // The name is released only after the files are removed, so that a new upload under it does not lose its files.
        // It is released even if the list could not be written.
        if let Some(entry) = &entry {
            self.shared.registry.remove(name, entry);
        }
        let was_kept = removed?;
        if entry.is_some() || was_kept { Ok(()) } else { Err(scene_not_open(name)) }
    }
}

fn scene_not_open(name: &str) -> Error {
    Error::NotFound { what: "scene", given: format!("'{name}'") }
}

fn stopping() -> Error {
    Error::Unavailable { what: "server", reason: "it stops".into(), remedy: "Try again when it is back".into() }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use modalcast_model::deform::VertexAttributes;
    use modalcast_model::scene::RawStepUpdate;

    use super::testing::{FaultyDeformer, InjectedFault, StripsSource};
    use super::*;

    const POSITIONS: OutputSpec =
        OutputSpec::Vertices(VertexAttributes { positions: true, normals: false, displacements: false, boxes: false });

    /// An engine whose deformer injects faults, with the open scenes "faulty" and "control".
    async fn engine(state: &std::path::Path) -> (Engine, Arc<SceneHandle>, Arc<SceneHandle>) {
        let config = Config { state: state.to_owned(), ..Config::default() }.validated().expect("a good configuration");
        let open = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let engine = Engine::start_with_device(Arc::new(config), Arc::new(StripsSource), open).await.expect("starts");
        let faulty = engine.open("strips", "faulty").await.expect("opens");
        let control = engine.open("strips", "control").await.expect("opens");
        (engine, faulty, control)
    }

    fn step(number: u64, q: f32) -> RawStepUpdate {
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[q, 0.0]));
        RawStepUpdate { number, q_domains: vec![0], q, ..RawStepUpdate::default() }
    }

    /// Drives one step and waits for its report.
    async fn drive(writer: &mut WriterSession, number: u64, q: f32) -> Result<StepReport> {
        writer.step(&step(number, q))?;
        within(writer.next_report()).await
    }

    async fn within<T>(work: impl Future<Output = T>) -> T {
        tokio::time::timeout(Duration::from_secs(60), work).await.expect("an answer in time")
    }

    fn is_done(report: &Result<StepReport>) -> bool {
        matches!(report, Ok(StepReport::Done { .. }))
    }

    #[tokio::test]
    async fn panicking_scene_fails_alone_and_can_be_opened_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let (engine, faulty, control) = engine(folder.path()).await;
        let mut writer = faulty.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        let mut other = control.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        let mut feed = faulty.subscribe(POSITIONS, Delivery::Lossless).await.expect("subscribes");
        assert!(is_done(&drive(&mut writer, 1, 0.25).await) && is_done(&drive(&mut other, 1, 0.25).await));
        within(feed.next()).await.expect("control: the first step");
        let waiting = faulty.request_output(StepSelector::Exact(99), POSITIONS);
        let (waiting, ()) = within(async { tokio::join!(waiting, faulty.inject_panic()) }).await;

        let is_panic = |error: &Error| matches!(error, Error::Fault { reason, .. } if reason.contains("panicked"));
        assert!(waiting.as_ref().is_err_and(is_panic), "{waiting:?}");
        let report = within(writer.next_report()).await;
        assert!(report.as_ref().is_err_and(is_panic), "{report:?}");
        assert!(writer.step(&step(2, 0.5)).is_err_and(|error| is_panic(&error)));
        let end = within(feed.next()).await;
        assert!(end.as_ref().is_err_and(is_panic), "{end:?}");
        let late = within(faulty.subscribe(POSITIONS, Delivery::Latest)).await;
        assert!(late.as_ref().is_err_and(is_panic), "{late:?}");

        let gone = engine.find("faulty").expect_err("the name is free");
        assert!(matches!(gone, Error::NotFound { .. }), "{gone}");
        let names = engine.list().iter().map(|scene| scene.name.clone()).collect::<Vec<_>>();
        assert_eq!(names, ["control"]);
        let device = &engine.shared.services.device;
        let unloaded = device.deform(faulty.id(), &Arc::new(modalcast_model::scene::SceneState::rest(&faulty.scene)));
        assert!(within(unloaded.wait()).await.is_err_and(|error| error.to_string().contains("not loaded")));
        assert!(is_done(&drive(&mut other, 2, 0.5).await), "the other scene goes on");
        let again = within(engine.open("strips", "faulty")).await.expect("opens again");
        assert_eq!(again.last_step().map(|step| step.number), Some(1), "with the step of its checkpoint");
        engine.shutdown().await;
    }

    #[tokio::test]
    async fn panicking_device_command_rejects_only_its_step() {
        let folder = tempfile::tempdir().expect("a folder");
        let (engine, faulty, control) = engine(folder.path()).await;
        let mut writer = faulty.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        let mut other = control.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        let rejected = drive(&mut writer, 1, InjectedFault::PanicInDeform.q()).await;
        assert!(matches!(rejected, Ok(StepReport::Rejected { step: 1, error: Error::Fault { .. } })), "{rejected:?}");
        assert!(is_done(&drive(&mut other, 1, 0.25).await));
        assert!(is_done(&drive(&mut writer, 2, 0.25).await), "the scene goes on");
        engine.shutdown().await;
    }

    #[tokio::test]
    async fn lost_device_fails_every_scene_and_refuses_new_ones() {
        let folder = tempfile::tempdir().expect("a folder");
        let (engine, faulty, control) = engine(folder.path()).await;
        let mut writer = faulty.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        let mut other = control.drive("test".into(), Policy::Lossless, 4).await.expect("a lease");
        let mut feed = control.subscribe(POSITIONS, Delivery::Latest).await.expect("subscribes");
        assert!(is_done(&drive(&mut other, 1, 0.25).await));
        within(feed.next()).await.expect("control: the device works");
        let rejected = drive(&mut writer, 1, InjectedFault::DeviceLost.q()).await;
        let lost = testing::device_lost();
        assert_eq!(rejected, Ok(StepReport::Rejected { step: 1, error: lost.clone() }));
        assert_eq!(within(writer.next_report()).await, Err(lost.clone()));
        assert_eq!(within(other.next_report()).await, Err(lost.clone()), "an idle scene fails, too");
        assert_eq!(within(feed.next()).await.expect_err("ends"), lost);
        assert_eq!(within(engine.device_lost()).await, lost);
        assert_eq!(engine.find("control").expect_err("refused"), lost);
        assert_eq!(within(engine.open("strips", "new")).await.expect_err("refused"), lost);
        within(engine.shutdown()).await;
    }
}
