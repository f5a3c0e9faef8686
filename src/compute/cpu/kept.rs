//! The modes that each domain sums in a step, in scenes with a truncation budget.

use rayon::prelude::*;

use super::changes::Changes;
use super::sum::Summed;
use crate::storage::{Amounts, Truncation, bound, modes_per_chunk, reaches};
use modalcast_model::scene::{Scene, State};

/// The kept modes of all domains.
#[derive(Debug)]
pub(super) struct Kept {
    /// Error budget, scene units.
    budget: f64,
    /// Per shape.
    reaches: Vec<Vec<f64>>,
    domains: Vec<List>,
}

#[derive(Debug)]
struct List {
    truncation: Truncation,
    q: Vec<f32>,
    chunks: Vec<u16>,
}

impl Kept {
    /// Starts without truncated modes. `None` for a scene without a budget.
    pub(super) fn new(scene: &Scene) -> Option<Self> {
        let metres = scene.deformation.truncation.filter(|_| scene.needs.truncation)?;
        let list = |domain| {
            let rank = scene.rank_of(domain);
            List { truncation: Truncation::new(rank), q: vec![0.0; rank], chunks: Vec::with_capacity(rank) }
        };
        Some(Self {
            budget: metres / scene.unit,
            reaches: scene.shapes.par_iter().map(|shape| reaches(&shape.modes)).collect(),
            domains: (0..scene.domains.len()).map(list).collect(),
        })
    }

    /// Updates the domains that changed.
    pub(super) fn follow(&mut self, scene: &Scene, state: &State, changes: &Changes) {
        let per_chunk = modes_per_chunk(scene.deformation.storage) as u16;
        let Self { budget, reaches, domains } = self;
        let decide = |(domain, list): (usize, &mut List)| {
            if list.q.is_empty() || !changes.is(domain) {
                return;
            }
            let q = state.q_of(scene, domain);
            let reaches = &reaches[scene.domains[domain].shape];
            list.truncation.update(Amounts { q, reaches, norm: bound::norm(&state.composed(scene, domain)) }, *budget);
            list.q.fill(0.0);
            list.chunks.clear();
            for mode in list.truncation.kept() {
                list.q[usize::from(*mode)] = q[usize::from(*mode)];
                if list.chunks.last() != Some(&(mode / per_chunk)) {
                    list.chunks.push(mode / per_chunk);
                }
            }
        };
        domains.par_iter_mut().enumerate().with_min_len(64).for_each(decide);
    }

    /// The modes that a domain sums.
    pub(super) fn of(&self, domain: usize) -> Summed<'_> {
        let list = &self.domains[domain];
        Summed { q: &list.q, chunks: &list.chunks }
    }

    /// The truncation of a domain.
    pub(super) fn truncation(&self, domain: usize) -> &Truncation {
        &self.domains[domain].truncation
    }
}
