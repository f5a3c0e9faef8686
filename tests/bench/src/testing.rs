//! Variants for tests: a deliberately wrong one, and an f64 emulation of a scene's deformation.

use std::sync::Arc;

use super::exact::{Take, positions};
use super::ingredients::Ingredients;
use super::motion::Truth;
use super::timing::{Cache, Timing};
use super::traffic::Part;
use super::variant::{Label, Variant};
use modalcast_model::deform::Surface;
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, State};

/// Wraps another variant and adds an error to its last coordinate.
pub(super) struct Damaged<V> {
    inner: V,
    damage: f32,
    surface: Surface,
}

impl<V: Variant> Damaged<V> {
    pub(super) fn new(inner: V, damage: f32) -> Self {
        Self { inner, damage, surface: Surface::default() }
    }
}

impl<V: Variant> Variant for Damaged<V> {
    fn label(&self) -> &Label {
        self.inner.label()
    }

    fn scene(&self) -> &Arc<Scene> {
        self.inner.scene()
    }

    fn ingredients(&self) -> &Ingredients {
        self.inner.ingredients()
    }

    fn traffic(&self) -> Vec<Part> {
        self.inner.traffic()
    }

    fn surface(&mut self, at: usize, state: &State) -> Result<&Surface> {
        self.surface = self.inner.surface(at, state)?.clone();
        let last = self.surface.positions.last_mut().expect("a vertex");
        *last += self.damage;
        Ok(&self.surface)
    }

    fn time(&mut self, states: &[State], cache: Cache, replays: usize) -> Result<Option<Timing>> {
        self.inner.time(states, cache, replays)
    }
}

/// Emulates storage and truncation in f64 and rounds only the positions.
pub(super) struct Emulated {
    pub(super) label: Label,
    pub(super) scene: Arc<Scene>,
    /// Error model that it applies.
    pub(super) does: Ingredients,
    /// Error model that it declares, which gives its bounds.
    pub(super) says: Ingredients,
    pub(super) surface: Surface,
}

impl Variant for Emulated {
    fn label(&self) -> &Label {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn ingredients(&self) -> &Ingredients {
        &self.says
    }

    fn traffic(&self) -> Vec<Part> {
        Vec::new()
    }

    fn surface(&mut self, _at: usize, state: &State) -> Result<&Surface> {
        self.does.follow(state);
        self.says.follow(state);
        let take = Take { storage: Some(&self.does), truncation: Some(&self.does) };
        let positions = positions(&self.scene, &Truth::of(state), take);
        self.surface.positions = positions.as_flattened().iter().map(|number| *number as f32).collect();
        Ok(&self.surface)
    }

    fn time(&mut self, _states: &[State], _cache: Cache, _replays: usize) -> Result<Option<Timing>> {
        Ok(None)
    }
}
