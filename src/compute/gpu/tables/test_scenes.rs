//! Small scenes for tests. Compiled for tests only.

use std::sync::Arc;

use modalcast_model::domain::{Corners, Domain, FollowConstraint, Material, Mesh, Modes, Shape, Texture, Transform};
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneParts, StorageType};

fn shape(vertices: usize, rank: usize) -> Shape {
    let rest = (0..vertices).map(|vertex| [vertex as f32, 0.5, -1.0]).collect();
    let count = vertices + 2;
    let corners = Corners {
        vertices: (0..count).map(|corner| (corner % vertices) as u32).collect(),
        normals: (0..count).map(|corner| [1.0, corner as f32, 0.0]).collect(),
        uvs: vec![[0.0, 1.0]; count],
    };
    let mesh = Mesh::new(rest, corners, vec![[0, 1, 2]]).expect("a mesh");
    let entries = (0..3 * vertices * rank).map(|entry| 0.25 * entry as f32).collect();
    Shape::new(mesh, Modes::from_columns(3 * vertices, rank, entries).expect("modes")).expect("a shape")
}

fn domain(shape: usize, material: usize) -> Domain {
    Domain { material, ..Domain::new(String::new(), shape) }
}

/// A scene whose shapes have these vertices and ranks, each used by two domains.
pub(crate) fn scene(shapes: &[(usize, usize)], normal_maps: bool, rigid: bool) -> Arc<Scene> {
    Scene::new(parts(shapes, normal_maps, rigid)).expect("a scene")
}

/// Such a scene without normal maps; all domains follow the first one.
pub(crate) fn on_the_first(shapes: &[(usize, usize)]) -> Arc<Scene> {
    followed(shapes, DeformationSettings::default())
}

/// Such a scene with these deformation settings.
pub(crate) fn followed(shapes: &[(usize, usize)], deformation: DeformationSettings) -> Arc<Scene> {
    let mut parts = parts(shapes, false, true);
    parts.deformation = deformation;
    let follow = FollowConstraint { parent: 0, frame: Transform::IDENTITY };
    parts.domains.iter_mut().skip(1).for_each(|domain| domain.follows = Some(follow));
    Scene::new(parts).expect("a scene")
}

/// A scene without normal maps, with this storage of U.
pub(crate) fn stored(shapes: &[(usize, usize)], storage: StorageType) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    parts.deformation.storage = storage;
    Scene::new(parts).expect("a scene")
}

/// A scene without normal maps, with these deformation settings.
pub(crate) fn deformed(shapes: &[(usize, usize)], deformation: DeformationSettings) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    parts.deformation = deformation;
    Scene::new(parts).expect("a scene")
}

/// A scene without normal maps, with exact normals.
pub(crate) fn exact(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    parts.deformation.normals = NormalMethod::Exact;
    Scene::new(parts).expect("a scene")
}

/// A scene without normal maps, with displacements and boxes.
pub(crate) fn kept(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    (parts.deformation.displacements, parts.deformation.boxes) = (true, true);
    Scene::new(parts).expect("a scene")
}

/// A scene without normal maps and without a shadow.
pub(crate) fn unlit(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    parts.look.shadow = None;
    Scene::new(parts).expect("a scene")
}

/// Every shape used by two domains; corner i is vertex i.
pub(crate) fn corners_match(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    for shape in &mut parts.shapes {
        let (rest, corners) = (shape.mesh.rest_positions().to_vec(), shape.mesh.corners().clone());
        let (normals, uvs) = (corners.normals[..rest.len()].to_vec(), corners.uvs[..rest.len()].to_vec());
        let mesh = Mesh::from_indexed(rest, normals, uvs, vec![[0, 1, 2]]).expect("a mesh");
        *shape = Shape::new(mesh, shape.modes.clone()).expect("a shape");
    }
    Scene::new(parts).expect("a scene")
}

/// Every shape used by one domain.
pub(crate) fn used_once(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes, false, false);
    parts.domains = (0..shapes.len()).map(|index| domain(index, 0)).collect();
    Scene::new(parts).expect("a scene")
}

fn parts(shapes: &[(usize, usize)], normal_maps: bool, rigid: bool) -> SceneParts {
    let mut parts = SceneParts::named("test");
    parts.rigid_transforms = rigid;
    parts.shapes = shapes.iter().map(|(vertices, rank)| shape(*vertices, *rank)).collect();
    let mapped = Material { normal_texture: normal_maps.then_some(0), ..Material::default() };
    parts.materials = vec![Material::default(), mapped];
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("a texture")];
    let last = shapes.len() - 1;
    parts.domains = (0..2 * shapes.len()).map(|index| domain(index / 2, usize::from(index / 2 == last))).collect();
    parts
}
