//! Batches of small views: the worlds of one caller, which are copies of an open scene with a state of their own, and the
//! pictures of them. Worlds count as memory of their caller, and take turns on the device thread like a scene.

mod piece_size;
mod settings;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::atomic::Ordering;

pub use self::settings::{Pairing, ViewSettings};

use self::piece_size::PieceSize;
use super::Engine;
use super::blocking::run_blocking;
use super::device::command::SceneId;
use super::device::handle::{DeviceHandle, PendingReply};
use super::device::loaded_scene::uniform_origin;
use super::device::loaded_worlds::{DrawnViews, ExportedSlots, RingPlace, ViewRequest};
use super::scene::handle::SceneHandle;
use super::scene_memory::SceneMemory;
use crate::admission::{Account, Permit};
use crate::telemetry::Stage;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{BoundingBox, Camera, RawStepUpdate, Scene, SceneState, StepUpdate};
use modalcast_model::views::{ViewCamera, ViewFormat};
use modalcast_render::FrameParams;
use modalcast_render::view_data::{view_camera, view_scene};

/// Bytes of a step and of the state, and number of cameras, up to which the calling thread prepares a step itself.
const INLINE_STEP_BYTES: usize = 1 << 20;
const INLINE_CAMERAS: usize = 1024;

/// Largest number of slots of exported device memory of a session.
const MAX_DEVICE_SLOTS: usize = 16;

/// The worlds of one caller. Dropping them frees their memory.
pub struct ViewSession {
    shared: Arc<Worlds>,
    /// What the last accepted step shows.
    shown: Shown,
    piece_size: PieceSize,
    on_device: WorldsOnDevice,
}

/// The parts of a session that no step changes.
struct Worlds {
    /// One world.
    scene: Arc<Scene>,
    /// All worlds as one scene.
    all: Arc<Scene>,
    settings: ViewSettings,
}

/// A state of all worlds, and the cameras that see it.
#[derive(Clone)]
struct Shown {
    state: Arc<SceneState>,
    cameras: Arc<[Camera]>,
    /// The origin of all positions of the state, in scene units.
    origin: [f64; 3],
    /// The cameras relative to the origin.
    view_cameras: Arc<[ViewCamera]>,
}

/// New values for the worlds of a session.
#[derive(Debug, Default)]
pub struct ViewUpdate {
    pub step: RawStepUpdate,
    /// As many as before; empty if they do not change.
    pub cameras: Vec<Camera>,
    /// Only the views of the first worlds are drawn; 0: of all.
    pub drawn_worlds: usize,
}

/// A step whose views can be drawn.
pub struct ViewStep {
    shown: Shown,
    views: usize,
    /// Number of views whose drawing has been started.
    started: usize,
    /// The slot of exported device memory for the pictures.
    slot: Option<usize>,
}

/// Worlds on the device thread.
struct WorldsOnDevice {
    device: DeviceHandle,
    id: SceneId,
    /// Held until the device has unloaded the worlds.
    resources: Option<(SceneMemory, Permit)>,
}

impl Drop for WorldsOnDevice {
    fn drop(&mut self) {
        let (device, id, resources) = (self.device.clone(), self.id, self.resources.take());
        let unload = async move {
            // Fails only if the device thread has ended, which frees the worlds, too.
            device.unload_scene(id).await.ok();
            drop(resources);
        };
        // Without a runtime, the process ends.
        if let Ok(runtime) = tokio::runtime::Handle::try_current() {
            runtime.spawn(unload);
        }
    }
}

impl Engine {
    /// Loads worlds for an account. Waits until the account may load a scene. The work runs in a separate task, so that
    /// what it has reserved remains reserved until it ends, also if the caller is cancelled.
    ///
    /// # Errors
    /// `Invalid` for settings out of range, and for a scene with features that views do not have; `LimitReached`;
    /// `OutOfMemory` before memory is taken; `Fault` of the device.
    pub async fn open_views(
        &self,
        scene_handle: &SceneHandle,
        account: &Account,
        settings: ViewSettings,
    ) -> Result<ViewSession> {
        settings.check()?;
        let permit = self.shared.view_calls.acquire(account)?;
        let (scene, name) = (Arc::clone(&scene_handle.scene), scene_handle.name.clone());
        let (engine, account) = (self.clone(), account.clone());
        let load = async move { engine.load_views(&name, scene, &account, settings, permit).await };
        tokio::spawn(load).await.map_err(fault_in("views"))?
    }

    async fn load_views(
        &self,
        name: &str,
        scene: Arc<Scene>,
        account: &Account,
        settings: ViewSettings,
        permit: Permit,
    ) -> Result<ViewSession> {
        let memory = self.shared.memory.new_scene(account.principal.as_deref().unwrap_or_default());
        memory.reserve_worlds(name, &scene, settings.worlds, settings.piece_bytes())?;
        let turn = self.shared.loads.member(account).acquire(1).await?;
        let build = move || {
            let (static_data, all) = (view_scene(&scene)?, scene.worlds(settings.worlds)?);
            let (state, cameras) = (Arc::new(SceneState::rest(&all)), Arc::clone(&settings.cameras));
            let view_cameras = view_cameras(&scene, &settings.format, &cameras, [0.0; 3])?;
            let shown = Shown { state, cameras, origin: [0.0; 3], view_cameras };
            Ok((static_data, shown, Worlds { scene, all, settings }))
        };
        let (static_data, shown, worlds) = run_blocking("worlds", build).await?;
        // The work has no scene's name: a crash in these copies must not make the crash log set the scene aside.
        let id = self.shared.next_scene_id.fetch_add(1, Ordering::Relaxed);
        let device = self.shared.services.device.clone();
        let on_device = WorldsOnDevice { device, id, resources: Some((memory, permit)) };
        on_device.device.load_worlds(id, &worlds.all, worlds.scene.domains.len(), static_data).await?;
        drop(turn);
        let piece_size = PieceSize::new(worlds.settings.max_piece_views());
        Ok(ViewSession { piece_size, shared: Arc::new(worlds), shown, on_device })
    }
}

impl ViewSession {
    pub fn settings(&self) -> &ViewSettings {
        &self.shared.settings
    }

    /// One world.
    pub fn scene(&self) -> &Scene {
        &self.shared.scene
    }

    /// Computes the state and the cameras after an update. The session changes only with [`Self::accept`].
    ///
    /// # Errors
    /// `Invalid` with the field.
    pub async fn prepare(&self, update: ViewUpdate) -> Result<ViewStep> {
        let (shared, shown) = (Arc::clone(&self.shared), self.shown.clone());
        // The state is copied, and all cameras may have to be converted.
        let state_bytes = size_of_val(&shown.state.q[..]) + size_of_val(&shown.state.transforms[..]);
        let is_small = update.step.q.len() + update.step.transforms.len() + state_bytes <= INLINE_STEP_BYTES
            && shown.cameras.len() <= INLINE_CAMERAS;
        match is_small {
            true => shared.step(shown, update),
            false => run_blocking("views", move || shared.step(shown, update)).await,
        }
    }

    /// Starts drawing the next views of a step, as many as the device draws without a long break of other work. `None`
    /// if all are started.
    pub fn draw_next(&self, step: &mut ViewStep) -> Option<PendingViews> {
        let (first, settings) = (step.started, &self.shared.settings);
        let piece = match step.slot {
            // Each place in a slot is a multiple of 4.
            Some(_) => self.piece_size.get().next_multiple_of(4),
            None => self.piece_size.get(),
        };
        let count = piece.min(step.views - first);
        if count == 0 {
            return None;
        }
        step.started += count;
        let request = ViewRequest {
            state: Arc::clone(&step.shown.state),
            cameras: Arc::clone(&step.shown.view_cameras),
            views: (first..first + count).map(|view| settings.view(view)).collect(),
            format: settings.format,
            target: step.slot.map(|slot| RingPlace { slot, first_view: first }),
        };
        let reply = self.on_device.device.draw_views(self.on_device.id, request);
        Some(PendingViews { first, count, reply })
    }

    /// Makes a step the last one of the session. The caller has seen its first pictures.
    pub fn accept(&mut self, step: &ViewStep) {
        self.shown = step.shown.clone();
    }

    /// Adapts the number of views that are drawn without a break to the time of drawing such a piece.
    pub fn record_piece(&mut self, count: usize, drawn: &DrawnViews) {
        let times = drawn.stages.iter().filter(|(stage, _)| *stage == Stage::Draw);
        self.piece_size.record(count, times.map(|(_, ms)| ms).sum());
    }
}

impl ViewSession {
    /// Allocates slots of exported device memory, each for the pictures of all views.
    ///
    /// # Errors
    /// `Invalid` for a number of slots out of range; `OutOfMemory`; `Unavailable` if the device cannot export memory.
    pub async fn export(&self, slot_count: usize) -> Result<Arc<ExportedSlots>> {
        if !(1..=MAX_DEVICE_SLOTS).contains(&slot_count) {
            return Err(invalid("device_slots", format!("1 to {MAX_DEVICE_SLOTS}"), slot_count));
        }
        let WorldsOnDevice { device, id, resources } = &self.on_device;
        let settings = &self.shared.settings;
        if let Some((memory, _)) = resources {
            let bytes = settings.views() as u64 * settings.view_bytes() as u64 * slot_count as u64;
            memory.reserve_pictures(&format!("{slot_count} slots of {} views", settings.views()), bytes)?;
        }
        device.export_ring(*id, slot_count, settings.format, settings.views()).await
    }
}

impl ViewStep {
    /// Draws the pictures into a slot of exported device memory.
    pub const fn draw_into(&mut self, slot: usize) {
        self.slot = Some(slot);
    }
}

impl Worlds {
    fn step(&self, shown: Shown, update: ViewUpdate) -> Result<ViewStep> {
        let Self { scene, all, settings } = self;
        let views = settings.drawn_views(update.drawn_worlds)?;
        let parsed = StepUpdate::parse(all, &update.step)?;
        let mut state = SceneState::clone(&shown.state);
        state.apply(all, &parsed);
        let origin = uniform_origin(state.origins.as_ref()).ok_or_else(|| {
            let expected = "positions of all worlds within reach of one origin for f32";
            invalid("step.transforms", expected, "worlds that are too far apart")
        })?;
        let cameras = match update.cameras.len() {
            0 => Arc::clone(&shown.cameras),
            count if count == shown.cameras.len() => update.cameras.into(),
            count => return Err(invalid("cameras", format!("{} cameras", shown.cameras.len()), count)),
        };
        let are_equal = Arc::ptr_eq(&cameras, &shown.cameras) && origin == shown.origin;
        let view_cameras = match are_equal {
            true => shown.view_cameras,
            false => view_cameras(scene, &settings.format, &cameras, origin)?,
        };
        Ok(ViewStep {
            shown: Shown { state: Arc::new(state), cameras, origin, view_cameras },
            views,
            started: 0,
            slot: None,
        })
    }
}

/// The cameras as the kernels use them, for positions relative to `origin`. Ground and near plane are those of the rest
/// bounds of one world.
fn view_cameras(scene: &Scene, format: &ViewFormat, cameras: &[Camera], origin: [f64; 3]) -> Result<Arc<[ViewCamera]>> {
    let relative = |corner: [f64; 3]| std::array::from_fn(|axis| corner[axis] - origin[axis]);
    let BoundingBox { min, max } = scene.rest_bounds;
    let bounds = BoundingBox { min: relative(min), max: relative(max) };
    let (width, height) = (format.width, format.height);
    let convert = |(index, camera): (usize, &Camera)| {
        let params =
            FrameParams { camera: *camera, width, height, bounds, light_bounds: None, edges: None, samples: Some(1) };
        view_camera(scene, &params, origin).map_err(|error| error.in_message(&format!("cameras[{index}]")))
    };
    cameras.iter().enumerate().map(convert).collect()
}

/// Views that are being drawn.
#[derive(Debug)]
pub struct PendingViews {
    /// Index of the first view in the step.
    pub first: usize,
    pub count: usize,
    reply: PendingReply<Arc<DrawnViews>>,
}

impl PendingViews {
    /// Waits for the pictures. Cancel-safe.
    ///
    /// # Errors
    /// `Invalid` if the step moves a vertex out of range; `Fault` of the device.
    pub async fn wait(&self) -> Result<Arc<DrawnViews>> {
        self.reply.wait().await
    }
}
