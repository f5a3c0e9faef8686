//! Variants for tests: a deliberately wrong one, and an f64 emulation of a scene's deformation.

use std::sync::Arc;

use super::error_model::ErrorModel;
use super::exact_positions::positions;
use super::exact_state::ExactState;
use super::memory_traffic::Operand;
use super::timing::{CacheState, Timing};
use super::variant::{Variant, VariantLabel};
use super::workloads::{Size, Workload, WorkloadKind};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{Modes, Shape};
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneState};

/// A workload of one shape, with modes whose entries are denormal numbers.
pub(super) fn with_denormal_modes(kind: &WorkloadKind) -> Workload {
    let workload = kind.build(Size::Quick).expect("expected a workload");
    let mut parts = workload.scene.parts();
    let shape = &parts.shapes[0];
    let rows = 3 * shape.modes.vertices();
    let rank = shape.modes.rank();
    // Entries of a workload are at most 1. The smallest normal number is 1.2e-38.
    let entries = (0..rank).flat_map(|mode| shape.modes.column(mode).iter().map(|entry| entry * 1e-39)).collect();
    let modes = Modes::from_columns(rows, rank, entries).expect("expected modes");
    parts.shapes[0] = Shape::new(shape.mesh.clone(), modes).expect("expected a shape");
    let scene = Scene::new(parts).expect("expected a scene");
    Workload { scene, ..workload }
}

/// Wraps another variant and adds an error to the last coordinate of its positions.
pub(super) struct InaccurateVariant<V> {
    inner: V,
    error: f32,
    computed_vertices: Option<Vec<u32>>,
    surface: DeformedSurface,
}

impl<V: Variant> InaccurateVariant<V> {
    pub(super) fn new(inner: V, error: f32) -> Self {
        Self { inner, error, computed_vertices: None, surface: DeformedSurface::default() }
    }

    /// A variant that claims to compute only these vertices.
    pub(super) fn computing(self, vertices: Vec<u32>) -> Self {
        Self { computed_vertices: Some(vertices), ..self }
    }
}

impl<V: Variant> Variant for InaccurateVariant<V> {
    fn label(&self) -> &VariantLabel {
        self.inner.label()
    }

    fn scene(&self) -> &Arc<Scene> {
        self.inner.scene()
    }

    fn error_model(&self) -> &ErrorModel {
        self.inner.error_model()
    }

    fn computed_vertices(&self) -> Option<&[u32]> {
        self.computed_vertices.as_deref()
    }

    fn traffic(&self) -> Vec<Operand> {
        self.inner.traffic()
    }

    fn surface(&mut self, state_index: usize, state: &SceneState) -> Result<&DeformedSurface> {
        self.surface = self.inner.surface(state_index, state)?.clone();
        let last = self.surface.positions.last_mut().expect("at least one vertex");
        *last += self.error;
        Ok(&self.surface)
    }

    fn time(&mut self, states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>> {
        self.inner.time(states, cache, replays)
    }
}

/// Emulates storage in f64. Only the positions are rounded to f32.
pub(super) struct EmulatedVariant {
    pub(super) label: VariantLabel,
    pub(super) scene: Arc<Scene>,
    /// Error model that the variant applies.
    pub(super) applied: ErrorModel,
    /// Error model that the variant declares, which determines its bounds.
    pub(super) declared: ErrorModel,
    pub(super) surface: DeformedSurface,
}

impl Variant for EmulatedVariant {
    fn label(&self) -> &VariantLabel {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn error_model(&self) -> &ErrorModel {
        &self.declared
    }

    fn traffic(&self) -> Vec<Operand> {
        Vec::new()
    }

    fn surface(&mut self, _state_index: usize, state: &SceneState) -> Result<&DeformedSurface> {
        let positions = positions(&self.scene, &ExactState::of(state), Some(&self.applied));
        self.surface.positions = positions.as_flattened().iter().map(|number| *number as f32).collect();
        Ok(&self.surface)
    }

    fn time(&mut self, _states: &[SceneState], _cache: CacheState, _replays: usize) -> Result<Option<Timing>> {
        Ok(None)
    }
}
