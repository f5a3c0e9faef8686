//! Scenes with many domains of one shape.

use std::sync::Arc;

use modalcast_model::scene::{DeformationSettings, Scene, SceneParts, SceneState, StorageType};

use crate::scenes::{self, Random};

/// Parts with `count` domains of one shape and this deformation.
pub(crate) fn ensemble((vertices, rank, count): (usize, usize, usize), deformation: DeformationSettings) -> SceneParts {
    let mut parts = scenes::parts(vec![scenes::shape(&mut Random(7), vertices, rank)]);
    parts.domains = vec![scenes::domain(0, 0); count];
    parts.deformation = deformation;
    parts
}

pub(crate) fn stored(storage: StorageType) -> DeformationSettings {
    DeformationSettings { storage, ..DeformationSettings::default() }
}

pub(crate) fn made(parts: SceneParts) -> Arc<Scene> {
    Scene::new(parts).expect("a scene")
}

pub(crate) fn states(scene: &Scene) -> Vec<SceneState> {
    (1..=3).map(|seed| scenes::state(scene, seed)).collect()
}
