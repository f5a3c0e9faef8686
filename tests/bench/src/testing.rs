//! Variants for tests: a deliberately wrong one, and an f64 emulation of a scene's deformation.

use std::sync::Arc;

use super::error_model::ErrorModel;
use super::exact_positions::{ErrorModelTerms, positions};
use super::exact_state::ExactState;
use super::memory_traffic::Operand;
use super::timing::{CacheState, Timing};
use super::variant::{Variant, VariantLabel};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneState};

/// Wraps another variant and adds an error to its last coordinate.
pub(super) struct Damaged<V> {
    inner: V,
    damage: f32,
    surface: DeformedSurface,
}

impl<V: Variant> Damaged<V> {
    pub(super) fn new(inner: V, damage: f32) -> Self {
        Self { inner, damage, surface: DeformedSurface::default() }
    }
}

impl<V: Variant> Variant for Damaged<V> {
    fn label(&self) -> &VariantLabel {
        self.inner.label()
    }

    fn scene(&self) -> &Arc<Scene> {
        self.inner.scene()
    }

    fn error_model(&self) -> &ErrorModel {
        self.inner.error_model()
    }

    fn traffic(&self) -> Vec<Operand> {
        self.inner.traffic()
    }

    fn surface(&mut self, at: usize, state: &SceneState) -> Result<&DeformedSurface> {
        self.surface = self.inner.surface(at, state)?.clone();
        let last = self.surface.positions.last_mut().expect("a vertex");
        *last += self.damage;
        Ok(&self.surface)
    }

    fn time(&mut self, states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>> {
        self.inner.time(states, cache, replays)
    }
}

/// Emulates storage and truncation in f64 and rounds only the positions.
pub(super) struct Emulated {
    pub(super) label: VariantLabel,
    pub(super) scene: Arc<Scene>,
    /// Error model that it applies.
    pub(super) does: ErrorModel,
    /// Error model that it declares, which gives its bounds.
    pub(super) says: ErrorModel,
    pub(super) surface: DeformedSurface,
}

impl Variant for Emulated {
    fn label(&self) -> &VariantLabel {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn error_model(&self) -> &ErrorModel {
        &self.says
    }

    fn traffic(&self) -> Vec<Operand> {
        Vec::new()
    }

    fn surface(&mut self, _at: usize, state: &SceneState) -> Result<&DeformedSurface> {
        self.does.follow(state);
        self.says.follow(state);
        let take = ErrorModelTerms { storage: Some(&self.does), truncation: Some(&self.does) };
        let positions = positions(&self.scene, &ExactState::of(state), take);
        self.surface.positions = positions.as_flattened().iter().map(|number| *number as f32).collect();
        Ok(&self.surface)
    }

    fn time(&mut self, _states: &[SceneState], _cache: CacheState, _replays: usize) -> Result<Option<Timing>> {
        Ok(None)
    }
}
