//! The values of one step: packed coordinates q and one transform per domain.

use super::{Scene, Update};
use crate::domain::Transform;

/// The whole state that a step leaves behind.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Counts the writers of this scene; step numbers belong to one writer. 0 before the first.
    pub run: u64,
    /// The number that the writer gave the last step.
    pub step: u64,
    /// Simulation time in seconds, as the writer said.
    pub time: f64,
    /// All coordinates, packed as [`super::Layout`] says.
    pub q: Vec<f32>,
    /// `world_from_domain` of each domain, relative to the scene's origin.
    pub transforms: Vec<Transform>,
}

impl State {
    /// The state before any step.
    pub fn rest(scene: &Scene) -> Self {
        let mut q = vec![0.0; scene.layout.coordinates];
        for (domain, slot) in scene.domains.iter().zip(&scene.layout.slots) {
            q[slot.first_q..][..domain.rest_q.len()].copy_from_slice(&domain.rest_q);
        }
        let transforms = scene.domains.iter().map(|domain| domain.placement).collect();
        Self { run: 0, step: 0, time: 0.0, q, transforms }
    }

    /// Applies a whole step. What it does not name keeps its value.
    pub fn apply(&mut self, scene: &Scene, update: &Update) {
        self.step = update.number;
        self.time = update.time;
        for (domain, q) in update.coordinates() {
            let slot = scene.layout.slots[domain];
            self.q[slot.first_q..][..slot.rank].copy_from_slice(q);
        }
        for (domain, transform) in &update.transforms {
            self.transforms[*domain as usize] = *transform;
        }
    }

    /// Coordinates of one domain.
    pub fn q_of<'a>(&'a self, scene: &Scene, domain: usize) -> &'a [f32] {
        let slot = scene.layout.slots[domain];
        &self.q[slot.first_q..][..slot.rank]
    }
}
