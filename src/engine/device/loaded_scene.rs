//! A scene loaded on the device thread: its deformer, its OpenGL buffers (created on first use), and the last valid
//! state.

use std::num::NonZero;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::time::Instant;

use super::frame_log::FrameLog;
use super::scalar_field;
use crate::engine::output::output_spec::FrameOutput;
use crate::frame::{Legend, encode_png};
use crate::telemetry::ms_since;
use modalcast_model::deform::{DeformSummary, DeformedSurface, Deformer, SharedStep, VertexAttributes, VertexReadback};
use modalcast_model::error::{Error, Result, fault, invalid};
use modalcast_model::fault_injection::{self, InjectionPoint};
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{
    BoundingBox, Camera, FloatingOrigins, FrameBounds, FrameSize, OrientedBounds, Scene, SceneState,
};
use modalcast_render::{
    FrameInfo, FrameParams, FramePixels, PendingFrame, Renderer, SceneBuffers, SharedFrame, TrialScene,
};

/// Positions beyond this bound (scene units) are rejected like infinite ones, because their squares overflow f32 in the
/// shaders.
pub(super) const MAX_COORDINATE: f64 = 1e18;

/// Size of the frames that are measured to choose between the rasterizers.
const BENCHMARK_SIZE: FrameSize = FrameSize::new(1920, 1080);

/// Bounds of the vertices that the buffers hold, in the coordinate frame in which the camera draws them.
#[derive(Debug, Clone, Copy)]
pub(in crate::engine) struct BufferContents {
    bounds: BoundingBox,
    /// Bounds of the vertices in light space. `None` if the positions were rebased to an origin near the camera,
    /// because the deformer computes these bounds relative to the domains' floating origins (the f64 points that their
    /// f32 positions are relative to).
    light_bounds: Option<OrientedBounds>,
    /// Whether vertices had to be uploaded to fill the buffers.
    pub(in crate::engine) is_uploaded: bool,
}

impl BufferContents {
    /// The parameters of a frame of these buffers.
    pub(in crate::engine) const fn frame_params(&self, camera: Camera, size: FrameSize) -> FrameParams {
        let FrameSize { width, height } = size;
        FrameParams {
            camera,
            width,
            height,
            bounds: self.bounds,
            light_bounds: self.light_bounds,
            edges: None,
            samples: None,
        }
    }
}

/// A scene that can be deformed and drawn.
pub struct LoadedScene {
    scene: Arc<Scene>,
    deformer: Box<dyn Deformer>,
    buffers: Option<SceneBuffers>,
    /// Whether the buffers hold the vertices of the last deformation.
    buffers_are_current: bool,
    bounds: BoundingBox,
    /// Bounds of the same vertices in light space. `None` if the scene has no shadow.
    light_bounds: Option<OrientedBounds>,
    /// The state that the deformer's output shows.
    current_state: Arc<SceneState>,
    /// Number of deformations. Includes rejected states and the deformations that undo them, because each deformation
    /// changes the content of the buffers.
    generation: u64,
    /// The color map whose values are in the buffers, and its legend.
    cached_color_map: Option<(FrameOutput, Legend)>,
    frame_log: FrameLog,
    /// Whether CUDA encodes frames of the scene as PNG on request.
    encodes_on_cuda: bool,
}

impl LoadedScene {
    /// A scene whose vertices are not computed yet. [`Self::deform_rest`] must be called before any other method.
    pub(in crate::engine) fn new(
        scene: &Arc<Scene>,
        deformer: Box<dyn Deformer>,
        buffers: Option<SceneBuffers>,
    ) -> Self {
        let current_state = Arc::new(SceneState::rest(scene));
        Self {
            scene: Arc::clone(scene),
            deformer,
            buffers,
            buffers_are_current: false,
            bounds: scene.rest_bounds,
            light_bounds: None,
            current_state,
            generation: 0,
            cached_color_map: None,
            frame_log: FrameLog::default(),
            encodes_on_cuda: false,
        }
    }

    /// Deforms the scene to the rest state.
    ///
    /// # Errors
    /// `Invalid` when the rest state overflows; `Fault` of the device.
    pub(in crate::engine) fn deform_rest(&mut self) -> Result<()> {
        let deformed = self.run_deformer(&Arc::clone(&self.current_state))?;
        if !is_in_range(&deformed.bounds) {
            let expected = format!("vertices within {MAX_COORDINATE:e}");
            return Err(invalid("scene.rest", expected, format!("{:?}", deformed.bounds)));
        }
        self.set_bounds(&deformed);
        Ok(())
    }

    /// The scene.
    pub const fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// Bounds of the drawn vertices of the last deformation in scene units, each domain relative to its floating
    /// origin. Always finite.
    pub const fn bounds(&self) -> BoundingBox {
        self.bounds
    }

    /// The state of the last deformation.
    pub(in crate::engine) const fn current_state(&self) -> &Arc<SceneState> {
        &self.current_state
    }

    /// Announces the state that probably follows the one of the next [`Self::deform`] ([`Deformer::announce`]).
    pub fn announce(&mut self, following: &Arc<SceneState>) {
        self.deformer.announce(following);
    }

    /// Deforms the scene to a state. Rejects the state if a vertex is not finite or beyond 1e18 units. The previous
    /// state is then deformed again, so that no reader sees the rejected one.
    ///
    /// # Errors
    /// `Invalid` naming the domain whose vertices overflow; `Fault` of the device.
    pub fn deform(&mut self, state: &SceneState) -> Result<DeformSummary> {
        self.deform_shared(&Arc::new(state.clone()))
    }

    /// [`Self::deform`] without a copy of the state.
    ///
    /// # Errors
    /// As [`Self::deform`].
    pub fn deform_shared(&mut self, state: &Arc<SceneState>) -> Result<DeformSummary> {
        self.buffers_are_current = false;
        let result = catch_unwind(AssertUnwindSafe(|| self.run_deformer(state)));
        let is_restorable = match &result {
            Ok(Ok(_)) => false,
            Ok(Err(error)) => !error.is_loss(),
            Err(_panic) => true,
        };
        if is_restorable {
            // The output may be partially written, so restore it. If that fails too, the first error is more specific.
            self.run_deformer(&Arc::clone(&self.current_state)).ok();
        }
        let deformed = result.unwrap_or_else(|panic| resume_unwind(panic))?;
        if is_in_range(&deformed.bounds) {
            self.current_state = Arc::clone(state);
            self.set_bounds(&deformed);
            return Ok(deformed);
        }
        let overflow_error = self.overflow_error(state);
        self.run_deformer(&Arc::clone(&self.current_state))?;
        Err(overflow_error.unwrap_or_else(|error| error))
    }

    /// Sets the bounds of the drawn vertices of the current state.
    fn set_bounds(&mut self, deformed: &DeformSummary) {
        let computed = FrameBounds { world: deformed.bounds, light: deformed.oriented_bounds };
        let clipped = self.scene.drawn_bounds.clip(&self.scene, &self.current_state, computed);
        (self.bounds, self.light_bounds) = (clipped.world, clipped.light);
    }

    fn run_deformer(&mut self, state: &Arc<SceneState>) -> Result<DeformSummary> {
        self.generation += 1;
        fault_injection::check(InjectionPoint::Deform)?;
        self.deformer.deform(state)
    }

    /// The vertices of the last deformation, in host memory.
    ///
    /// # Errors
    /// `Fault` when copying from the device failed.
    pub fn surface(&mut self) -> Result<&DeformedSurface> {
        self.deformer.surface()
    }

    /// Creates the buffers on first use and fills them with the last deformation. If the domains have different
    /// floating origins, the positions are rebased: they are made relative to one origin near the eye of `camera`.
    pub(in crate::engine) fn fill_buffers(
        &mut self,
        renderer: &mut Renderer,
        camera: &Camera,
    ) -> Result<BufferContents> {
        let is_uploaded = self.fill_without_rebase(renderer)?;
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers_error()) };
        let origins = match (uniform_origin(self.current_state.origins.as_ref()), &self.current_state.origins) {
            (None, Some(origins)) => Arc::clone(origins),
            (origin, _) => {
                buffers.set_shared_origin(origin.unwrap_or_default());
                buffers.set_step(self.generation);
                return Ok(BufferContents { bounds: self.bounds, light_bounds: self.light_bounds, is_uploaded });
            }
        };
        let camera_origin = self.scene.origin_grids.snap(camera.eye().into());
        let positions = &self.deformer.surface_with(VertexAttributes::POSITIONS_AND_NORMALS)?.positions;
        let (positions, bounds) = origins.rebase_positions(camera_origin, &self.scene, positions);
        let bounds = self.scene.drawn_bounds.clip_rebased(&self.scene, &self.current_state, bounds, camera_origin);
        renderer.upload_rebased(buffers, &positions, camera_origin)?;
        Ok(BufferContents { bounds, light_bounds: None, is_uploaded: true })
    }

    /// Draws the passes of the compute rasterizer for the next frame before OpenGL gets commands, if the positions are
    /// in shared memory. Also draws those of the other [`Deformer::shared_steps`], for the same camera. The frame must
    /// follow with the same parameters. `samples`: samples per pixel that the frame sets for itself.
    pub(in crate::engine) fn rasterize(
        &mut self,
        renderer: &mut Renderer,
        camera: &Camera,
        size: FrameSize,
        samples: Option<u32>,
    ) -> Result<()> {
        let (Some(buffers), Some(origin)) = (&mut self.buffers, uniform_origin(self.current_state.origins.as_ref()))
        else {
            return Ok(());
        };
        if !buffers.has_compute_rasterizer() {
            return Ok(());
        }
        let steps = self.deformer.shared_steps()?;
        buffers.set_shared_origin(origin);
        buffers.set_step(self.generation);
        let has_origin = |step: &SharedStep| uniform_origin(step.origins.as_ref()) == Some(origin);
        let drawable_steps = steps.into_iter().take_while(|step| has_origin(step) && is_in_range(&step.bounds));
        // The first step is the current one. The bounds of another step cannot be clipped without its state.
        let drawn_bounds = &self.scene.drawn_bounds;
        let max_steps = if drawn_bounds.clips() { 1 } else { usize::MAX };
        let frames = drawable_steps.take(max_steps).map(|SharedStep { positions, bounds, oriented_bounds, .. }| {
            let computed = FrameBounds { world: bounds, light: oriented_bounds };
            let clipped = drawn_bounds.clip(&self.scene, &self.current_state, computed);
            let contents = BufferContents { bounds: clipped.world, light_bounds: clipped.light, is_uploaded: false };
            SharedFrame { params: FrameParams { samples, ..contents.frame_params(*camera, size) }, positions }
        });
        renderer.rasterize(buffers, frames.collect())
    }

    /// Starts copying attributes of the last deformation to host memory. The copy overlaps with the next deformation.
    pub(in crate::engine) fn readback(&mut self, attributes: VertexAttributes) -> Result<VertexReadback> {
        self.deformer.readback(attributes)
    }

    /// Waits until the copy is complete.
    pub(in crate::engine) fn wait_readback(&mut self, readback: &VertexReadback) -> Result<Arc<DeformedSurface>> {
        self.deformer.wait_readback(readback)
    }

    /// Uploads the values of a color map into the buffers, which must be filled, and returns the legend. Returns `None`
    /// if `frame_output` is not a color map. A mode shape does not depend on the state, so it is not recomputed while
    /// its values are in the buffers.
    pub(in crate::engine) fn upload_scalar_field(
        &mut self,
        renderer: &mut Renderer,
        frame_output: FrameOutput,
    ) -> Result<Option<Legend>> {
        let is_state_independent = matches!(frame_output, FrameOutput::ModeShape { .. });
        if let Some((cached_output, legend)) = &self.cached_color_map
            && is_state_independent
            && *cached_output == frame_output
        {
            return Ok(Some(legend.clone()));
        }
        let scalar_field = match frame_output {
            FrameOutput::ModeShape { mode, .. } => scalar_field::mode_shape_magnitudes(&self.scene, mode as usize),
            FrameOutput::Displacement { .. } => scalar_field::displacement_magnitudes(
                &self.scene,
                &self.current_state,
                self.deformer.surface_with(VertexAttributes::POSITIONS_AND_NORMALS)?,
            ),
            FrameOutput::Color
            | FrameOutput::Depth
            | FrameOutput::DepthWithGround
            | FrameOutput::Domains
            | FrameOutput::Normals => return Ok(None),
        };
        let legend = scalar_field::fit_legend(&self.scene, frame_output, &scalar_field);
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers_error()) };
        self.cached_color_map = None;
        renderer.upload_vertex_values(buffers, &scalar_field)?;
        self.cached_color_map = Some((frame_output, legend.clone()));
        Ok(Some(legend))
    }

    /// Creates the buffers on first use. Copies the vertices to them on the device if the deformer can, else uploads
    /// them, once per deformation. Does not rebase positions. Returns whether vertices were uploaded.
    fn fill_without_rebase(&mut self, renderer: &mut Renderer) -> Result<bool> {
        let buffers = match self.buffers.take() {
            Some(buffers) => buffers,
            None => renderer.load(&self.scene)?,
        };
        let buffers = self.buffers.insert(buffers);
        if self.buffers_are_current {
            return Ok(false);
        }
        let needs_upload = !self.deformer.fills_gl_buffers();
        if needs_upload {
            renderer.upload(buffers, self.deformer.surface_with(VertexAttributes::POSITIONS_AND_NORMALS)?)?;
        } else {
            self.deformer.fill_gl_buffers()?;
        }
        self.buffers_are_current = true;
        Ok(needs_upload)
    }

    /// Attaches a compute rasterizer to the scene's buffers. OpenGL draws the passes that it does not support.
    pub(in crate::engine) fn attach_rasterizer(
        &mut self,
        renderer: &mut Renderer,
        create_rasterizer: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        self.fill_without_rebase(renderer)?;
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers_error()) };
        renderer.attach_rasterizer(buffers, create_rasterizer)
    }

    /// [`Self::attach_rasterizer`], but the compute rasterizer draws the shadow map only.
    pub(in crate::engine) fn attach_shadow_rasterizer(
        &mut self,
        renderer: &mut Renderer,
        create_rasterizer: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        self.fill_without_rebase(renderer)?;
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers_error()) };
        renderer.attach_shadow_rasterizer(buffers, create_rasterizer)
    }

    /// Measures both rasterizers with steps of the current state and frames of [`BENCHMARK_SIZE`], and selects the
    /// faster one for each pass.
    pub(in crate::engine) fn select_raster_backends(&mut self, renderer: &mut Renderer) -> Result<()> {
        renderer.select_raster_backends(self).map(drop)
    }

    pub(in crate::engine) const fn encodes_on_cuda(&self) -> bool {
        self.encodes_on_cuda
    }

    pub(in crate::engine) const fn set_encodes_on_cuda(&mut self, encodes_on_cuda: bool) {
        self.encodes_on_cuda = encodes_on_cuda;
    }

    /// Measures both PNG encoders with a frame of [`BENCHMARK_SIZE`] of the current state and selects the faster one:
    /// the time of CUDA's kernels is compared with that of one thread of the CPU, divided by the number of threads.
    pub(in crate::engine) fn select_png_encoder(&mut self, renderer: &mut Renderer) -> Result<()> {
        let FrameSize { width, height } = BENCHMARK_SIZE;
        let camera = Camera::fit_to_scene(&self.scene, width, height);
        let params = self.fill_buffers(renderer, &camera)?.frame_params(camera, BENCHMARK_SIZE);
        let mut encoded = None;
        // The first encoding allocates memory.
        for _ in 0..2 {
            let frame = renderer.submit(self.buffers()?, &params)?;
            let copies_pixels = true;
            frame.request_png(copies_pixels);
            encoded = match renderer.map_pixels(frame)?.into_shared_image().rgba {
                FramePixels::Encoded(encoded) => encoded.rgba.map(|rgba| (encoded.ms, rgba)),
                FramePixels::Copied(_) | FramePixels::Held(_) => None,
            };
        }
        // Without a file, for example because the frame is translucent, the CPU encodes.
        let Some((cuda_ms, rgba)) = encoded else { return Ok(()) };
        let begin = Instant::now();
        encode_png(width, height, (*rgba).as_ref())?;
        let threads = std::thread::available_parallelism().map_or(1, NonZero::get);
        let cpu_ms = ms_since(begin) / threads as f64;
        self.encodes_on_cuda = cuda_ms < cpu_ms;
        let (scene, encodes_on_cuda) = (&self.scene.name, self.encodes_on_cuda);
        tracing::info!(scene, cuda_ms, cpu_ms, encodes_on_cuda, "measured the PNG encoders");
        Ok(())
    }

    /// Logs how a frame is drawn, unless a frame of the scene was drawn in the same way before.
    pub(in crate::engine) fn log_frame(&mut self, info: &FrameInfo) {
        self.frame_log.record(&self.scene.name, info);
    }

    pub(in crate::engine) fn buffers(&self) -> Result<&SceneBuffers> {
        self.buffers.as_ref().ok_or_else(no_buffers_error)
    }

    /// Drops the deformer and returns the buffers. The deformer may have registered the buffers with CUDA, so it must
    /// be dropped before the buffers are deleted.
    pub(in crate::engine) fn into_buffers(self) -> Option<SceneBuffers> {
        drop(self.deformer);
        self.buffers
    }

    /// Creates the error that names the domain of the first vertex out of range.
    fn overflow_error(&mut self, state: &SceneState) -> Result<Error> {
        let scene = Arc::clone(&self.scene);
        let surface = self.deformer.surface_with(VertexAttributes {
            positions: true,
            displacements: true,
            ..VertexAttributes::default()
        })?;
        let is_out_of_range = |number: &f32| number.is_nan() || f64::from(*number).abs() > MAX_COORDINATE;
        let position_index = surface.positions.iter().position(is_out_of_range);
        // A displacement may be out of range although its position is not.
        let displacement_index = || surface.displacements.iter().position(|number| !number.is_finite());
        let vertex = position_index.or_else(displacement_index).unwrap_or(0) / 3;
        let domain = scene
            .layout
            .domains
            .partition_point(|domain_layout| domain_layout.first_vertex <= vertex)
            .saturating_sub(1);
        let max_q = state.q_of(&scene, domain).iter().fold(0.0_f32, |max, q| max.max(q.abs()));
        let name = &scene.domains[domain].name;
        let given = format!("vertex {vertex} of domain '{name}' out of range, largest |q| {max_q:e}");
        Ok(invalid("step.q", format!("q and transform that keep every vertex within {MAX_COORDINATE:e}"), given))
    }
}

/// The origin of all domains: the scene's origin, or one floating origin. The deformer's output is then drawn
/// unchanged. `None` if the domains have different origins.
pub(in crate::engine) fn uniform_origin(origins: Option<&Arc<FloatingOrigins>>) -> Option<[f64; 3]> {
    match origins {
        Some(origins) => origins.has_no_outliers().then(|| origins.shared_origin()),
        None => Some([0.0; 3]),
    }
}

/// Draws the steps of the trial as those of a client that sends them ahead.
impl TrialScene for LoadedScene {
    fn buffers_mut(&mut self) -> Result<&mut SceneBuffers> {
        self.buffers.as_mut().ok_or_else(no_buffers_error)
    }

    fn submit(&mut self, renderer: &mut Renderer) -> Result<PendingFrame> {
        let state = Arc::clone(&self.current_state);
        self.announce(&state);
        self.deform_shared(&state)?;
        let camera = Camera::fit_to_scene(&self.scene, BENCHMARK_SIZE.width, BENCHMARK_SIZE.height);
        self.rasterize(renderer, &camera, BENCHMARK_SIZE, None)?;
        let params = self.fill_buffers(renderer, &camera)?.frame_params(camera, BENCHMARK_SIZE);
        renderer.submit_without_readback(self.buffers()?, &params)
    }
}

fn no_buffers_error() -> Error {
    fault("draw", "the scene has no buffers")
}

pub(super) fn is_in_range(bounds: &BoundingBox) -> bool {
    bounds.min.iter().chain(&bounds.max).all(|number| number.abs() <= MAX_COORDINATE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;
    use modalcast_compute::reference::ReferenceDeformer;

    fn load_at_rest() -> LoadedScene {
        let scene = testing::two_strips();
        let deformer = Box::new(ReferenceDeformer::new(&scene).with_bounding_axes(scene.light_axes()));
        let mut loaded_scene = LoadedScene::new(&scene, deformer, None);
        loaded_scene.deform_rest().expect("expected a valid rest state");
        loaded_scene
    }

    #[test]
    fn overflowing_state_is_rejected_and_vertices_are_restored() {
        let mut loaded_scene = load_at_rest();
        let scene = Arc::clone(loaded_scene.scene());
        let mut valid_state = SceneState::rest(&scene);
        valid_state.q[0] = 0.25;
        loaded_scene.deform(&valid_state).expect("expected a valid state");
        let expected_surface = loaded_scene.surface().expect("expected vertices").clone();
        assert_ne!(expected_surface, DeformedSurface::default());
        let expected_bounds = loaded_scene.light_bounds;
        assert!(expected_bounds.is_some_and(|bounds| bounds.is_valid()));
        let first_q_of_right_strip = scene.layout.domains[1].first_q;
        for q in [f32::MAX, 1e30] {
            let mut overflowing_state = valid_state.clone();
            overflowing_state.q[first_q_of_right_strip] = q;
            let error = loaded_scene.deform(&overflowing_state).expect_err("expected an overflow").to_string();
            assert!(
                error.starts_with("step.q: ") && error.contains("'right'"),
                "expected the right strip, got {error}"
            );
            assert_eq!(loaded_scene.surface().expect("expected vertices"), &expected_surface);
            assert!(loaded_scene.bounds().is_finite() && loaded_scene.light_bounds == expected_bounds);
        }
    }
}
