//! Finds the domains that changed since the last step: those with any changed bit in q or T.
//!
//! The values themselves are compared, because the state's list of changes is not sufficient: it misses values that
//! were written directly, and states of another history with the same serial number.

use rayon::prelude::*;

use modalcast_model::domain::Transform;
use modalcast_model::scene::{Scene, SceneState};

/// The values of the last step, and the domains that changed since.
#[derive(Debug, Default)]
pub(super) struct ChangeTracker {
    /// Values of the last step; `None` before the first.
    last: Option<(Vec<f32>, Vec<Transform>)>,
    flags: Vec<bool>,
    domains: Vec<u32>,
    all_changed: bool,
}

impl ChangeTracker {
    /// Compares a step with the previous one and stores its values.
    pub(super) fn update(&mut self, scene: &Scene, state: &SceneState) {
        let count = scene.domains.len();
        let Some((q, transforms)) = &mut self.last else {
            self.last = Some((state.q.clone(), state.transforms.clone()));
            (self.flags, self.all_changed) = (vec![true; count], true);
            self.domains = (0..count as u32).collect();
            return;
        };
        let (last_q, last_transforms) = (&*q, &*transforms);
        self.flags.par_iter_mut().with_min_len(4096).enumerate().for_each(|(domain, flag)| {
            let slot = &scene.layout.domains[domain];
            let range = slot.first_q..slot.first_q + slot.rank;
            let mover = scene.transform_roots.root_of(domain);
            *flag = bits(&last_transforms[mover].0) != bits(&state.transforms[mover].0)
                || bits(&last_q[range.clone()]) != bits(&state.q[range]);
        });
        self.domains.clear();
        self.domains.extend((0..count as u32).filter(|domain| self.flags[*domain as usize]));
        self.all_changed = self.domains.len() == count;
        q.copy_from_slice(&state.q);
        transforms.copy_from_slice(&state.transforms);
    }

    /// The domains that changed, ascending; `None` when all did.
    pub(super) fn changed_domains(&self) -> Option<&[u32]> {
        (!self.all_changed).then_some(&self.domains)
    }

    /// Whether a domain changed.
    pub(super) fn is_changed(&self, domain: usize) -> bool {
        self.flags[domain]
    }
}

/// Compares bits, because zeros of different sign may give sums with zeros of different sign.
fn bits(numbers: &[f32]) -> &[u8] {
    bytemuck::cast_slice(numbers)
}

#[cfg(test)]
impl ChangeTracker {
    pub(super) fn all() -> Self {
        Self { all_changed: true, ..Self::default() }
    }

    pub(super) fn of(domains: &[u32]) -> Self {
        Self { domains: domains.to_vec(), ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TestRng, scene};

    #[test]
    fn only_domains_whose_numbers_changed_are_named() {
        let scene =
            scene(&[(4, 2), (5, 0), (6, 3)], modalcast_model::scene::DeformationSettings::default(), &mut TestRng(1));
        let mut state = SceneState::rest(&scene);
        let mut changes = ChangeTracker::default();
        let mut update = |state: &SceneState| {
            changes.update(&scene, state);
            (0..3).for_each(|domain| {
                let named = changes.changed_domains().is_none_or(|domains| domains.contains(&(domain as u32)));
                assert_eq!(changes.is_changed(domain), named);
            });
            changes.changed_domains().map(<[u32]>::to_vec)
        };
        assert_eq!(update(&state), None, "the first step changes all");
        assert_eq!(update(&state), Some(vec![]));
        state.q[3] = 1e-45;
        assert_eq!(update(&state), Some(vec![2]));
        state.q[3] = -0.0;
        state.transforms[1].0[11] = 2.0;
        assert_eq!(update(&state), Some(vec![1, 2]));
        state.q[3] = 0.0;
        assert_eq!(update(&state), Some(vec![2]), "zeros of both signs differ");
        state.q.fill(1.0);
        state.transforms[1].0[11] = 3.0;
        assert_eq!(update(&state), None);
        assert_eq!(update(&state), Some(vec![]));
    }
}
