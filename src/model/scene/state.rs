//! The values of one step: packed coordinates q, and one transform per domain that follows no other.

use std::borrow::Cow;
use std::sync::Arc;

use super::{Cells, Movers, Scene, Update};
use crate::domain::{Composed, Transform};

/// Which domains differ from the state one serial number before.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Changed {
    /// Possibly all.
    #[default]
    All,
    /// These at most, ascending, each once: those whose q or T the last update named, those that share a named q, and
    /// those that follow a named T.
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
    /// `world_from_domain` of each mover ([`super::Movers`]), which is each domain where nobody follows; relative to its
    /// cell ([`Self::cell_of`]): the scene's origin unless a step with f64 translations took it far from it.
    pub transforms: Vec<Transform>,
    /// Where movers are in f64, once a step with f64 translations has come.
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
        let transforms = scene.movers.domains().map(|domain| scene.domains[domain as usize].placement).collect();
        Self { run: 0, step: 0, time: 0.0, q, transforms, cells: None, serial: 0, changed: Changed::All }
    }

    /// Applies a whole step. What it does not name keeps its value. The work is that of the named domains and of the
    /// lists of those that share their q or follow them, but for the rare step after which the shared cell follows its domains.
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
        for (domain, _) in &update.transforms {
            changed.push(*domain);
            changed.extend_from_slice(scene.movers.followers_of(*domain as usize));
        }
        changed.sort_unstable();
        changed.dedup();
        let anew = self.place(&scene.movers, update);
        self.changed = if anew { Changed::All } else { Changed::Some(changed) };
    }

    /// Sets the named transforms. True when others were expressed anew.
    fn place(&mut self, movers: &Movers, update: &Update) -> bool {
        let begins = self.cells.is_none() && update.has_f64();
        if begins {
            self.cells = Some(Arc::new(Cells::of(&self.transforms)));
        }
        if update.transforms.is_empty() {
            return false;
        }
        let Some(cells) = self.cells.as_mut().map(Arc::make_mut) else {
            for (domain, transform) in &update.transforms {
                self.transforms[movers.of(*domain as usize)] = *transform;
            }
            return false;
        };
        let anew = begins && !cells.is_one();
        for (domain, transform, translation) in update.placements() {
            let mover = movers.of(domain);
            cells.set(mover, translation);
            self.transforms[mover] = cells.express(mover, transform);
        }
        let anew = cells.follow() || anew;
        if anew {
            for (mover, transform) in self.transforms.iter_mut().enumerate() {
                *transform = cells.express(mover, *transform);
            }
        }
        anew
    }

    /// The f64 point that the transform of a mover, its vertices and those of its followers are relative to, in scene
    /// units from the scene's origin. `mover` is an index in `transforms`.
    pub fn cell_of(&self, mover: usize) -> [f64; 3] {
        self.cells.as_ref().map_or([0.0; 3], |cells| cells.cell_of(mover))
    }

    /// The transform of a domain and, of a follower, its frame; relative to the cell of its mover.
    pub fn composed(&self, scene: &Scene, domain: usize) -> Composed {
        Composed { mover: self.transforms[scene.movers.of(domain)], frame: scene.movers.frame_of(domain) }
    }

    /// `world_from_domain` of a domain in f32, as deformers have it ([`Composed::rounded`]).
    pub fn transform_of(&self, scene: &Scene, domain: usize) -> Transform {
        self.composed(scene, domain).rounded()
    }

    /// That of every domain; `transforms` itself where nobody follows.
    pub fn world_transforms(&self, scene: &Scene) -> Cow<'_, [Transform]> {
        match scene.needs.followers {
            false => Cow::Borrowed(&self.transforms),
            true => (0..scene.domains.len()).map(|domain| self.transform_of(scene, domain)).collect(),
        }
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
