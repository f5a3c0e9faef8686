//! The seam between the report and what it reports on.

use std::sync::Arc;

use super::ingredients::Ingredients;
use super::timing::{Cache, Timing};
use super::traffic::{self, Part};
use crate::kernels::KernelFacts;
use modalcast_model::deform::{Backend, Deformer, Surface};
use modalcast_model::error::Result;
use modalcast_model::scene::{Deformation, Scene, State};

/// What a variant is.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    /// Unique among the variants of a load.
    pub name: String,
    pub backend: Backend,
    pub deformation: Deformation,
}

impl Label {
    /// The label of a variant that deforms this scene as the scene says.
    pub fn new(name: impl Into<String>, backend: Backend, scene: &Scene) -> Self {
        Self { name: name.into(), backend, deformation: scene.deformation }
    }
}

/// A way to deform one scene, which holds all it needs of it.
pub trait Variant {
    /// What it is.
    fn label(&self) -> &Label;

    /// The scene as this variant deforms it: its deformation defines which normals are right.
    fn scene(&self) -> &Arc<Scene>;

    /// What it replaces in x = T (x0 + U q): this gives its a-priori bound.
    fn ingredients(&self) -> &Ingredients;

    /// The bytes that a step moves at least.
    fn traffic(&self) -> Vec<Part>;

    /// Takes all states that it will be asked for.
    ///
    /// # Errors
    /// `Fault` when the device failed, or what else keeps it from being made.
    fn prepare(&mut self, _states: &[State]) -> Result<()> {
        Ok(())
    }

    /// The surface at state `at` of those, which is `state`. Normals and tangents are empty when it makes none.
    ///
    /// # Errors
    /// `Fault` when the device failed.
    fn surface(&mut self, at: usize, state: &State) -> Result<&Surface>;

    /// Times steps over rotating states; `None` when it cannot be timed with this cache.
    ///
    /// # Errors
    /// `Fault` when the device failed.
    fn time(&mut self, states: &[State], cache: Cache, replays: usize) -> Result<Option<Timing>>;

    /// Kernel launches of a step, and what the driver says of each kernel; nothing on the CPU.
    fn kernels(&self) -> (usize, Vec<KernelFacts>) {
        (0, Vec::new())
    }
}

/// A deformer of the server as a variant, timed by the wall clock from the call until it returns.
pub struct Driven {
    label: Label,
    scene: Arc<Scene>,
    ingredients: Ingredients,
    deformer: Box<dyn Deformer>,
}

impl Driven {
    /// A deformer of this scene.
    pub fn new(label: Label, scene: &Arc<Scene>, deformer: Box<dyn Deformer>) -> Self {
        Self::sharing(label, scene, Ingredients::of(scene), deformer)
    }

    /// The same, with what it replaces made already.
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
        // The sweep goes through the caches of the CPU, not through those of a device.
        if cache == Cache::Cold && self.label.backend == Backend::Cuda {
            return Ok(None);
        }
        let deformer = &mut self.deformer;
        Timing::by_wall_clock(cache, replays, |replay| deformer.deform(&states[replay % states.len()]).map(drop))
    }
}
