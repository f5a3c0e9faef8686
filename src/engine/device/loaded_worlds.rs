//! The worlds of a batch of small views on the device thread: their deformer, and the renderer of their views. CUDA
//! computes both where it deforms scenes, else the CPU.

use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::context::{DeformerPreparer, PreparedDeformer};
use super::loaded_scene::{MAX_COORDINATE, is_in_range};
use crate::engine::output::output_spec::FrameOutput;
use crate::engine::output::vertex_encoding::into_bytes;
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_compute::gpu::{CudaDeformer, CudaViewRenderer, PinnedPool, ViewArrayLayout, ViewRing};
use modalcast_compute::reference::views::ReferenceViewRenderer;
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::deform::{DeformedSurface, Deformer, VertexAttributes};
use modalcast_model::error::{Error, Result, fault, invalid};
use modalcast_model::scene::{Scene, SceneState};
use modalcast_model::views::{View, ViewBatch, ViewCamera, ViewFormat, ViewScene, ViewVertices};

/// Views to draw of one state. Positions are relative to the origin of that state.
#[derive(Debug, Clone)]
pub(in crate::engine) struct ViewRequest {
    pub state: Arc<SceneState>,
    pub cameras: Arc<[ViewCamera]>,
    pub views: Vec<View>,
    pub format: ViewFormat,
    /// Where the pictures are drawn. `None`: they are copied to the host.
    pub target: Option<RingPlace>,
}

/// A place in the ring of exported device memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::engine) struct RingPlace {
    pub slot: usize,
    /// Index of the first view in the step, a multiple of 4.
    pub first_view: usize,
}

/// Exported device memory: the file of each slot, and the bytes of its allocation.
#[derive(Debug)]
pub struct ExportedSlots {
    pub files: Vec<(OwnedFd, u64)>,
    pub layout: ViewArrayLayout,
    /// UUID of the device.
    pub device: [u8; 16],
}

/// The pictures of some views of a step. [`modalcast_model::views::ViewOutputs`] has the shapes of the arrays.
#[derive(Debug)]
pub struct DrawnViews {
    /// An array for each output that was requested. Empty if the pictures are in exported memory.
    pub arrays: Vec<(FrameOutput, Bytes)>,
    pub stages: StageTimes,
}

/// The parts of worlds that another thread prepares.
pub(in crate::engine) struct PreparedWorlds {
    deformer: PreparedDeformer,
    renderer: ViewRenderer,
}

enum ViewRenderer {
    Cuda(Box<CudaViewRenderer>),
    Cpu(Box<ReferenceViewRenderer>),
}

/// Worlds that can be deformed and drawn.
pub(super) struct LoadedWorlds {
    /// All worlds as one scene.
    worlds: Arc<Scene>,
    /// Number of domains of one world.
    domains: usize,
    backend: WorldBackend,
    /// The state that the deformer's output shows. `None` before the first one, and after a state that was rejected.
    shown_state: Option<Arc<SceneState>>,
}

enum WorldBackend {
    Cuda(Box<CudaWorlds>),
    Cpu { deformer: Box<dyn Deformer>, renderer: Box<ReferenceViewRenderer> },
}

struct CudaWorlds {
    deformer: CudaDeformer,
    renderer: Box<CudaViewRenderer>,
    /// Memory of the pictures that are sent.
    pinned: PinnedPool,
    /// Memory of the pictures that stay on the device.
    ring: Option<Arc<ViewRing>>,
}

impl PreparedWorlds {
    /// Prepares the deformer of all worlds and the renderer of their views, whose static data are those of one world.
    ///
    /// # Errors
    /// `Fault` of the device; `Unavailable` when its memory is too small.
    pub(super) fn new(preparer: &DeformerPreparer, worlds: &Arc<Scene>, views: ViewScene) -> Result<Self> {
        let deformer = preparer.prepare(worlds, BatchPolicy::default())?;
        let renderer = match (&deformer, preparer.cuda_device()) {
            (PreparedDeformer::Cuda(_), Some(device)) => {
                ViewRenderer::Cuda(Box::new(CudaViewRenderer::new(device, &views)?))
            }
            _ => ViewRenderer::Cpu(Box::new(ReferenceViewRenderer::new(views)?)),
        };
        Ok(Self { deformer, renderer })
    }
}

impl LoadedWorlds {
    /// Completes prepared worlds. `domains`: number of domains of one world.
    ///
    /// # Errors
    /// `Fault` when the device fails or its memory is too small.
    pub(super) fn new(worlds: &Arc<Scene>, domains: usize, prepared: PreparedWorlds) -> Result<Self> {
        let backend = match (prepared.deformer, prepared.renderer) {
            (PreparedDeformer::Cuda(deformer), ViewRenderer::Cuda(renderer)) => {
                let deformer = CudaDeformer::from_prepared(*deformer, None)?;
                WorldBackend::Cuda(Box::new(CudaWorlds {
                    deformer,
                    renderer,
                    pinned: PinnedPool::default(),
                    ring: None,
                }))
            }
            (PreparedDeformer::Complete(deformer), ViewRenderer::Cpu(renderer)) => {
                WorldBackend::Cpu { deformer, renderer }
            }
            _ => return Err(fault("views", "expected one backend for deformer and renderer")),
        };
        Ok(Self { worlds: Arc::clone(worlds), domains, backend, shown_state: None })
    }

    /// Deforms the worlds unless they show the state, and draws the views.
    ///
    /// # Errors
    /// `Invalid` naming the domain and the world whose vertices overflow; `Invalid` for an invalid batch; `Fault` of the
    /// device.
    pub(super) fn draw(&mut self, request: &ViewRequest) -> Result<DrawnViews> {
        let mut stages = StageTimes::new();
        if !self.shown_state.as_ref().is_some_and(|shown| Arc::ptr_eq(shown, &request.state)) {
            let begin = Instant::now();
            self.deform(&request.state)?;
            stages.push((Stage::Deform, ms_since(begin)));
        }
        let begin = Instant::now();
        let batch = ViewBatch { cameras: &request.cameras, views: &request.views, format: request.format };
        let arrays = match (&mut self.backend, request.target) {
            (WorldBackend::Cuda(worlds), Some(place)) => worlds.draw_in_ring(&batch, place).map(|()| vec![]),
            (WorldBackend::Cuda(worlds), None) => worlds.draw(&batch),
            (WorldBackend::Cpu { deformer, renderer }, None) => draw_on_cpu(&mut **deformer, renderer, &batch),
            (WorldBackend::Cpu { .. }, Some(_)) => Err(no_ring_error()),
        }?;
        stages.push((Stage::Draw, ms_since(begin)));
        Ok(DrawnViews { arrays, stages })
    }

    /// Allocates a ring of exported device memory, in which later requests can have a place.
    ///
    /// # Errors
    /// `Unavailable` without CUDA, or if the device cannot export memory; `Fault` when its memory is too small.
    pub(super) fn export_ring(
        &mut self,
        slot_count: usize,
        format: &ViewFormat,
        views: usize,
    ) -> Result<ExportedSlots> {
        let unavailable = |reason: String| Error::Unavailable {
            what: "device memory for views",
            reason,
            remedy: "Receive the views in host memory".into(),
        };
        let WorldBackend::Cuda(worlds) = &mut self.backend else {
            return Err(unavailable("the server draws views on the CPU".into()));
        };
        let CudaWorlds { renderer, ring, .. } = &mut **worlds;
        let device = renderer.device();
        let new_ring = ViewRing::new(device, slot_count, format, views).map_err(|error| match error {
            error if error.is_loss() => error,
            error => unavailable(error.to_string()),
        })?;
        let files = new_ring.export()?;
        let device = device.uuid()?;
        *ring = Some(Arc::new(new_ring));
        Ok(ExportedSlots { files, layout: ViewArrayLayout::new(format, views), device })
    }

    fn deform(&mut self, state: &Arc<SceneState>) -> Result<()> {
        self.shown_state = None;
        if !is_in_range(&self.backend.deformer().deform(state)?.bounds) {
            return Err(self.overflow_error()?);
        }
        self.shown_state = Some(Arc::clone(state));
        Ok(())
    }

    /// The error that names the domain and the world of the first vertex out of range.
    fn overflow_error(&mut self) -> Result<Error> {
        let Self { worlds, domains, backend, .. } = self;
        let attributes = VertexAttributes { positions: true, ..VertexAttributes::default() };
        let positions = &backend.deformer().surface_with(attributes)?.positions;
        let is_out_of_range = |number: &f32| number.is_nan() || f64::from(*number).abs() > MAX_COORDINATE;
        let vertex = positions.iter().position(is_out_of_range).unwrap_or(0) / 3;
        let domain = worlds.layout.domains.partition_point(|layout| layout.first_vertex <= vertex).saturating_sub(1);
        let given =
            format!("a vertex of domain '{}' of world {} out of range", worlds.domains[domain].name, domain / *domains);
        Ok(invalid("step.q", format!("q and transforms that keep every vertex within {MAX_COORDINATE:e}"), given))
    }
}

impl WorldBackend {
    fn deformer(&mut self) -> &mut dyn Deformer {
        match self {
            Self::Cuda(worlds) => &mut worlds.deformer,
            Self::Cpu { deformer, .. } => &mut **deformer,
        }
    }
}

fn no_ring_error() -> Error {
    fault("views", "expected a ring of device memory")
}

impl CudaWorlds {
    /// Draws, and copies the pictures to the host.
    fn draw(&mut self, batch: &ViewBatch<'_>) -> Result<Vec<(FrameOutput, Bytes)>> {
        let mut views = self.renderer.prepare(batch)?;
        self.renderer.draw(&self.deformer.device_vertices()?, &mut views)?;
        let arrays = views.read_pinned(self.renderer.device(), &mut self.pinned)?;
        let arrays = outputs_of(&batch.format).into_iter().zip(arrays);
        Ok(arrays.filter_map(|(output, array)| Some((output, Bytes::from_owner(array?)))).collect())
    }

    /// Draws into the ring, and waits for the pictures.
    fn draw_in_ring(&mut self, batch: &ViewBatch<'_>, place: RingPlace) -> Result<()> {
        let ring = self.ring.as_ref().ok_or_else(no_ring_error)?;
        let mut views = self.renderer.prepare_in_ring(batch, ring, place.slot, place.first_view)?;
        self.renderer.draw(&self.deformer.device_vertices()?, &mut views)?;
        self.renderer.device().synchronize("views")
    }
}

fn draw_on_cpu(
    deformer: &mut dyn Deformer,
    renderer: &ReferenceViewRenderer,
    batch: &ViewBatch<'_>,
) -> Result<Vec<(FrameOutput, Bytes)>> {
    let DeformedSurface { positions, normals, tangents, .. } = deformer.surface()?;
    let pictures = renderer.draw(&ViewVertices { positions, normals, tangents }, batch)?;
    let arrays = [
        into_bytes(pictures.color),
        into_bytes(pictures.depth),
        into_bytes(pictures.domains),
        into_bytes(pictures.normals),
    ];
    let arrays = outputs_of(&batch.format).into_iter().zip(arrays);
    Ok(arrays.filter(|(_, array)| !array.is_empty()).collect())
}

/// The outputs of color, depth, domains and normals.
const fn outputs_of(format: &ViewFormat) -> [FrameOutput; 4] {
    let depth = if format.depth_includes_ground { FrameOutput::DepthWithGround } else { FrameOutput::Depth };
    [FrameOutput::Color, depth, FrameOutput::Domains, FrameOutput::Normals]
}
