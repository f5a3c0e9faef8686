//! Scenes with many domains of one shape.

use std::sync::Arc;

use modalcast_model::scene::{Deformation, Parts, Scene, State, Storage};

use crate::scenes::{self, Random};

/// Parts with `count` domains of one shape and this deformation.
pub(crate) fn ensemble((vertices, rank, count): (usize, usize, usize), deformation: Deformation) -> Parts {
    let mut parts = scenes::parts(vec![scenes::shape(&mut Random(7), vertices, rank)]);
    parts.domains = vec![scenes::domain(0, 0); count];
    parts.deformation = deformation;
    parts
}

pub(crate) fn stored(storage: Storage) -> Deformation {
    Deformation { storage, ..Deformation::default() }
}

pub(crate) fn made(parts: Parts) -> Arc<Scene> {
    Scene::new(parts).expect("a scene")
}

pub(crate) fn states(scene: &Scene) -> Vec<State> {
    (1..=3).map(|seed| scenes::state(scene, seed)).collect()
}
