//! Random scenes and states: shapes of n vertices and r modes, with rotated, mirrored and sheared domains.

use std::sync::Arc;

use modalcast_model::domain::{Corners, Domain, Material, Mesh, Metadata, Modes, Shape, Texture, Transform};
use modalcast_model::scene::{Scene, SceneParts, SceneState};
use nalgebra::{Matrix3, Rotation3, Vector3};

/// A small deterministic random generator (splitmix64).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    /// Uniform in -1 to 1.
    pub(crate) fn next_number(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    /// Three numbers in -1 to 1.
    pub(crate) fn next_triple(&mut self) -> [f32; 3] {
        std::array::from_fn(|_| self.next_number())
    }

    fn vector(&mut self) -> Vector3<f64> {
        Vector3::from(self.next_triple()).cast()
    }

    /// A rotation times a scale, optionally mirrored.
    pub(crate) fn next_similarity(&mut self, mirror: bool) -> Transform {
        let turn = Rotation3::from_scaled_axis(self.vector() * 3.0).into_inner();
        let scale = f64::from(1.0 + 0.5 * self.next_number()) * if mirror { -1.0 } else { 1.0 };
        Transform::from_parts(&(turn * scale), &(self.vector() * 2.0))
    }

    /// A transform with a general linear part.
    pub(crate) fn next_shear(&mut self) -> Transform {
        let linear = Matrix3::from_columns(&[self.vector(), self.vector(), self.vector()]) + Matrix3::identity();
        Transform::from_parts(&linear, &(self.vector() * 2.0))
    }
}

/// A shape with coordinates in -1 to 1 whose modes displace it by about its own size at q = 1. It has more corners than
/// vertices.
pub(crate) fn random_shape(random: &mut Random, vertices: usize, rank: usize) -> Shape {
    let rest = (0..vertices).map(|_| random.next_triple()).collect();
    let count = vertices + 3;
    let corners = Corners {
        vertices: (0..count).map(|corner| (corner * 7 % vertices) as u32).collect(),
        normals: (0..count).map(|_| random.next_triple()).collect(),
        uvs: (0..count).map(|_| [random.next_number(), random.next_number()]).collect(),
    };
    let triangles = (0..count as u32 - 2).map(|first| [first, first + 1, first + 2]).collect();
    let mesh = Mesh::new(rest, corners, triangles).expect("expected a valid mesh");
    let size = 1.0 / (rank.max(1) as f32).sqrt();
    let entries = (0..3 * vertices * rank).map(|_| size * random.next_number()).collect();
    Shape::new(mesh, Modes::from_columns(3 * vertices, rank, entries).expect("expected valid modes"))
        .expect("expected a valid shape")
}

pub(crate) fn new_domain(shape: usize, material: usize) -> Domain {
    Domain {
        name: format!("shape {shape}"),
        shape,
        material,
        placement: Transform::IDENTITY,
        material_ranges: vec![],
        attachment: None,
        follows: None,
        rest_q: Vec::new(),
        shares_q_with: None,
        metadata: Metadata::default(),
    }
}

/// Index of the material of [`parts_of_shapes`] with a normal map; material 0 has none.
pub(crate) const NORMAL_MAPPED: usize = 1;

/// Scene parts with these shapes, two materials and no domains.
pub(crate) fn parts_of_shapes(shapes: Vec<Shape>) -> SceneParts {
    let mut parts = SceneParts::named("random");
    parts.shapes = shapes;
    let mapped = Material { normal_texture: Some(0), ..Material::default() };
    parts.materials = vec![Material::default(), mapped];
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("expected a valid texture")];
    parts
}

/// A scene of shapes (n, r) with `instances` domains per shape; with `normal_maps`, every other shape has a normal map.
pub(crate) fn random_scene(shapes: &[(usize, usize)], instances: usize, normal_maps: bool, rigid: bool) -> Arc<Scene> {
    let mut random = Random(shapes.len() as u64);
    let mut parts =
        parts_of_shapes(shapes.iter().map(|(vertices, rank)| random_shape(&mut random, *vertices, *rank)).collect());
    parts.rigid_transforms = rigid;
    for _ in 0..instances {
        for index in 0..shapes.len() {
            let mapped = normal_maps && index % 2 == 0;
            parts.domains.push(new_domain(index, if mapped { NORMAL_MAPPED } else { 0 }));
        }
    }
    Scene::new(parts).expect("expected a valid scene")
}

/// A random state: every third domain is sheared if the scene allows it, and every third is mirrored.
pub(crate) fn random_state(scene: &Scene, seed: u64) -> SceneState {
    let mut random = Random(seed);
    let mut state = SceneState::rest(scene);
    state.q.iter_mut().for_each(|coordinate| *coordinate = random.next_number());
    for (index, transform) in state.transforms.iter_mut().enumerate() {
        *transform = match index % 3 {
            0 => random.next_similarity(false),
            1 if scene.features.shear => random.next_shear(),
            _ => random.next_similarity(true),
        };
    }
    state
}
