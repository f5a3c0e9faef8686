//! Random scenes and states: shapes of n vertices and r modes (their rank), with rotated, mirrored and sheared domains.

use std::sync::Arc;

use modalcast_model::domain::{Corners, Domain, Material, Mesh, Modes, Shape, Texture, Transform};
use modalcast_model::scene::{Scene, SceneParts, SceneState};
use nalgebra::{Matrix3, Rotation3, Vector3};

/// A small deterministic random generator (splitmix64).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    /// Uniform in -1 to 1: 24 random bits, as a multiple of 2^-23.
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

    fn next_vector(&mut self) -> Vector3<f64> {
        Vector3::from(self.next_triple()).cast()
    }

    /// A random rotation, scale and translation, optionally with a reflection.
    pub(crate) fn next_similarity(&mut self, is_mirrored: bool) -> Transform {
        let rotation = Rotation3::from_scaled_axis(self.next_vector() * 3.0).into_inner();
        let scale = f64::from(1.0 + 0.5 * self.next_number()) * if is_mirrored { -1.0 } else { 1.0 };
        Transform::from_parts(&(rotation * scale), &(self.next_vector() * 2.0))
    }

    /// A random transform with shear.
    pub(crate) fn next_shear(&mut self) -> Transform {
        let linear =
            Matrix3::from_columns(&[self.next_vector(), self.next_vector(), self.next_vector()]) + Matrix3::identity();
        Transform::from_parts(&linear, &(self.next_vector() * 2.0))
    }
}

/// A shape with coordinates in -1 to 1 whose modes displace it by about its own size at q = 1. It has more corners than
/// vertices.
pub(crate) fn random_shape(random: &mut Random, vertices: usize, rank: usize) -> Shape {
    let rest_positions = (0..vertices).map(|_| random.next_triple()).collect();
    // The factor 7 scatters consecutive corners over the vertices.
    let corner_count = vertices + 3;
    let corners = Corners {
        vertices: (0..corner_count).map(|corner| (corner * 7 % vertices) as u32).collect(),
        normals: (0..corner_count).map(|_| random.next_triple()).collect(),
        uvs: (0..corner_count).map(|_| [random.next_number(), random.next_number()]).collect(),
    };
    let triangles = (0..corner_count as u32 - 2).map(|first| [first, first + 1, first + 2]).collect();
    let mesh = Mesh::new(rest_positions, corners, triangles).expect("expected a valid mesh");
    let amplitude = 1.0 / (rank.max(1) as f32).sqrt();
    let entries = (0..3 * vertices * rank).map(|_| amplitude * random.next_number()).collect();
    Shape::new(mesh, Modes::from_columns(3 * vertices, rank, entries).expect("expected valid modes"))
        .expect("expected a valid shape")
}

pub(crate) fn new_domain(shape: usize, material: usize) -> Domain {
    Domain { material, ..Domain::new(format!("shape {shape}"), shape) }
}

/// Index of the material without a normal map in [`parts_of_shapes`].
pub(crate) const PLAIN_MATERIAL: usize = 0;
/// Index of the material with a normal map in [`parts_of_shapes`].
pub(crate) const NORMAL_MAPPED_MATERIAL: usize = 1;

/// Scene parts with these shapes, two materials and no domains.
pub(crate) fn parts_of_shapes(shapes: Vec<Shape>) -> SceneParts {
    let mut parts = SceneParts::named("random");
    parts.shapes = shapes;
    let normal_mapped = Material { normal_texture: Some(0), ..Material::default() };
    parts.materials = vec![Material::default(), normal_mapped];
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("expected a valid texture")];
    parts
}

/// Options of [`random_scene`].
#[derive(Clone, Copy)]
pub(crate) struct RandomSceneOptions {
    /// Number of domains per shape.
    pub(crate) instances: usize,
    /// Whether every other shape has a normal map.
    pub(crate) normal_maps: bool,
    /// Whether the scene permits no shear. Uniform scale and reflection are permitted.
    pub(crate) rigid_transforms: bool,
}

/// A scene of random shapes, each given by its number of vertices and its rank.
pub(crate) fn random_scene(shapes: &[(usize, usize)], options: RandomSceneOptions) -> Arc<Scene> {
    let RandomSceneOptions { instances, normal_maps, rigid_transforms } = options;
    let mut random = Random(shapes.len() as u64);
    let mut parts =
        parts_of_shapes(shapes.iter().map(|(vertices, rank)| random_shape(&mut random, *vertices, *rank)).collect());
    parts.rigid_transforms = rigid_transforms;
    for _ in 0..instances {
        for index in 0..shapes.len() {
            let has_normal_map = normal_maps && index % 2 == 0;
            parts.domains.push(new_domain(index, if has_normal_map { NORMAL_MAPPED_MATERIAL } else { PLAIN_MATERIAL }));
        }
    }
    Scene::new(parts).expect("expected a valid scene")
}

/// A random state. The transforms are, in turn, a similarity, a shear (if the scene allows shear) and a mirrored
/// similarity.
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
