//! A variant that is wrong on purpose.

use std::sync::Arc;

use super::ingredients::Ingredients;
use super::timing::{Cache, Timing};
use super::traffic::Part;
use super::variant::{Label, Variant};
use crate::deform::Surface;
use crate::error::Result;
use crate::scene::{Scene, State};

/// Another variant, with something added to one coordinate.
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
