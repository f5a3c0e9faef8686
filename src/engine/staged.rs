//! A scene loaded on the device thread: its deformer, its OpenGL buffers (created on first use), and the last valid
//! state.

use std::sync::Arc;

use super::values;
use super::viewer::Showing;
use crate::frame::Legend;
use modalcast_model::deform::{Deformed, Deformer, Fetch, Surface, Wanted};
use modalcast_model::error::{Error, Result, during, invalid};
use modalcast_model::raster::{Mesh, Rasteriser};
use modalcast_model::scene::{Bounds, Camera, LightBounds, Scene, State, nearest_cell};
use modalcast_render::{Renderer, SceneBuffers, Shot};

/// Positions beyond this bound (scene units) are rejected like infinite ones, because their squares overflow f32 in the
/// shaders.
const FARTHEST: f64 = 1e18;

/// Size in pixels of the frames that are measured to choose between the rasterizers.
const MEASURED: [u32; 2] = [1920, 1080];

/// Description of the content of the buffers, in the coordinate frame that the camera needs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Filled {
    bounds: Bounds,
    /// `None` in a camera-relative frame, because the deformer computed them in the frames of the domains' cells.
    light: Option<LightBounds>,
    /// Whether vertices were uploaded.
    pub(super) uploaded: bool,
}

impl Filled {
    /// The parameters of a frame of these buffers; the size is in pixels.
    pub(super) const fn shot(&self, camera: Camera, [width, height]: [u32; 2]) -> Shot {
        Shot { camera, width, height, bounds: self.bounds, light: self.light }
    }
}

/// A scene that can be deformed and drawn.
pub struct Staged {
    scene: Arc<Scene>,
    deformer: Box<dyn Deformer>,
    buffers: Option<SceneBuffers>,
    /// Whether the buffers hold the vertices of the last deformation.
    filled: bool,
    bounds: Bounds,
    /// Bounds of the same vertices in light space; only if the scene has a shadow.
    light: Option<LightBounds>,
    /// The state that the deformer's output shows.
    shown: Arc<State>,
    /// Number of deformations, including rejected states and the deformations that undo them, since each one changes
    /// the content of the buffers.
    turn: u64,
    /// The color map whose values are in the buffers.
    mapped: Option<(Showing, Legend)>,
}

impl Staged {
    /// A scene without output. [`Self::rest`] must be called before any other method.
    pub(super) fn new(scene: &Arc<Scene>, deformer: Box<dyn Deformer>, buffers: Option<SceneBuffers>) -> Self {
        let shown = Arc::new(State::rest(scene));
        Self {
            scene: Arc::clone(scene),
            deformer,
            buffers,
            filled: false,
            bounds: scene.rest_bounds,
            light: None,
            shown,
            turn: 0,
            mapped: None,
        }
    }

    /// Deforms the rest state.
    pub(super) fn rest(&mut self) -> Result<()> {
        let deformed = self.run(&Arc::clone(&self.shown))?;
        if !is_near(&deformed.bounds) {
            return Err(invalid("scene.rest", "finite vertices", format!("{:?}", deformed.bounds)));
        }
        (self.bounds, self.light) = (deformed.bounds, deformed.light);
        Ok(())
    }

    /// The scene.
    pub const fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// Bounds of the last deformation in scene units, each domain relative to its cell. Always finite.
    pub const fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Deforms the scene to a state. If a vertex is not finite or beyond 1e18 units, the state is rejected and the
    /// previous state is deformed again, so that no reader sees the rejected one.
    ///
    /// # Errors
    /// `Invalid` naming the domain whose vertices overflow; `Fault` of the device.
    pub fn deform(&mut self, state: &State) -> Result<Deformed> {
        self.deform_shared(&Arc::new(state.clone()))
    }

    /// [`Self::deform`] of a shared state, without a copy.
    pub(super) fn deform_shared(&mut self, state: &Arc<State>) -> Result<Deformed> {
        self.filled = false;
        let deformed = match self.run(state) {
            Ok(deformed) => deformed,
            Err(error) => {
                // The output may be partially written, so restore it. If that fails too, the first error says more.
                self.run(&Arc::clone(&self.shown)).ok();
                return Err(error);
            }
        };
        if is_near(&deformed.bounds) {
            (self.bounds, self.light) = (deformed.bounds, deformed.light);
            self.shown = Arc::clone(state);
            return Ok(deformed);
        }
        let refusal = self.overflow(state)?;
        self.run(&Arc::clone(&self.shown))?;
        Err(refusal)
    }

    fn run(&mut self, state: &State) -> Result<Deformed> {
        self.turn += 1;
        self.deformer.deform(state)
    }

    /// The vertices of the last deformation, in host memory.
    ///
    /// # Errors
    /// `Fault` when copying from the device failed.
    pub fn surface(&mut self) -> Result<&Surface> {
        self.deformer.surface()
    }

    /// Creates the buffers on first use and fills them with the last deformation. If the domains have different cells,
    /// the positions are rebased to the cell nearest the camera.
    pub(super) fn fill_buffers(&mut self, renderer: &mut Renderer, camera: &Camera) -> Result<Filled> {
        let uploaded = self.fill_shared(renderer)?;
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers()) };
        let apart = match &self.shown.cells {
            Some(cells) if !cells.is_one() => Arc::clone(cells),
            // All domains share one origin, so the deformer's output is drawn unchanged.
            cells => {
                buffers.relative_to(cells.as_ref().map_or([0.0; 3], |cells| cells.shared()));
                buffers.hold_step(self.turn);
                return Ok(Filled { bounds: self.bounds, light: self.light, uploaded });
            }
        };
        let view = nearest_cell(camera.eye().into());
        let positions = &self.deformer.read(Wanted::VERTICES)?.positions;
        let (positions, bounds) = apart.seen_from(view, &self.scene, positions);
        renderer.upload_apart(buffers, &positions, view)?;
        Ok(Filled { bounds, light: None, uploaded: true })
    }

    /// Starts copying the wanted attributes of the last deformation to host memory. The copy overlaps with the next
    /// deformation.
    pub(super) fn fetch(&mut self, wanted: Wanted) -> Result<Fetch> {
        self.deformer.fetch(wanted)
    }

    /// Waits until the copy is complete.
    pub(super) fn fetched(&mut self, fetch: &Fetch) -> Result<Arc<Surface>> {
        self.deformer.fetched(fetch)
    }

    /// Uploads the values of a color map into the buffers, which must be filled, and returns the legend; `None` if
    /// `showing` is not a color map. A mode shape does not depend on the state, so it is not recomputed while its
    /// values are in the buffers.
    pub(super) fn map_values(&mut self, renderer: &mut Renderer, showing: Showing) -> Result<Option<Legend>> {
        let fixed = matches!(showing, Showing::Mode { .. });
        if let Some((_, legend)) = self.mapped.as_ref().filter(|(held, _)| fixed && *held == showing) {
            return Ok(Some(legend.clone()));
        }
        let values = match showing {
            Showing::Mode { mode, .. } => values::mode_shape(&self.scene, mode as usize),
            Showing::Displacement { .. } => {
                values::displacements(&self.scene, &self.shown, self.deformer.read(Wanted::VERTICES)?)
            }
            Showing::Colour | Showing::Depth | Showing::Domains | Showing::Normals => return Ok(None),
        };
        let legend = values::legend(&self.scene, showing, &values);
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers()) };
        self.mapped = None;
        renderer.upload_values(buffers, &values)?;
        self.mapped = Some((showing, legend.clone()));
        Ok(Some(legend))
    }

    /// Creates the buffers on first use and uploads the vertices unless the deformer writes the buffers itself. Returns
    /// whether vertices were uploaded.
    fn fill_shared(&mut self, renderer: &mut Renderer) -> Result<bool> {
        let shares = self.deformer.shares_buffers();
        let buffers = match self.buffers.take() {
            Some(buffers) => buffers,
            None => renderer.load(&self.scene)?,
        };
        let buffers = self.buffers.insert(buffers);
        if self.filled || shares {
            return Ok(false);
        }
        renderer.upload(buffers, self.deformer.read(Wanted::VERTICES)?)?;
        self.filled = true;
        Ok(true)
    }

    /// Adds a compute rasterizer to the scene's buffers, next to OpenGL.
    pub(super) fn draw_beside(
        &mut self,
        renderer: &mut Renderer,
        make: impl FnOnce(Mesh) -> Result<Box<dyn Rasteriser>>,
    ) -> Result<()> {
        self.fill_shared(renderer)?;
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers()) };
        renderer.draw_beside(buffers, make)
    }

    /// Measures both rasterizers on frames of [`MEASURED`] pixels of the current state and selects the faster one per
    /// pass.
    pub(super) fn choose_paths(&mut self, renderer: &mut Renderer) -> Result<()> {
        let camera = Camera::framing(&self.scene, MEASURED[0], MEASURED[1]);
        let filled = self.fill_buffers(renderer, &camera)?;
        let Some(buffers) = &mut self.buffers else { return Err(no_buffers()) };
        renderer.choose_paths(buffers, &filled.shot(camera, MEASURED)).map(drop)
    }

    pub(super) fn buffers(&self) -> Result<&SceneBuffers> {
        self.buffers.as_ref().ok_or_else(no_buffers)
    }

    /// Drops the deformer first, because it may have the buffers registered with CUDA.
    pub(super) fn into_buffers(self) -> Option<SceneBuffers> {
        drop(self.deformer);
        self.buffers
    }

    /// The error that names the domain of the first vertex out of range.
    fn overflow(&mut self, state: &State) -> Result<Error> {
        let scene = Arc::clone(&self.scene);
        let surface = self.deformer.read(Wanted { positions: true, displacements: true, ..Wanted::default() })?;
        let is_far = |number: &f32| number.is_nan() || f64::from(*number).abs() > FARTHEST;
        let far = surface.positions.iter().position(is_far);
        // A displacement may be out of range although its position is not.
        let at = far.or_else(|| surface.displacements.iter().position(|number| !number.is_finite())).unwrap_or(0);
        let domain = scene.layout.slots.partition_point(|slot| slot.first_vertex <= at / 3).saturating_sub(1);
        let largest = state.q_of(&scene, domain).iter().fold(0.0_f32, |most, amount| most.max(amount.abs()));
        let given = format!("vertex {} out of range, largest |q| {largest:e}", at / 3);
        let field = format!("step.q of domain '{}'", scene.domains[domain].name);
        Ok(invalid(field, format!("q and transform that keep every vertex within {FARTHEST:e}"), given))
    }
}

fn no_buffers() -> Error {
    during("draw")("the scene has no buffers")
}

fn is_near(bounds: &Bounds) -> bool {
    bounds.min.iter().chain(&bounds.max).all(|number| number.abs() <= FARTHEST)
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;
    use modalcast_compute::reference::ReferenceDeformer;

    fn staged() -> Staged {
        let scene = testing::two_strips();
        let deformer = Box::new(ReferenceDeformer::new(&scene));
        let mut staged = Staged::new(&scene, deformer, None);
        staged.rest().expect("a scene at rest");
        staged
    }

    #[test]
    fn an_overflowing_step_is_refused_by_name_and_the_previous_vertices_stay() {
        let mut staged = staged();
        let scene = Arc::clone(staged.scene());
        let mut good = State::rest(&scene);
        good.q[0] = 0.25;
        staged.deform(&good).expect("a good step");
        let before = staged.surface().expect("vertices").clone();
        let light = staged.light;
        assert!(light.is_some_and(|light| light.is_sound()));
        let last = scene.layout.slots[1].first_q;
        for amount in [f32::MAX, 1e30] {
            let mut bad = good.clone();
            bad.q[last] = amount;
            let refusal = staged.deform(&bad).expect_err("overflows").to_string();
            assert!(refusal.starts_with("step.q of domain 'right'"), "{refusal}");
            assert_eq!(staged.surface().expect("vertices"), &before);
            assert!(staged.bounds().is_finite() && staged.light == light);
        }
        assert_ne!(before, Surface::default());
    }
}
