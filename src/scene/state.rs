//! The values of one step: packed coordinates q and one transform per domain.

use std::sync::Arc;

use super::{Cells, Scene, Update};
use crate::domain::Transform;

/// Which domains differ from the state one serial number before.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Changed {
    /// Possibly all.
    #[default]
    All,
    /// These at most, ascending, each once: those whose q or T the last update named, and those that share a named q.
    Some(Vec<u32>),
}

/// The whole state that a step leaves behind.
#[derive(Debug, Clone)]
pub struct State {
    /// Counts the writers of this scene; step numbers belong to one writer. 0 before the first.
    pub run: u64,
    /// The number that the writer gave the last step.
    pub step: u64,
    /// Simulation time in seconds, as the writer said.
    pub time: f64,
    /// All coordinates, packed as [`super::Layout`] says.
    pub q: Vec<f32>,
    /// `world_from_domain` of each domain, relative to the domain's cell ([`Self::cell_of`]): the scene's origin unless a
    /// step with f64 translations took the domain far from it.
    pub transforms: Vec<Transform>,
    /// Where domains are in f64, once a step with f64 translations has come.
    pub cells: Option<Arc<Cells>>,
    /// Counts the updates of this state; 0 at rest. A deformer that has computed serial s and is given s + 1 need compute
    /// only the domains in `changed`. Any other pair of numbers, equal ones included, means all, and so does a deformer's
    /// own failure.
    pub serial: u64,
    /// What the last update changed.
    pub changed: Changed,
}

/// Equal when they show the same: how they came about (`serial`, `changed`) does not count.
impl PartialEq for State {
    fn eq(&self, other: &Self) -> bool {
        (self.run, self.step, self.time) == (other.run, other.step, other.time)
            && self.q == other.q
            && self.transforms == other.transforms
            && self.cells == other.cells
    }
}

impl State {
    /// The state before any step.
    pub fn rest(scene: &Scene) -> Self {
        let mut q = vec![0.0; scene.layout.coordinates];
        for (domain, slot) in scene.domains.iter().zip(&scene.layout.slots) {
            q[slot.first_q..][..domain.rest_q.len()].copy_from_slice(&domain.rest_q);
        }
        let transforms = scene.domains.iter().map(|domain| domain.placement).collect();
        Self { run: 0, step: 0, time: 0.0, q, transforms, cells: None, serial: 0, changed: Changed::All }
    }

    /// Applies a whole step. What it does not name keeps its value. The work is that of the named domains, but for the
    /// rare step after which the shared cell follows its domains.
    pub fn apply(&mut self, scene: &Scene, update: &Update) {
        self.step = update.number;
        self.time = update.time;
        self.serial += 1;
        let mut changed = Vec::new();
        for (domain, q) in update.coordinates() {
            let slot = scene.layout.slots[domain];
            self.q[slot.first_q..][..slot.rank].copy_from_slice(q);
            match scene.layout.sharers.get(&slot.first_q) {
                Some(sharers) if slot.rank > 0 => changed.extend_from_slice(sharers),
                _ => changed.push(domain as u32),
            }
        }
        changed.extend(update.transforms.iter().map(|(domain, _)| *domain));
        changed.sort_unstable();
        changed.dedup();
        let anew = self.place(update);
        self.changed = if anew { Changed::All } else { Changed::Some(changed) };
    }

    /// Sets the named transforms. True when others were expressed anew.
    fn place(&mut self, update: &Update) -> bool {
        let begins = self.cells.is_none() && update.has_f64();
        if begins {
            self.cells = Some(Arc::new(Cells::of(&self.transforms)));
        }
        if update.transforms.is_empty() {
            return false;
        }
        let Some(cells) = self.cells.as_mut().map(Arc::make_mut) else {
            for (domain, transform) in &update.transforms {
                self.transforms[*domain as usize] = *transform;
            }
            return false;
        };
        let anew = begins && !cells.is_one();
        for (domain, transform, translation) in update.placements() {
            cells.set(domain, translation);
            self.transforms[domain] = cells.express(domain, transform);
        }
        let anew = cells.follow() || anew;
        if anew {
            for (domain, transform) in self.transforms.iter_mut().enumerate() {
                *transform = cells.express(domain, *transform);
            }
        }
        anew
    }

    /// The f64 point that a domain's transform and vertices are relative to, in scene units from the scene's origin.
    pub fn cell_of(&self, domain: usize) -> [f64; 3] {
        self.cells.as_ref().map_or([0.0; 3], |cells| cells.cell_of(domain))
    }

    /// To be called after `q` or `transforms` were written by hand, so that no deformer takes the change list for whole.
    pub fn touch(&mut self) {
        self.serial += 1;
        self.changed = Changed::All;
    }

    /// Coordinates of one domain.
    pub fn q_of<'a>(&'a self, scene: &Scene, domain: usize) -> &'a [f32] {
        let slot = scene.layout.slots[domain];
        &self.q[slot.first_q..][..slot.rank]
    }
}

#[cfg(test)]
mod tests;
