//! The interface between the report and the variants that it measures.

use std::sync::Arc;

use super::error_model::ErrorModel;
use super::memory_traffic::{self, Operand};
use super::timing::{CacheState, Timing};
use crate::kernels::KernelAttributes;
use modalcast_model::deform::{Backend, DeformedSurface, Deformer};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{DeformationSettings, Scene, SceneState};

/// Identity of a variant.
#[derive(Debug, Clone, PartialEq)]
pub struct VariantLabel {
    /// Unique among the variants of a load.
    pub name: String,
    pub backend: Backend,
    pub deformation: DeformationSettings,
}

impl VariantLabel {
    /// The label of a variant that uses this scene's deformation.
    pub fn new(name: impl Into<String>, backend: Backend, scene: &Scene) -> Self {
        Self { name: name.into(), backend, deformation: scene.deformation }
    }
}

/// A way to deform one scene. It owns all data that it needs of the scene.
pub trait Variant {
    /// Name, backend and deformation.
    fn label(&self) -> &VariantLabel;

    /// The scene with this variant's deformation, which defines the correct normals.
    fn scene(&self) -> &Arc<Scene>;

    /// The error model: what the variant replaces in x = T (x0 + U q). It gives the a-priori bound.
    fn ingredients(&self) -> &ErrorModel;

    /// The minimum of bytes that a step moves, by part.
    fn traffic(&self) -> Vec<Operand>;

    /// Receives all states that [`Self::surface`] will be called with.
    ///
    /// # Errors
    /// `Fault` when the device fails; `Unavailable` when something that the variant needs is missing; other errors of
    /// its construction.
    fn prepare(&mut self, _states: &[SceneState]) -> Result<()> {
        Ok(())
    }

    /// The surface at `state`, which is number `at` of the prepared states. Normals and tangents are empty when the
    /// variant computes none.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn surface(&mut self, at: usize, state: &SceneState) -> Result<&DeformedSurface>;

    /// Times steps over rotating states; `None` when the variant cannot be timed with this cache.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn time(&mut self, states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>>;

    /// Kernel launches per step, and the driver's facts about each kernel; 0 and none on the CPU.
    fn kernels(&self) -> (usize, Vec<KernelAttributes>) {
        (0, Vec::new())
    }
}

/// A deformer of the server as a variant, timed by the wall clock from call to return.
pub struct DeformerVariant {
    label: VariantLabel,
    scene: Arc<Scene>,
    ingredients: ErrorModel,
    deformer: Box<dyn Deformer>,
}

impl DeformerVariant {
    /// Wraps a deformer of this scene.
    pub fn new(label: VariantLabel, scene: &Arc<Scene>, deformer: Box<dyn Deformer>) -> Self {
        Self::sharing(label, scene, ErrorModel::of(scene), deformer)
    }

    /// The same, with an existing error model.
    pub fn sharing(
        label: VariantLabel,
        scene: &Arc<Scene>,
        ingredients: ErrorModel,
        deformer: Box<dyn Deformer>,
    ) -> Self {
        Self { label, scene: Arc::clone(scene), ingredients, deformer }
    }
}

impl Variant for DeformerVariant {
    fn label(&self) -> &VariantLabel {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn ingredients(&self) -> &ErrorModel {
        &self.ingredients
    }

    fn traffic(&self) -> Vec<Operand> {
        memory_traffic::of_scene(&self.scene)
    }

    fn surface(&mut self, _at: usize, state: &SceneState) -> Result<&DeformedSurface> {
        self.ingredients.follow(state);
        self.deformer.deform(state)?;
        self.deformer.surface()
    }

    fn time(&mut self, states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>> {
        // The cold sweep evicts the caches of the CPU, not those of a device.
        if cache == CacheState::Cold && self.label.backend == Backend::Cuda {
            return Ok(None);
        }
        let deformer = &mut self.deformer;
        Timing::by_wall_clock(cache, replays, |replay| deformer.deform(&states[replay % states.len()]).map(drop))
    }
}

/// Predicate: whether the request selects a variant of this name.
pub type VariantFilter<'a> = &'a dyn Fn(&str) -> bool;

/// A variant, or the reason why it could not be created.
pub type VariantCandidate = (VariantLabel, Result<Box<dyn Variant>>);

/// Creates a variant if it is wanted; otherwise, and on failure, keeps the reason.
pub fn make_candidate<V: Variant + 'static>(
    wanted: VariantFilter<'_>,
    label: VariantLabel,
    make: impl FnOnce(VariantLabel) -> Result<V>,
) -> VariantCandidate {
    if !wanted(&label.name) {
        let given = label.name.clone();
        return (label, Err(Error::NotFound { what: "variant that is asked for", given }));
    }
    (label.clone(), make(label).map(|variant| Box::new(variant) as Box<dyn Variant>))
}
