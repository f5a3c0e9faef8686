//! Reuses the memory of earlier states, so that a step costs what it changes. A new state is made from an earlier one
//! without readers, and only the domains in which the two differ are copied.

use std::sync::Arc;

use super::{DirtyDomains, Scene, SceneState, StepUpdate};

/// Maximum number of states in a pool: the current one and the next one, one that is written to disk, and those that
/// readers of earlier steps hold. Without a free one, all of a state is copied.
const MAX_STATES: usize = 6;

/// The latest states of a scene.
#[derive(Debug, Default)]
pub struct StatePool {
    /// Oldest first.
    states: Vec<PooledState>,
}

#[derive(Debug)]
struct PooledState {
    state: Arc<SceneState>,
    /// The domains in which the state may differ from the newest one of the pool. A domain may be listed repeatedly.
    outdated: Vec<u32>,
}

impl StatePool {
    /// The state after a step of a run that changes `base`, as [`SceneState::apply`] computes it.
    pub fn apply(&mut self, scene: &Scene, base: &Arc<SceneState>, run: u64, update: &StepUpdate) -> Arc<SceneState> {
        let mut state = self.copy_of(scene, base);
        if let Some(state) = Arc::get_mut(&mut state) {
            state.apply(scene, update);
            state.run = run;
        }
        self.insert(scene, Arc::clone(&state));
        state
    }

    /// A copy of `base` with a single owner.
    fn copy_of(&mut self, scene: &Scene, base: &Arc<SceneState>) -> Arc<SceneState> {
        let Some(base_index) = self.states.iter().position(|pooled| Arc::ptr_eq(&pooled.state, base)) else {
            // The states of the pool have no known relation to this one.
            self.states.clear();
            self.states.push(PooledState { state: Arc::clone(base), outdated: Vec::new() });
            return Arc::new(SceneState::clone(base));
        };
        // `base` is not the newest state if the device has rejected a step. All states then differ from `base` also in
        // the domains in which `base` differs from the newest one.
        let base_outdated = std::mem::take(&mut self.states[base_index].outdated);
        self.states.iter_mut().for_each(|pooled| pooled.outdated.extend_from_slice(&base_outdated));
        self.states[base_index].outdated.clear();
        let is_free = |pooled: &mut PooledState| Arc::get_mut(&mut pooled.state).is_some();
        match self.states.iter_mut().position(is_free) {
            Some(index) => {
                let PooledState { mut state, outdated } = self.states.remove(index);
                if let Some(state) = Arc::get_mut(&mut state) {
                    state.copy_domains(scene, base, &outdated);
                }
                state
            }
            None => Arc::new(SceneState::clone(base)),
        }
    }

    /// Adds the newest state.
    fn insert(&mut self, scene: &Scene, state: Arc<SceneState>) {
        match &state.dirty_domains {
            DirtyDomains::All => self.states.clear(),
            DirtyDomains::Some(changed) => {
                self.states.iter_mut().for_each(|pooled| pooled.outdated.extend_from_slice(changed));
                // A state with many differences is copied faster as a whole.
                self.states.retain(|pooled| pooled.outdated.len() <= scene.domains.len() / 2);
            }
        }
        if self.states.len() >= MAX_STATES {
            self.states.remove(0);
        }
        self.states.push(PooledState { state, outdated: Vec::new() });
    }
}

#[cfg(test)]
mod tests;
