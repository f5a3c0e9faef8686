//! Test scenes for the unit tests of the engine.

use std::sync::Arc;

use modalcast_model::domain::{Attachment, Domain, Material, Mesh, Metadata, Modes, Shape, Transform};
use modalcast_model::scene::{DeformationSettings, Scene, SceneParts};

/// Two strips of two triangles with two modes each; the second is attached to the first.
pub(super) fn two_strips() -> Arc<Scene> {
    strips(DeformationSettings::default())
}

/// The same scene with displacements and boxes enabled.
pub(super) fn strips_with_attributes() -> Arc<Scene> {
    strips(DeformationSettings { displacements: true, boxes: true, ..DeformationSettings::default() })
}

fn strips(deformation: DeformationSettings) -> Arc<Scene> {
    let rest = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
    let mesh =
        Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]]).expect("a square");
    let columns = (0..24).map(|entry| if entry % 5 == 0 { 0.5 } else { 0.0 }).collect();
    let shape = Shape::new(mesh, Modes::from_columns(12, 2, columns).expect("12 x 2")).expect("fits");
    let domain = |name: &str, attachment| Domain {
        name: name.into(),
        shape: 0,
        material: 0,
        material_ranges: vec![],
        placement: Transform::IDENTITY,
        attachment,
        follows: None,
        rest_q: vec![],
        shares_q_with: None,
        metadata: Metadata::default(),
    };
    let joint = Attachment { parent: 0, frame: Transform::IDENTITY, rows: vec![1, 2] };
    let domains = vec![domain("left", None), domain("right", Some(joint))];
    let (shapes, materials) = (vec![shape], vec![Material::default()]);
    Scene::new(SceneParts { shapes, materials, domains, deformation, ..SceneParts::named("strips") }).expect("a scene")
}
