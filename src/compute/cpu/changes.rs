//! Finds the domains that changed since the previous step, that is, those with any changed bit in q or T.
//!
//! The tracker compares the values of q and T. The state's own list of changes is not sufficient, because it misses
//! values that were written to the fields directly. The serial numbers of states are not sufficient either: an
//! unrelated state may have the same number.

use rayon::prelude::*;

use modalcast_model::domain::Transform;
use modalcast_model::scene::{Scene, SceneState};

/// The values of the previous step, and the domains that have changed since.
#[derive(Debug, Default)]
pub(super) struct ChangeTracker {
    /// q and T of the previous step; `None` before the first.
    previous: Option<(Vec<f32>, Vec<Transform>)>,
    /// Per domain, whether it changed.
    flags: Vec<bool>,
    /// The changed domains, ascending.
    domains: Vec<u32>,
    all_changed: bool,
}

impl ChangeTracker {
    /// Compares a step with the previous one and stores its values.
    pub(super) fn update(&mut self, scene: &Scene, state: &SceneState) {
        let domain_count = scene.domains.len();
        let Some((q, transforms)) = &mut self.previous else {
            self.previous = Some((state.q.clone(), state.transforms.clone()));
            (self.flags, self.all_changed) = (vec![true; domain_count], true);
            self.domains = (0..domain_count as u32).collect();
            return;
        };
        let (previous_q, previous_transforms) = (&*q, &*transforms);
        self.flags.par_iter_mut().with_min_len(4096).enumerate().for_each(|(domain, flag)| {
            let layout = &scene.layout.domains[domain];
            let q_range = layout.first_q..layout.first_q + layout.rank;
            // A domain that follows another one has no T of its own. It changes with the T of its root.
            let root = scene.transform_roots.root_of(domain);
            *flag = as_bytes(&previous_transforms[root].0) != as_bytes(&state.transforms[root].0)
                || as_bytes(&previous_q[q_range.clone()]) != as_bytes(&state.q[q_range]);
        });
        self.domains.clear();
        self.domains.extend((0..domain_count as u32).filter(|domain| self.flags[*domain as usize]));
        self.all_changed = self.domains.len() == domain_count;
        q.copy_from_slice(&state.q);
        transforms.copy_from_slice(&state.transforms);
    }

    /// The domains that changed, ascending; `None` when all domains changed.
    pub(super) fn changed_domains(&self) -> Option<&[u32]> {
        (!self.all_changed).then_some(&self.domains)
    }

    /// Whether a domain changed.
    pub(super) fn is_changed(&self, domain: usize) -> bool {
        self.flags[domain]
    }
}

/// Returns the bits to compare. As numbers, 0 and -0 are equal, but sums of them may differ in sign.
fn as_bytes(numbers: &[f32]) -> &[u8] {
    bytemuck::cast_slice(numbers)
}

#[cfg(test)]
impl ChangeTracker {
    /// A tracker in which all domains changed.
    pub(super) fn with_all_changed() -> Self {
        Self { all_changed: true, ..Self::default() }
    }

    /// A tracker in which these domains changed.
    pub(super) fn with_changed(domains: &[u32]) -> Self {
        Self { domains: domains.to_vec(), ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TestRng, scene};

    #[test]
    fn only_domains_with_changed_values_are_listed() {
        let scene =
            scene(&[(4, 2), (5, 0), (6, 3)], modalcast_model::scene::DeformationSettings::default(), &mut TestRng(1));
        let mut state = SceneState::rest(&scene);
        let mut changes = ChangeTracker::default();
        let mut update = |state: &SceneState| {
            changes.update(&scene, state);
            (0..3).for_each(|domain| {
                let is_listed = changes.changed_domains().is_none_or(|domains| domains.contains(&(domain as u32)));
                assert_eq!(changes.is_changed(domain), is_listed);
            });
            changes.changed_domains().map(<[u32]>::to_vec)
        };
        assert_eq!(update(&state), None, "expected the first step to change all domains");
        assert_eq!(update(&state), Some(vec![]));
        // Domain 0 has q[0] and q[1], domain 1 has no coordinates, and domain 2 has q[2] to q[4]. 1e-45 is the smallest
        // subnormal number.
        state.q[3] = 1e-45;
        assert_eq!(update(&state), Some(vec![2]));
        // Entry 11 of T is the z translation.
        state.q[3] = -0.0;
        state.transforms[1].0[11] = 2.0;
        assert_eq!(update(&state), Some(vec![1, 2]));
        state.q[3] = 0.0;
        assert_eq!(update(&state), Some(vec![2]), "expected 0 to differ from -0");
        state.q.fill(1.0);
        state.transforms[1].0[11] = 3.0;
        assert_eq!(update(&state), None);
        assert_eq!(update(&state), Some(vec![]));
    }
}
