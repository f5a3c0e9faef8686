//! The modes that each domain sums in a step, in scenes with a truncation budget. All other modes are truncated.

use rayon::prelude::*;

use super::changes::ChangeTracker;
use super::sum::ModeSelection;
use crate::storage::{Truncation, TruncationInput, bound, max_row_norms, modes_per_chunk};
use modalcast_model::scene::{Scene, SceneState};

/// The retained modes of all domains.
#[derive(Debug)]
pub(super) struct RetainedModes {
    /// Maximum error of a vertex by truncation, in scene units.
    budget: f64,
    /// Per shape and mode, the largest displacement of a vertex by a unit coordinate, in scene units.
    max_row_norms: Vec<Vec<f64>>,
    domains: Vec<DomainModes>,
}

/// The retained modes of a domain.
#[derive(Debug)]
struct DomainModes {
    truncation: Truncation,
    /// Coordinates; zero for truncated modes.
    q: Vec<f32>,
    /// Chunks (modes that are stored together) with at least one retained mode, ascending.
    chunks: Vec<u16>,
}

impl RetainedModes {
    /// Starts with no truncated modes. Returns `None` for a scene without a budget.
    pub(super) fn new(scene: &Scene) -> Option<Self> {
        let budget_meters = scene.deformation.truncation.filter(|_| scene.features.truncation)?;
        let create_domain_modes = |domain| {
            let rank = scene.rank_of(domain);
            DomainModes { truncation: Truncation::new(rank), q: vec![0.0; rank], chunks: Vec::with_capacity(rank) }
        };
        Some(Self {
            budget: budget_meters / scene.unit,
            max_row_norms: scene.shapes.par_iter().map(|shape| max_row_norms(&shape.modes)).collect(),
            domains: (0..scene.domains.len()).map(create_domain_modes).collect(),
        })
    }

    /// Selects the modes of the domains that changed.
    pub(super) fn update(&mut self, scene: &Scene, state: &SceneState, changes: &ChangeTracker) {
        let chunk_modes = modes_per_chunk(scene.deformation.storage) as u16;
        let Self { budget, max_row_norms, domains } = self;
        let update_domain = |(domain, modes): (usize, &mut DomainModes)| {
            if modes.q.is_empty() || !changes.is_changed(domain) {
                return;
            }
            let q = state.q_of(scene, domain);
            let max_row_norms = &max_row_norms[scene.domains[domain].shape];
            modes.truncation.update(
                TruncationInput {
                    q,
                    max_row_norms,
                    norm: bound::linear_norm_bound(&state.composed_transform(scene, domain)),
                },
                *budget,
            );
            modes.q.fill(0.0);
            modes.chunks.clear();
            for mode in modes.truncation.retained() {
                modes.q[usize::from(*mode)] = q[usize::from(*mode)];
                if modes.chunks.last() != Some(&(mode / chunk_modes)) {
                    modes.chunks.push(mode / chunk_modes);
                }
            }
        };
        domains.par_iter_mut().enumerate().with_min_len(64).for_each(update_domain);
    }

    /// The modes that a domain sums.
    pub(super) fn selection_of(&self, domain: usize) -> ModeSelection<'_> {
        let modes = &self.domains[domain];
        ModeSelection { q: &modes.q, chunks: &modes.chunks }
    }

    /// The truncation of a domain.
    pub(super) fn truncation(&self, domain: usize) -> &Truncation {
        &self.domains[domain].truncation
    }
}
