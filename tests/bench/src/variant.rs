//! The interface between the report and the variants that it measures.

use std::sync::Arc;

use super::ingredients::Ingredients;
use super::timing::{Cache, Timing};
use super::traffic::{self, Part};
use crate::kernels::KernelFacts;
use modalcast_model::deform::{Backend, Deformer, Surface};
use modalcast_model::error::Result;
use modalcast_model::scene::{Deformation, Scene, State};

/// Identity of a variant.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    /// Unique among the variants of a load.
    pub name: String,
    pub backend: Backend,
    pub deformation: Deformation,
}

impl Label {
    /// The label of a variant that uses this scene's deformation.
    pub fn new(name: impl Into<String>, backend: Backend, scene: &Scene) -> Self {
        Self { name: name.into(), backend, deformation: scene.deformation }
    }
}

/// A way to deform one scene. It owns all data that it needs of the scene.
pub trait Variant {
    /// Name, backend and deformation.
    fn label(&self) -> &Label;

    /// The scene with this variant's deformation, which defines the correct normals.
    fn scene(&self) -> &Arc<Scene>;

    /// The error model: what the variant replaces in x = T (x0 + U q). It gives the a-priori bound.
    fn ingredients(&self) -> &Ingredients;

    /// The minimum of bytes that a step moves, by part.
    fn traffic(&self) -> Vec<Part>;

    /// Receives all states that [`Self::surface`] will be called with.
    ///
    /// # Errors
    /// `Fault` when the device fails; `Unavailable` when something that the variant needs is missing; other errors of
    /// its construction.
    fn prepare(&mut self, _states: &[State]) -> Result<()> {
        Ok(())
    }

    /// The surface at `state`, which is number `at` of the prepared states. Normals and tangents are empty when the
    /// variant computes none.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn surface(&mut self, at: usize, state: &State) -> Result<&Surface>;

    /// Times steps over rotating states; `None` when the variant cannot be timed with this cache.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn time(&mut self, states: &[State], cache: Cache, replays: usize) -> Result<Option<Timing>>;

    /// Kernel launches per step, and the driver's facts about each kernel; 0 and none on the CPU.
    fn kernels(&self) -> (usize, Vec<KernelFacts>) {
        (0, Vec::new())
    }
}

/// A deformer of the server as a variant, timed by the wall clock from call to return.
pub struct Driven {
    label: Label,
    scene: Arc<Scene>,
    ingredients: Ingredients,
    deformer: Box<dyn Deformer>,
}

impl Driven {
    /// Wraps a deformer of this scene.
    pub fn new(label: Label, scene: &Arc<Scene>, deformer: Box<dyn Deformer>) -> Self {
        Self::sharing(label, scene, Ingredients::of(scene), deformer)
    }

    /// The same, with an existing error model.
    pub fn sharing(label: Label, scene: &Arc<Scene>, ingredients: Ingredients, deformer: Box<dyn Deformer>) -> Self {
        Self { label, scene: Arc::clone(scene), ingredients, deformer }
    }
}

impl Variant for Driven {
    fn label(&self) -> &Label {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn ingredients(&self) -> &Ingredients {
        &self.ingredients
    }

    fn traffic(&self) -> Vec<Part> {
        traffic::of_scene(&self.scene)
    }

    fn surface(&mut self, _at: usize, state: &State) -> Result<&Surface> {
        self.ingredients.follow(state);
        self.deformer.deform(state)?;
        self.deformer.surface()
    }

    fn time(&mut self, states: &[State], cache: Cache, replays: usize) -> Result<Option<Timing>> {
        // The cold sweep evicts the caches of the CPU, not those of a device.
        if cache == Cache::Cold && self.label.backend == Backend::Cuda {
            return Ok(None);
        }
        let deformer = &mut self.deformer;
        Timing::by_wall_clock(cache, replays, |replay| deformer.deform(&states[replay % states.len()]).map(drop))
    }
}
