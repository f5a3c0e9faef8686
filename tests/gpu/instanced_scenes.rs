//! Scenes with many domains of one shape.

use std::sync::Arc;

use modalcast_model::scene::{DeformationSettings, Scene, SceneParts, SceneState, StorageType};

use crate::scenes::{self, Random};

/// Parts of a scene with `domains` domains of one random shape.
pub(crate) fn instanced_parts(
    vertices: usize,
    rank: usize,
    domains: usize,
    deformation: DeformationSettings,
) -> SceneParts {
    let mut parts = scenes::parts_of_shapes(vec![scenes::random_shape(&mut Random(7), vertices, rank)]);
    parts.domains = vec![scenes::new_domain(0, scenes::PLAIN_MATERIAL); domains];
    parts.deformation = deformation;
    parts
}

/// Default deformation settings with this storage of U.
pub(crate) fn with_storage(storage: StorageType) -> DeformationSettings {
    DeformationSettings { storage, ..DeformationSettings::default() }
}

pub(crate) fn build_scene(parts: SceneParts) -> Arc<Scene> {
    Scene::new(parts).expect("expected a valid scene")
}

/// Three random states.
pub(crate) fn random_states(scene: &Scene) -> Vec<SceneState> {
    (1..=3).map(|seed| scenes::random_state(scene, seed)).collect()
}
