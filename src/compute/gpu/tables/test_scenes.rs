//! Small scenes for tests. `shapes` lists the number of vertices and the rank (number of modes) of each shape. Unless
//! stated otherwise, domains 2 s and 2 s + 1 use shape s, and a shape of n vertices has n + 2 corners.

use std::sync::Arc;

use modalcast_model::domain::{Corners, Domain, FollowConstraint, Material, Mesh, Modes, Shape, Texture, Transform};
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneParts, StorageType};

fn shape(vertices: usize, rank: usize) -> Shape {
    let rest_positions = (0..vertices).map(|vertex| [vertex as f32, 0.5, -1.0]).collect();
    let corner_count = vertices + 2;
    let corners = Corners {
        vertices: (0..corner_count).map(|corner| (corner % vertices) as u32).collect(),
        normals: (0..corner_count).map(|corner| [1.0, corner as f32, 0.0]).collect(),
        uvs: vec![[0.0, 1.0]; corner_count],
    };
    let mesh = Mesh::new(rest_positions, corners, vec![[0, 1, 2]]).expect("a mesh");
    let entries = (0..3 * vertices * rank).map(|entry| 0.25 * entry as f32).collect();
    Shape::new(mesh, Modes::from_columns(3 * vertices, rank, entries).expect("modes")).expect("a shape")
}

fn domain(shape: usize, material: usize) -> Domain {
    Domain { material, ..Domain::new(String::new(), shape) }
}

/// A scene with default settings, whose transforms may have shear.
pub(crate) fn scene(shapes: &[(usize, usize)]) -> Arc<Scene> {
    Scene::new(parts(shapes)).expect("a scene")
}

/// A scene whose transforms must be rigid.
pub(crate) fn rigid_scene(shapes: &[(usize, usize)]) -> Arc<Scene> {
    Scene::new(SceneParts { rigid_transforms: true, ..parts(shapes) }).expect("a scene")
}

/// A scene whose last shape has a normal map.
pub(crate) fn scene_with_normal_map(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes);
    parts.materials[1].normal_texture = Some(0);
    Scene::new(parts).expect("a scene")
}

/// A scene with rigid transforms, in which all other domains follow the first one.
pub(crate) fn scene_with_followers(shapes: &[(usize, usize)], deformation: DeformationSettings) -> Arc<Scene> {
    let mut parts = SceneParts { rigid_transforms: true, ..parts(shapes) };
    parts.deformation = deformation;
    let follow = FollowConstraint { parent: 0, frame: Transform::IDENTITY };
    parts.domains.iter_mut().skip(1).for_each(|domain| domain.follows = Some(follow));
    Scene::new(parts).expect("a scene")
}

/// A scene whose U is stored as `storage`.
pub(crate) fn scene_with_storage(shapes: &[(usize, usize)], storage: StorageType) -> Arc<Scene> {
    let mut parts = parts(shapes);
    parts.deformation.storage = storage;
    Scene::new(parts).expect("a scene")
}

/// A scene with these deformation settings.
pub(crate) fn scene_with_deformation(shapes: &[(usize, usize)], deformation: DeformationSettings) -> Arc<Scene> {
    let mut parts = parts(shapes);
    parts.deformation = deformation;
    Scene::new(parts).expect("a scene")
}

/// A scene with exact normals.
pub(crate) fn scene_with_exact_normals(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes);
    parts.deformation.normals = NormalMethod::Exact;
    Scene::new(parts).expect("a scene")
}

/// A scene with the features `displacements` and `boxes`, whose values can be read back.
pub(crate) fn scene_with_readbacks(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes);
    (parts.deformation.displacements, parts.deformation.boxes) = (true, true);
    Scene::new(parts).expect("a scene")
}

/// A scene without a shadow.
pub(crate) fn scene_without_shadow(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes);
    parts.look.shadow = None;
    Scene::new(parts).expect("a scene")
}

/// A scene whose shapes have vertex i as corner i.
pub(crate) fn scene_with_matching_corners(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes);
    for shape in &mut parts.shapes {
        let (rest_positions, corners) = (shape.mesh.rest_positions().to_vec(), shape.mesh.corners());
        let vertex_count = rest_positions.len();
        let (normals, uvs) = (corners.normals[..vertex_count].to_vec(), corners.uvs[..vertex_count].to_vec());
        let mesh = Mesh::from_indexed(rest_positions, normals, uvs, vec![[0, 1, 2]]).expect("a mesh");
        *shape = Shape::new(mesh, shape.modes.clone()).expect("a shape");
    }
    Scene::new(parts).expect("a scene")
}

/// A scene where one domain uses each shape.
pub(crate) fn scene_without_sharing(shapes: &[(usize, usize)]) -> Arc<Scene> {
    let mut parts = parts(shapes);
    parts.domains = (0..shapes.len()).map(|index| domain(index, 0)).collect();
    Scene::new(parts).expect("a scene")
}

fn parts(shapes: &[(usize, usize)]) -> SceneParts {
    let mut parts = SceneParts::named("test");
    parts.shapes = shapes.iter().map(|(vertices, rank)| shape(*vertices, *rank)).collect();
    // The second material is that of the last shape.
    parts.materials = vec![Material::default(), Material::default()];
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("a texture")];
    let last_shape = shapes.len() - 1;
    let shape_indices = (0..2 * shapes.len()).map(|index| index / 2);
    parts.domains = shape_indices.map(|shape| domain(shape, usize::from(shape == last_shape))).collect();
    parts
}
