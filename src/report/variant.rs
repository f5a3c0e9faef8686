//! The seam between the report and what it reports on.

use std::sync::Arc;

use super::exact::{Exact, Ingredients};
use super::timing::{Cache, Timing};
use super::traffic::{self, Part};
use crate::deform::{Backend, Deformer, Surface};
use crate::error::Result;
use crate::scene::{Deformation, Scene, State};

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
    fn ingredients(&self) -> &dyn Ingredients;

    /// The bytes that a step moves at least.
    fn traffic(&self) -> Vec<Part>;

    /// The surface at `state`. Normals and tangents are empty when it makes none.
    ///
    /// # Errors
    /// `Fault` when the device failed.
    fn surface(&mut self, state: &State) -> Result<&Surface>;

    /// Times steps over rotating states; `None` when it cannot be timed with this cache.
    ///
    /// # Errors
    /// `Fault` when the device failed.
    fn time(&mut self, states: &[State], cache: Cache, replays: usize) -> Result<Option<Timing>>;
}

/// A deformer of the server as a variant, timed by the wall clock from the call until it returns.
pub struct Driven<D> {
    label: Label,
    scene: Arc<Scene>,
    deformer: D,
}

impl<D: Deformer> Driven<D> {
    /// A deformer of this scene.
    pub fn new(label: Label, scene: &Arc<Scene>, deformer: D) -> Self {
        Self { label, scene: Arc::clone(scene), deformer }
    }
}

impl<D: Deformer> Variant for Driven<D> {
    fn label(&self) -> &Label {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn ingredients(&self) -> &dyn Ingredients {
        &Exact
    }

    fn traffic(&self) -> Vec<Part> {
        traffic::of_scene(&self.scene)
    }

    fn surface(&mut self, state: &State) -> Result<&Surface> {
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
