//! The state of a scene after a step: the packed coordinates q, and the transform of each transform root. A transform
//! root is a domain that follows no other domain.

use std::borrow::Cow;
use std::sync::Arc;

use super::{FloatingOrigins, Scene, StepUpdate};
use crate::domain::{ComposedTransform, Transform};

/// The domains that differ from the state with the previous serial number.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum DirtyDomains {
    /// Possibly all domains.
    #[default]
    All,
    /// At most these domains, ascending and without duplicates: domains whose q or T the last update set, domains that
    /// share a q that was set, and followers of a domain whose T was set.
    Some(Vec<u32>),
}

/// The complete state after a step.
#[derive(Debug, Clone)]
pub struct SceneState {
    /// Number of the run. Each new writer (a simulation that sends steps) starts a run, and step numbers are unique
    /// only within a run. 0 before the first step.
    pub run: u64,
    /// The step number that the writer assigned.
    pub step: u64,
    /// Simulation time in seconds, as given by the writer.
    pub time: f64,
    /// All coordinates, packed as in [`super::Layout`].
    pub q: Vec<f32>,
    /// `world_from_domain` of each transform root ([`super::TransformRoots`]), relative to its floating origin
    /// ([`Self::origin_of`]). It acts on rest positions relative to the root's pivot
    /// ([`super::TransformRoots::pivot_of`]). Unless the scene is far ([`Scene::is_far`]), every floating origin is the
    /// scene's origin before the first step with f64 translations; [`FloatingOrigins`] chooses the others.
    pub transforms: Vec<Transform>,
    /// The f64 translations and floating origins. Present after the first step with f64 translations, and always if the
    /// scene is far.
    pub origins: Option<Arc<FloatingOrigins>>,
    /// Number of updates of this state; 0 at rest. If a deformer computed the state with serial s and receives the
    /// state with serial s + 1, it may compute only the domains in `dirty_domains`. It must compute all domains for any
    /// other pair of serials, including equal serials, and after a failed step.
    pub serial: u64,
    /// The domains that the last update changed.
    pub dirty_domains: DirtyDomains,
}

/// Equality ignores `serial` and `dirty_domains`.
impl PartialEq for SceneState {
    fn eq(&self, other: &Self) -> bool {
        (self.run, self.step, self.time) == (other.run, other.step, other.time)
            && self.q == other.q
            && self.transforms == other.transforms
            && self.origins == other.origins
    }
}

impl SceneState {
    /// The state before any step.
    pub fn rest(scene: &Scene) -> Self {
        let mut q = vec![0.0; scene.layout.coordinates];
        for (domain, layout) in scene.domains.iter().zip(&scene.layout.domains) {
            q[layout.first_q..][..domain.rest_q.len()].copy_from_slice(&domain.rest_q);
        }
        let mut transforms: Vec<Transform> =
            scene.transform_roots.domains().map(|domain| scene.domains[domain as usize].placement).collect();
        let origins = scene.is_far.then(|| Arc::new(FloatingOrigins::at_rest(scene)));
        if let Some(origins) = &origins {
            for (root, transform) in transforms.iter_mut().enumerate() {
                *transform = origins.rebase_transform(root, *transform);
            }
        }
        Self { run: 0, step: 0, time: 0.0, q, transforms, origins, serial: 0, dirty_domains: DirtyDomains::All }
    }

    /// Applies a step. Domains that the step does not contain keep their values. The cost is proportional to the number
    /// of domains in the step, their followers, and the domains that share their q. Two kinds of steps also visit all
    /// transform roots: the first step with f64 translations, and the rare steps in which [`FloatingOrigins`] searches
    /// for a floating origin that more roots can share.
    pub fn apply(&mut self, scene: &Scene, update: &StepUpdate) {
        self.step = update.number;
        self.time = update.time;
        self.serial += 1;
        let mut changed_domains = Vec::new();
        for (domain, q) in update.coordinates() {
            let layout = scene.layout.domains[domain];
            self.q[layout.first_q..][..layout.rank].copy_from_slice(q);
            match scene.layout.domains_sharing_q.get(&layout.first_q) {
                Some(domains_sharing_q) if layout.rank > 0 => changed_domains.extend_from_slice(domains_sharing_q),
                _ => changed_domains.push(domain as u32),
            }
        }
        for (domain, _) in &update.transforms {
            changed_domains.push(*domain);
            changed_domains.extend_from_slice(scene.transform_roots.followers_of(*domain as usize));
        }
        // The list consists of a few ascending runs, which a stable sort merges in linear time.
        changed_domains.sort();
        changed_domains.dedup();
        let is_rebased = self.apply_transforms(scene, update);
        self.dirty_domains = if is_rebased { DirtyDomains::All } else { DirtyDomains::Some(changed_domains) };
    }

    /// Sets the transforms of a step. Returns true if transforms were rebased: converted to another floating origin,
    /// also for domains that the step does not contain.
    fn apply_transforms(&mut self, scene: &Scene, update: &StepUpdate) -> bool {
        let transform_roots = &scene.transform_roots;
        let is_first_f64_step = self.origins.is_none() && update.has_f64_translations();
        if is_first_f64_step {
            self.origins = Some(Arc::new(FloatingOrigins::from_transforms(&scene.origin_grids, &self.transforms)));
        }
        if update.transforms.is_empty() {
            return false;
        }
        let Some(origins) = self.origins.as_mut().map(Arc::make_mut) else {
            for (domain, transform) in &update.transforms {
                self.transforms[transform_roots.root_of(*domain as usize)] = *transform;
            }
            return false;
        };
        // Before the first f64 step, all transforms are relative to the scene's origin. If some root has a floating
        // origin of its own, they must be rebased.
        let needs_first_rebase = is_first_f64_step && !origins.has_no_outliers();
        for (domain, transform, translation) in update.transform_updates() {
            let root = transform_roots.root_of(domain);
            origins.set_translation(root, translation);
            self.transforms[root] = origins.rebase_transform(root, transform);
        }
        let is_rebased = origins.update_shared_origin() || needs_first_rebase;
        if is_rebased {
            // Each transform gets its stored f64 translation relative to the floating origin of its root.
            for (root, transform) in self.transforms.iter_mut().enumerate() {
                *transform = origins.rebase_transform(root, *transform);
            }
        }
        is_rebased
    }

    /// Makes this state equal to `newer`, from which it differs at most in `domains`.
    pub(super) fn copy_domains(&mut self, scene: &Scene, newer: &Self, domains: &[u32]) {
        let Self { run, step, time, q, transforms, origins, serial, dirty_domains } = self;
        (*run, *step, *time, *serial) = (newer.run, newer.step, newer.time, newer.serial);
        dirty_domains.clone_from(&newer.dirty_domains);
        let roots = domains.iter().map(|domain| scene.transform_roots.root_of(*domain as usize));
        roots.clone().for_each(|root| transforms[root] = newer.transforms[root]);
        for domain in domains {
            let layout = scene.layout.domains[*domain as usize];
            let range = layout.first_q..layout.first_q + layout.rank;
            q[range.clone()].copy_from_slice(&newer.q[range]);
        }
        match (origins.as_mut().and_then(Arc::get_mut), &newer.origins) {
            (Some(origins), Some(newer)) => origins.copy_roots(newer, roots),
            (_, newer) => origins.clone_from(newer),
        }
    }

    /// The floating origin of a transform root, in scene units from the scene's origin. The root's transform, its
    /// vertices and those of its followers are relative to this point. `root` is an index into `transforms`.
    pub fn origin_of(&self, root: usize) -> [f64; 3] {
        self.origins.as_ref().map_or([0.0; 3], |origins| origins.origin_of(root))
    }

    /// The transform of a domain's root, relative to the root's floating origin, and, if the domain is a follower,
    /// `root_from_domain`.
    pub fn composed_transform(&self, scene: &Scene, domain: usize) -> ComposedTransform {
        ComposedTransform {
            root: self.transforms[scene.transform_roots.root_of(domain)],
            frame: scene.transform_roots.root_from_domain(domain),
        }
    }

    /// `world_from_domain` of a domain in f32, as deformers use it ([`ComposedTransform::to_f32`]).
    pub fn transform_of(&self, scene: &Scene, domain: usize) -> Transform {
        self.composed_transform(scene, domain).to_f32()
    }

    /// `world_from_domain` of every domain. Borrows `transforms` if the scene has no followers.
    pub fn world_transforms(&self, scene: &Scene) -> Cow<'_, [Transform]> {
        match scene.features.followers {
            false => Cow::Borrowed(&self.transforms),
            true => (0..scene.domains.len()).map(|domain| self.transform_of(scene, domain)).collect(),
        }
    }

    /// Marks the whole state as changed. Call it after writing `q` or `transforms` directly, because `dirty_domains`
    /// does not list such writes.
    pub fn mark_all_dirty(&mut self) {
        self.serial += 1;
        self.dirty_domains = DirtyDomains::All;
    }

    /// The coordinates of one domain.
    pub fn q_of<'a>(&'a self, scene: &Scene, domain: usize) -> &'a [f32] {
        let layout = scene.layout.domains[domain];
        &self.q[layout.first_q..][..layout.rank]
    }
}

#[cfg(test)]
mod tests;
