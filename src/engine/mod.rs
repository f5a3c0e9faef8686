//! The engine: loads scenes, applies steps to them, and produces frames, picks and vertices. It runs one device thread
//! and one task per open scene, and persists uploads, the list of open scenes and their last steps across restarts.
//!
//! A scene's task serializes all operations on the scene (`conductor`). A writer sends steps through a bounded queue
//! (`lane`) and a subscriber receives results through a bounded channel (`viewer`). Exceeding a bound, or blocking the
//! writer for too long, yields an error that names the limit.

mod blocking;
mod command;
mod conductor;
mod desk;
mod encoded_feed;
mod frame_encoder;
mod host;
mod keep;
mod lane;
mod late;
mod ledger;
mod pack;
mod picked;
mod registry;
mod show;
mod source;
mod staged;
#[cfg(test)]
mod testing;
mod upload;
mod values;
mod viewer;
mod workbench;
mod worker;

pub use conductor::Which;
pub use encoded_feed::EncodedFeed;
pub use frame_encoder::{ColorFrame, Encoded, Format, FrameEncoder};
pub use host::{Drive, Host};
pub use lane::{Policy, Report};
pub use ledger::{Origin, checked_name};
pub use pack::{Packed, Selection, checked_domains, pack_vertices};
pub use picked::{Picked, Picks, resolve_picks};
pub use source::SceneSource;
pub use staged::Staged;
pub use upload::{Announcement, Upload};
pub use values::checked_mode;
pub use viewer::{Body, Delivery, Feed, Showing, Shown, StepName, View};
pub use workbench::{Info, Workbench};

pub use modalcast_render::{Path, Paths};

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use tokio::sync::Semaphore;

use self::blocking::run_blocking;
use self::conductor::Means;
use self::host::Opening;
use self::keep::Keeper;
use self::ledger::Ledger;
use self::registry::Registry;
use self::worker::Worker;
use crate::config::Config;
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::Scene;

/// Scenes that are read from disk concurrently.
const LOADS: usize = 2;

/// Uploads that may be in progress at a time.
const UPLOADS: usize = 8;

/// Handle to the engine. A clone is shallow: all clones share one device thread and one set of scenes.
#[derive(Clone)]
pub struct Engine {
    shared: Arc<Shared>,
}

struct Shared {
    config: Arc<Config>,
    source: Arc<dyn SceneSource>,
    info: Info,
    encoder: FrameEncoder,
    means: Means,
    registry: Registry,
    loads: Semaphore,
    uploads: Arc<Semaphore>,
    next_id: AtomicU64,
    stopping: AtomicBool,
    device: Mutex<Option<JoinHandle<()>>>,
    // Last field, so that its lock on the state folder is released only after every writer above is dropped.
    ledger: Ledger,
}

impl Engine {
    /// Opens the state folder and the devices, then reopens every scene in the folder's list of open scenes.
    ///
    /// # Errors
    /// `Unavailable` when a backend requested by name cannot be opened, or another server uses the state folder.
    pub async fn start(config: Config, source: Arc<dyn SceneSource>) -> Result<Self> {
        let config = Arc::new(config);
        let state = config.state.clone();
        let (ledger, keeper) = run_blocking("state folder", move || {
            let ledger = Ledger::open(&state)?;
            let keeper = Keeper::start(ledger.steps())?;
            Ok((ledger, Arc::new(keeper)))
        })
        .await?;
        let (worker, info, device) = Worker::start(&config).await?;
        let shared = Shared {
            means: Means { worker, keeper, config: Arc::clone(&config) },
            registry: Registry::new(config.open_scenes),
            config,
            source,
            info,
            encoder: FrameEncoder::per_core(),
            loads: Semaphore::new(LOADS),
            uploads: Arc::new(Semaphore::new(UPLOADS)),
            next_id: AtomicU64::new(1),
            stopping: AtomicBool::new(false),
            device: Mutex::new(Some(device)),
            ledger,
        };
        let engine = Self { shared: Arc::new(shared) };
        engine.restore().await;
        Ok(engine)
    }

    /// The backend that deforms and the renderer that draws.
    pub fn info(&self) -> &Info {
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
    pub async fn open(&self, source: &str, name: &str) -> Result<Arc<Host>> {
        let name = if name.is_empty() { ledger::own_name(source)? } else { checked_name(name)?.to_owned() };
        self.admit(name, Origin::Repository { source: source.into() }, None).await
    }

    /// The open scene with this name.
    ///
    /// # Errors
    /// `NotFound` when no open scene has this name, `Unavailable` when the server is shutting down.
    pub fn find(&self, name: &str) -> Result<Arc<Host>> {
        if self.is_stopping() {
            return Err(stopping());
        }
        self.shared.registry.find(name)
    }

    /// All open scenes, sorted by name.
    pub fn list(&self) -> Vec<Arc<Host>> {
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
    pub async fn begin_upload(&self, announced: Announcement) -> Result<Upload> {
        checked_name(&announced.scene)?;
        let config = &self.shared.config;
        if announced.files == 0 || announced.files > config.upload_files {
            return Err(invalid("header.files", format!("1 to {}", config.upload_files), announced.files));
        }
        if announced.total_bytes > config.upload_bytes {
            let expected = format!("at most {}", config.upload_bytes);
            return Err(invalid("header.total_bytes", expected, announced.total_bytes));
        }
        self.shared.registry.check_free(&announced.scene)?;
        let full = |_| Error::Busy { queue: "uploads under way", limit: UPLOADS };
        let place = Arc::clone(&self.shared.uploads).try_acquire_owned().map_err(full)?;
        let uploads = config.state.join("uploads");
        run_blocking("upload", move || Upload::begin(&uploads, announced, place)).await
    }

    /// Opens a complete upload as a scene. On failure the uploaded files are removed.
    ///
    /// # Errors
    /// `Invalid` naming the missing or malformed file; `Taken` when the name was claimed in the meantime.
    pub async fn finish_upload(&self, mut upload: Upload) -> Result<Arc<Host>> {
        upload.finish()?;
        let (name, entry) = (upload.announced.scene.clone(), upload.announced.entry.clone());
        self.admit(name, Origin::Upload { entry }, Some(upload)).await
    }

    /// Closes a scene and ends its streams; removes its persisted step and, for an upload, its files.
    ///
    /// # Errors
    /// `NotFound` when the name is neither open nor in the list of open scenes, `Busy` while the scene is being opened.
    pub async fn close(&self, name: &str) -> Result<()> {
        let engine = self.clone();
        let name = checked_name(name)?.to_owned();
        // A separate task, so that closing completes even if the caller is cancelled.
        let work = async move { engine.close_whole(&name).await };
        tokio::spawn(work).await.map_err(modalcast_model::error::during("close"))?
    }

    /// Ends every stream with `Unavailable`, writes outstanding checkpoints, joins the device thread and releases the
    /// state folder.
    pub async fn shutdown(&self) {
        if self.shared.stopping.swap(true, Ordering::AcqRel) {
            return;
        }
        for host in self.list() {
            host.stop(stopping()).await;
        }
        let engine = self.clone();
        let finish = move || {
            engine.shared.means.keeper.finish();
            let device = engine.shared.device.lock().unwrap_or_else(PoisonError::into_inner).take();
            engine.shared.means.worker.quit();
            device.map(JoinHandle::join);
            engine.shared.ledger.release();
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

    async fn restore(&self) {
        let mut openings = tokio::task::JoinSet::new();
        for (name, origin) in self.shared.ledger.entries() {
            let engine = self.clone();
            openings.spawn(async move {
                if let Err(error) = engine.admit(name.clone(), origin, None).await {
                    // The entry remains in the list, because the files may be available again at the next start.
                    tracing::warn!(scene = name, %error, "a kept scene could not be opened");
                }
            });
        }
        openings.join_all().await;
    }

    /// Opens a scene, once for all concurrent callers. Runs in a separate task, so that a cancelled caller does not
    /// cancel the opening.
    async fn admit(&self, name: String, origin: Origin, upload: Option<Upload>) -> Result<Arc<Host>> {
        if self.is_stopping() {
            return Err(stopping());
        }
        let engine = self.clone();
        let work = async move {
            let seat = engine.shared.registry.seat(&name, &origin, upload.is_some())?;
            let opened = seat.open(|| engine.host(name.clone(), origin, upload)).await;
            engine.shared.registry.leave(&name, &seat);
            opened
        };
        tokio::spawn(work).await.map_err(modalcast_model::error::during("open"))?
    }

    async fn host(&self, name: String, origin: Origin, upload: Option<Upload>) -> Result<Arc<Host>> {
        let is_new_upload = upload.is_some();
        let hosted = self.load_and_stage(&name, &origin, upload).await;
        if hosted.is_err() && is_new_upload {
            let place = self.shared.ledger.upload(&name);
            run_blocking("upload", move || Ok(std::fs::remove_dir_all(place).ok())).await?;
        }
        hosted.map(Arc::new)
    }

    async fn load_and_stage(&self, name: &str, origin: &Origin, upload: Option<Upload>) -> Result<Host> {
        let scene = self.load(name, origin, upload).await?;
        let (engine, key, kept) = (self.clone(), name.to_owned(), Arc::clone(&scene));
        let state = run_blocking("kept step", move || Ok(engine.shared.means.keeper.load(&key, &kept))).await?;
        let state = state.unwrap_or_else(|error| {
            tracing::warn!(scene = name, %error, "the scene begins at rest");
            None
        });
        let opening = Opening {
            name: name.into(),
            origin: origin.clone(),
            scene,
            id: self.shared.next_id.fetch_add(1, Ordering::Relaxed),
            state,
            no_frames: self.shared.info.renderer.as_ref().err().cloned(),
        };
        let host = Host::open(opening, self.shared.means.clone()).await?;
        let (engine, key, origin) = (self.clone(), name.to_owned(), origin.clone());
        if let Err(error) = run_blocking("scenes.json", move || engine.shared.ledger.add(&key, &origin)).await {
            host.stop(error.clone()).await;
            return Err(error);
        }
        let layout = &host.scene.layout;
        tracing::info!(scene = name, domains = layout.slots.len(), vertices = layout.vertices, "opened");
        Ok(host)
    }

    /// Reads a scene's files. A panic in a loader becomes a `Fault` of this call.
    async fn load(&self, name: &str, origin: &Origin, upload: Option<Upload>) -> Result<Arc<Scene>> {
        let stopped = |_| stopping();
        let _permit = self.shared.loads.acquire().await.map_err(stopped)?;
        let source = Arc::clone(&self.shared.source);
        let place = self.shared.ledger.upload(name);
        let (engine, key, origin) = (self.clone(), name.to_owned(), origin.clone());
        let read = move || match origin {
            Origin::Repository { source: path } => source.open(&path),
            Origin::Upload { entry } => {
                if let Some(upload) = upload {
                    // A checkpoint of an older scene with this name does not apply to the new one.
                    engine.shared.means.keeper.forget(&key);
                    upload.settle(&place)?;
                }
                source.open_within(&place, &entry)
            }
        };
        run_blocking("load", read).await
    }

    async fn close_whole(&self, name: &str) -> Result<()> {
        let seat = self.shared.registry.seat_of(name);
        match seat.as_ref().map(|seat| seat.host()) {
            Some(Some(host)) if host.is_closing() => return Err(not_open(name)),
            Some(Some(host)) => host.stop(not_open(name)).await,
            Some(None) => return Err(Error::Busy { queue: "the name of a scene that is being opened", limit: 1 }),
            None => {}
        }
        let (engine, key) = (self.clone(), name.to_owned());
        let removed = run_blocking("close", move || {
            engine.shared.means.keeper.forget(&key);
            std::fs::remove_dir_all(engine.shared.ledger.upload(&key)).ok(); // Only uploads have a folder.
            engine.shared.ledger.remove(&key)
        })
        .await;
        // The name is released only after the files are removed, so that a new upload under it does not lose its files.
        // It is released even if the list could not be written.
        if let Some(seat) = &seat {
            self.shared.registry.remove(name, seat);
        }
        let was_kept = removed?;
        if seat.is_some() || was_kept { Ok(()) } else { Err(not_open(name)) }
    }
}

fn not_open(name: &str) -> Error {
    Error::NotFound { what: "scene", given: format!("'{name}'") }
}

fn stopping() -> Error {
    Error::Unavailable { what: "server", reason: "it stops".into(), remedy: "Try again when it is back".into() }
}
