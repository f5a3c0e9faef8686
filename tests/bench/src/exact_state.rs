//! A state in f64. A physics process computes in f64 and sends f32. Errors are therefore measured against the f64
//! state, and a deformer receives the same state rounded to f32.

use modalcast_model::domain::Transform;
use modalcast_model::scene::{DirtyDomains, Scene, SceneState};

/// A state in f64, as a physics process computes it before rounding; relative to the scene's origin.
#[derive(Debug, Clone, PartialEq)]
pub struct ExactState {
    /// Packed coordinates.
    pub q: Vec<f64>,
    /// `world_from_domain` of each transform root ([`modalcast_model::scene::TransformRoots`]), 3x4 row-major.
    pub transforms: Vec<[f64; 12]>,
}

impl ExactState {
    /// The state that a deformer receives: every number rounded to f32.
    pub fn state(&self) -> SceneState {
        let transforms = self.transforms.iter().map(|entries| Transform(entries.map(|entry| entry as f32)));
        let q = self.q.iter().map(|number| *number as f32).collect();
        let transforms = transforms.collect();
        SceneState {
            run: 0,
            step: 0,
            time: 0.0,
            q,
            transforms,
            origins: None,
            serial: 0,
            dirty_domains: DirtyDomains::All,
        }
    }

    /// The exact state with the numbers of an f32 state.
    pub fn of(state: &SceneState) -> Self {
        Self {
            q: state.q.iter().map(|number| f64::from(*number)).collect(),
            transforms: state.transforms.iter().map(|transform| transform.0.map(f64::from)).collect(),
        }
    }

    /// `world_from_domain` of a domain. A transform root has a transform of its own. For a follower, the result is the
    /// product of the transform of its root and its constant frame.
    pub fn transform_of(&self, scene: &Scene, domain: usize) -> [f64; 12] {
        let root_transform = &self.transforms[scene.transform_roots.root_of(domain)];
        match scene.transform_roots.root_from_domain(domain) {
            None => *root_transform,
            Some(frame) => multiply_transforms(root_transform, &frame.0.map(f64::from)),
        }
    }

    /// [`Self::transform_of`] with the absolute values of all factors. It bounds the magnitude of each entry of the
    /// exact product.
    pub(super) fn absolute_transform_of(&self, scene: &Scene, domain: usize) -> [f64; 12] {
        let root_transform = self.transforms[scene.transform_roots.root_of(domain)].map(f64::abs);
        match scene.transform_roots.root_from_domain(domain) {
            None => root_transform,
            Some(frame) => multiply_transforms(&root_transform, &frame.0.map(|entry| f64::from(entry.abs()))),
        }
    }
}

/// The product of two affine transforms, 3x4 row-major.
fn multiply_transforms(left: &[f64; 12], right: &[f64; 12]) -> [f64; 12] {
    std::array::from_fn(|entry| {
        let (row, column) = (&left[entry / 4 * 4..][..4], entry % 4);
        let sum = row[0] * right[column] + row[1] * right[4 + column] + row[2] * right[8 + column];
        if column == 3 { sum + row[3] } else { sum }
    })
}
