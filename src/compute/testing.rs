//! Support for tests of this crate and of crates that add kernels: seeded random scenes, exact results, and the
//! resource usage of compiled kernels. Compiled for tests and with the feature `testing` only.

#![allow(clippy::expect_used, clippy::panic, missing_docs, reason = "a test may fail")]

pub mod views;

use std::sync::Arc;

pub use crate::gpu::{CAPABILITIES, CompiledVariant, assert_compiles};

use modalcast_model::domain::{Corners, Domain, Material, Mesh, Modes, Shape};
use modalcast_model::scene::{DeformationSettings, Scene, SceneParts, SceneState};

/// Deterministic random numbers from -1 to 1: the linear congruential generator of Knuth's MMIX. The field is the state
/// of the generator, at first the seed.
#[derive(Debug)]
pub struct TestRng(pub u64);

impl TestRng {
    /// The next number.
    #[expect(clippy::should_implement_trait, reason = "an iterator would wrap every number in an option")]
    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    }
}

/// A shape with random vertices and modes; all numbers are from -1 to 1.
pub fn shape(vertices: usize, rank: usize, rng: &mut TestRng) -> Shape {
    let columns = (0..3 * vertices * rank).map(|_| rng.next()).collect();
    shape_with_columns(vertices, rank, columns, rng)
}

/// A shape with random vertices and these columns of U, `3 * vertices` entries per mode. Its only triangle is
/// degenerate.
pub fn shape_with_columns(vertices: usize, rank: usize, columns: Vec<f32>, rng: &mut TestRng) -> Shape {
    let rest_positions: Vec<[f32; 3]> = (0..vertices).map(|_| [rng.next(), rng.next(), rng.next()]).collect();
    let normals = vec![[0.0, 0.0, 1.0]; vertices];
    let mesh = Mesh::from_indexed(rest_positions, normals, vec![], vec![[0; 3]]).expect("a valid mesh");
    let modes =
        if rank == 0 { Modes::rigid() } else { Modes::from_columns(3 * vertices, rank, columns).expect("valid modes") };
    Shape::new(mesh, modes).expect("a valid shape")
}

/// A scene with one random shape and one domain for each (vertices, rank) of `sizes`. rank is the number of modes.
pub fn scene(sizes: &[(usize, usize)], deformation: DeformationSettings, rng: &mut TestRng) -> Arc<Scene> {
    let mut parts = SceneParts::named("noise");
    parts.deformation = deformation;
    parts.materials = vec![Material::default()];
    for (index, (vertices, rank)) in sizes.iter().enumerate() {
        parts.shapes.push(shape(*vertices, *rank, rng));
        parts.domains.push(Domain::new(format!("noise {index}"), index));
    }
    Scene::new(parts).expect("a valid scene")
}

/// A scene with one domain for each (vertices, rank, triangles) of `shapes`, with random corner normals, and a random
/// state.
pub fn scene_and_state(shapes: &[(usize, usize, usize)]) -> (Arc<Scene>, SceneState) {
    let mut rng = TestRng(shapes.len() as u64);
    let mut parts = SceneParts::named("noise");
    parts.materials = vec![Material::default()];
    for (shape, (vertices, rank, triangles)) in shapes.iter().enumerate() {
        parts.shapes.push(shape_with_corners(&mut rng, *vertices, *rank, *triangles));
        parts.domains.push(Domain::new(format!("noise {shape}"), shape));
    }
    let scene = Scene::new(parts).expect("a valid scene");
    let mut state = SceneState::rest(&scene);
    state.q.iter_mut().for_each(|coordinate| *coordinate = rng.next());
    state.transforms.iter_mut().for_each(|transform| transform.0 = [0; 12].map(|_| rng.next()));
    (scene, state)
}

/// A shape with one corner per vertex and random normals. The triangles use the corners in order, and start again with
/// corner 0 after the last one.
fn shape_with_corners(rng: &mut TestRng, vertices: usize, rank: usize, triangles: usize) -> Shape {
    let rest_positions = (0..vertices).map(|_| [0; 3].map(|_| rng.next())).collect();
    let corners = Corners {
        vertices: (0..vertices as u32).collect(),
        normals: (0..vertices).map(|_| [0; 3].map(|_| rng.next())).collect(),
        uvs: Vec::new(),
    };
    let wrapped_corner = |index: usize| (index % vertices) as u32;
    let triangles = (0..triangles).map(|first| [3 * first, 3 * first + 1, 3 * first + 2].map(wrapped_corner)).collect();
    let columns = (0..3 * vertices * rank).map(|_| rng.next()).collect();
    let modes = Modes::from_columns(3 * vertices, rank, columns).expect("valid modes");
    Shape::new(Mesh::new(rest_positions, corners, triangles).expect("a valid mesh"), modes).expect("a valid shape")
}

/// u = U q of a vertex, in f64.
pub fn displacement_of(scene: &Scene, state: &SceneState, domain: usize, vertex: usize) -> [f64; 3] {
    let modes = &scene.shape_of(domain).modes;
    let q = state.q_of(scene, domain);
    [0, 1, 2].map(|axis| {
        q.iter().enumerate().map(|(mode, q)| f64::from(modes.entry(vertex, axis, mode)) * f64::from(*q)).sum()
    })
}

/// x = T (x0 + u) of a vertex, in f64. No domain of the scene may follow another one.
pub fn position_of(scene: &Scene, state: &SceneState, domain: usize, vertex: usize) -> [f64; 3] {
    let u = displacement_of(scene, state, domain, vertex);
    let rest = scene.shape_of(domain).mesh.rest_positions()[vertex];
    let (linear, offset) = (state.transforms[domain].linear(), state.transforms[domain].translation());
    let deformed = nalgebra::Vector3::from([0, 1, 2].map(|axis| f64::from(rest[axis]) + u[axis]));
    (linear * deformed + offset).into()
}

/// One component of T (x, y, z, 1) with fused multiply-adds, in the order of the batch kernels. `row` is that row of T.
pub fn transformed_axis(row: &[f32], [x, y, z]: [f32; 3]) -> f32 {
    row[0].mul_add(x, row[1].mul_add(y, row[2].mul_add(z, row[3])))
}
