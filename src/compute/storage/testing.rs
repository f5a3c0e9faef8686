//! Random shapes and scenes for tests.

use std::sync::Arc;

use modalcast_model::domain::{Domain, Material, Mesh, Metadata, Modes, Shape, Transform};
use modalcast_model::scene::{Deformation, Parts, Scene};

/// Deterministic pseudorandom numbers in -1 to 1.
pub(crate) struct Noise(pub(crate) u64);

impl Noise {
    pub(crate) fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    }
}

/// Vertices in the cube [-1, 1]^3 with random modes.
pub(crate) fn shape(vertices: usize, rank: usize, noise: &mut Noise) -> Shape {
    let columns = (0..3 * vertices * rank).map(|_| noise.next()).collect();
    with_columns(vertices, rank, columns, noise)
}

/// Vertices in the cube [-1, 1]^3 with these columns.
pub(crate) fn with_columns(vertices: usize, rank: usize, columns: Vec<f32>, noise: &mut Noise) -> Shape {
    let rest: Vec<[f32; 3]> = (0..vertices).map(|_| [noise.next(), noise.next(), noise.next()]).collect();
    let normals = vec![[0.0, 0.0, 1.0]; vertices];
    let mesh = Mesh::indexed(rest, normals, vec![], vec![[0; 3]]).expect("a mesh");
    let modes =
        if rank == 0 { Modes::rigid() } else { Modes::from_columns(3 * vertices, rank, columns).expect("modes") };
    Shape::new(mesh, modes).expect("a shape")
}

/// A scene of random shapes, one domain each per (n, r).
pub(crate) fn scene(sizes: &[(usize, usize)], deformation: Deformation, noise: &mut Noise) -> Arc<Scene> {
    let mut parts = Parts::named("noise");
    parts.deformation = deformation;
    parts.materials = vec![Material::default()];
    for (at, (vertices, rank)) in sizes.iter().enumerate() {
        parts.shapes.push(shape(*vertices, *rank, noise));
        parts.domains.push(Domain {
            name: format!("noise {at}"),
            shape: at,
            material: 0,
            runs: vec![],
            placement: Transform::IDENTITY,
            attachment: None,
            follows: None,
            rest_q: vec![],
            shares_q_with: None,
            metadata: Metadata::default(),
        });
    }
    Scene::new(parts).expect("a scene")
}
