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

/// A way to deform one scene. It owns all data of the scene that it needs.
pub trait Variant {
    /// Name, backend and deformation.
    fn label(&self) -> &VariantLabel;

    /// The scene with this variant's deformation, which defines the correct normals.
    fn scene(&self) -> &Arc<Scene>;

    /// The variant's approximations in x = T (x0 + U q), which determine the a-priori bound.
    fn error_model(&self) -> &ErrorModel;

    /// Indices of the vertices that the variant computes, whose errors are measured. `None` if it computes all.
    fn computed_vertices(&self) -> Option<&[u32]> {
        None
    }

    /// Minimum memory traffic of a step per operand.
    fn traffic(&self) -> Vec<Operand>;

    /// Prepares for all states that [`Self::surface`] will receive.
    ///
    /// # Errors
    /// `Fault` when the device fails; `Unavailable` when the machine lacks something; errors of creating a benchmark.
    fn prepare(&mut self, _states: &[SceneState]) -> Result<()> {
        Ok(())
    }

    /// Deforms to `state`, which was passed to [`Self::prepare`] at this index. Normals and tangents are empty when the
    /// variant computes none.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn surface(&mut self, state_index: usize, state: &SceneState) -> Result<&DeformedSurface>;

    /// Times steps that rotate through `states`; `None` when the variant cannot be timed with this state of the caches.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn time(&mut self, states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>>;

    /// Kernel launches per step; 0 on the CPU.
    fn launches_per_step(&self) -> usize {
        0
    }

    /// The driver's attributes of each kernel; empty on the CPU.
    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        Vec::new()
    }
}

/// A deformer of the server as a variant, timed by the wall clock from call to return.
pub struct DeformerVariant {
    label: VariantLabel,
    scene: Arc<Scene>,
    error_model: ErrorModel,
    deformer: Box<dyn Deformer>,
}

impl DeformerVariant {
    /// Wraps a deformer of this scene.
    pub fn new(label: VariantLabel, scene: &Arc<Scene>, deformer: Box<dyn Deformer>) -> Self {
        Self::with_error_model(label, scene, ErrorModel::of(scene), deformer)
    }

    /// Wraps a deformer with an error model that was created before.
    pub fn with_error_model(
        label: VariantLabel,
        scene: &Arc<Scene>,
        error_model: ErrorModel,
        deformer: Box<dyn Deformer>,
    ) -> Self {
        Self { label, scene: Arc::clone(scene), error_model, deformer }
    }
}

impl Variant for DeformerVariant {
    fn label(&self) -> &VariantLabel {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    fn traffic(&self) -> Vec<Operand> {
        memory_traffic::minimum_traffic(&self.scene)
    }

    fn surface(&mut self, _state_index: usize, state: &SceneState) -> Result<&DeformedSurface> {
        self.deformer.deform(state)?;
        self.deformer.surface()
    }

    fn time(&mut self, states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>> {
        // For cold caches, `by_wall_clock` evicts the caches of the CPU but not those of a device.
        if cache == CacheState::Cold && self.label.backend == Backend::Cuda {
            return Ok(None);
        }
        let deformer = &mut self.deformer;
        Timing::by_wall_clock(cache, replays, |replay| deformer.deform(&states[replay % states.len()]).map(drop))
    }
}

/// Whether the report's options select a variant of this name.
pub type VariantFilter<'a> = &'a dyn Fn(&str) -> bool;

/// A variant, or the reason why it could not be created.
pub type VariantCandidate = (VariantLabel, Result<Box<dyn Variant>>);

/// Creates a variant if it is selected. The candidate holds the reason if it is not selected or cannot be created.
pub fn make_candidate<V: Variant + 'static>(
    is_selected: VariantFilter<'_>,
    label: VariantLabel,
    create: impl FnOnce(VariantLabel) -> Result<V>,
) -> VariantCandidate {
    if !is_selected(&label.name) {
        let given = label.name.clone();
        return (label, Err(Error::NotFound { what: "selected variant", given }));
    }
    (label.clone(), create(label).map(|variant| Box::new(variant) as Box<dyn Variant>))
}
