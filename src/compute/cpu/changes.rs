//! Finds the domains that changed since the previous step, that is, those with any changed bit in q or T.
//!
//! If the state follows the previous one, only the domains in its list of changes are compared
//! ([`SceneState::dirty_domains`]).

use rayon::prelude::*;

use modalcast_model::domain::Transform;
use modalcast_model::scene::{DirtyDomains, Scene, SceneState};

/// The values of the previous step, and the domains that have changed since.
#[derive(Debug, Default)]
pub(super) struct ChangeTracker {
    /// The previous step; `None` before the first.
    previous: Option<PreviousStep>,
    /// The changed domains, ascending.
    domains: Vec<u32>,
    all_changed: bool,
}

/// The values of a step.
#[derive(Debug)]
struct PreviousStep {
    serial: u64,
    q: Vec<f32>,
    transforms: Vec<Transform>,
}

impl PreviousStep {
    /// Whether the values of a domain differ in any bit. A domain that follows another one has no T of its own. It
    /// changes with the T of its root.
    fn differs(&self, scene: &Scene, state: &SceneState, domain: usize) -> bool {
        let layout = &scene.layout.domains[domain];
        let q_range = layout.first_q..layout.first_q + layout.rank;
        let root = scene.transform_roots.root_of(domain);
        as_bytes(&self.transforms[root].0) != as_bytes(&state.transforms[root].0)
            || as_bytes(&self.q[q_range.clone()]) != as_bytes(&state.q[q_range])
    }

    /// Copies the values of domains.
    fn copy(&mut self, scene: &Scene, state: &SceneState, domains: &[u32]) {
        for domain in domains {
            let layout = &scene.layout.domains[*domain as usize];
            let q_range = layout.first_q..layout.first_q + layout.rank;
            let root = scene.transform_roots.root_of(*domain as usize);
            self.q[q_range.clone()].copy_from_slice(&state.q[q_range]);
            self.transforms[root] = state.transforms[root];
        }
    }
}

impl ChangeTracker {
    /// Compares a step with the previous one and stores its values.
    pub(super) fn update(&mut self, scene: &Scene, state: &SceneState) {
        let domain_count = scene.domains.len();
        let Some(previous) = &mut self.previous else {
            let (serial, q, transforms) = (state.serial, state.q.clone(), state.transforms.clone());
            self.previous = Some(PreviousStep { serial, q, transforms });
            self.all_changed = true;
            self.domains = (0..domain_count as u32).collect();
            return;
        };
        let is_next = previous.serial.checked_add(1) == Some(state.serial);
        previous.serial = state.serial;
        self.domains.clear();
        let differs = |domain: &u32| previous.differs(scene, state, *domain as usize);
        match &state.dirty_domains {
            DirtyDomains::Some(listed) if is_next => {
                self.domains.extend(listed.iter().copied().filter(differs));
                previous.copy(scene, state, &self.domains);
            }
            _ => {
                let domains = (0..domain_count as u32).into_par_iter().with_min_len(4096);
                self.domains.par_extend(domains.filter(differs));
                previous.q.copy_from_slice(&state.q);
                previous.transforms.copy_from_slice(&state.transforms);
            }
        }
        self.all_changed = self.domains.len() == domain_count;
    }

    /// The domains that changed, ascending; `None` when all domains changed.
    pub(super) fn changed_domains(&self) -> Option<&[u32]> {
        (!self.all_changed).then_some(&self.domains)
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
    use modalcast_model::scene::{RawStepUpdate, StepUpdate};

    #[test]
    fn only_domains_with_changed_values_are_listed() {
        let scene =
            scene(&[(4, 2), (5, 0), (6, 3)], modalcast_model::scene::DeformationSettings::default(), &mut TestRng(1));
        let mut state = SceneState::rest(&scene);
        let mut changes = ChangeTracker::default();
        let mut update = |state: &SceneState| {
            changes.update(&scene, state);
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
        // The list of the next state names the domains that are compared.
        let raw = RawStepUpdate { q_domains: vec![0, 2], q: vec![0; 4 * 5].into(), ..RawStepUpdate::default() };
        let step = StepUpdate::parse(&scene, &raw).expect("a valid step");
        state.apply(&scene, &step);
        state.transforms[1].0[11] = 4.0;
        assert_eq!(update(&state), Some(vec![0, 2]), "control: the list lacks the change of domain 1");
        state.apply(&scene, &step);
        assert_eq!(update(&state), Some(vec![]), "expected listed domains without a change to be omitted");
        state.mark_all_dirty();
        assert_eq!(update(&state), Some(vec![1]));
    }
}
