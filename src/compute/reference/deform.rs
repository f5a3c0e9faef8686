//! x = T (x0 + U q), equation 3.9 of B. Wang's thesis (README.md), for every vertex of every domain. Twin of
//! `kernels/deform.cu`.

use modalcast_model::domain::Shape;
use modalcast_model::scene::{Scene, SceneState};

/// Positions in world axes, three f64 per vertex, in the packed order of the scene's layout: one domain after the
/// other. The positions of a domain are relative to its floating origin ([`SceneState::origin_of`]). That origin is
/// near the domain, so that f32 deformers can be compared far from the world's origin.
pub fn deform(scene: &Scene, state: &SceneState) -> Vec<[f64; 3]> {
    let mut positions = Vec::with_capacity(scene.layout.vertices);
    for domain in 0..scene.domains.len() {
        let shape = scene.shape_of(domain);
        let q = state.q_of(scene, domain);
        let world_from_domain = state.composed_transform(scene, domain).to_f64();
        for (vertex, rest) in shape.mesh.rest_positions().iter().enumerate() {
            let mut deformed = rest.map(f64::from);
            add_modes(shape, q, vertex, &mut deformed);
            positions.push(std::array::from_fn(|row| {
                let [x, y, z, offset] = std::array::from_fn(|column| world_from_domain[4 * row + column]);
                x * deformed[0] + y * deformed[1] + z * deformed[2] + offset
            }));
        }
    }
    positions
}

/// u = U q of every vertex in the frame of its domain, before T is applied: three f64 per vertex, in the packed order
/// of the scene's layout.
pub fn displacements(scene: &Scene, state: &SceneState) -> Vec<[f64; 3]> {
    let mut displacements = Vec::with_capacity(scene.layout.vertices);
    for domain in 0..scene.domains.len() {
        let (shape, q) = (scene.shape_of(domain), state.q_of(scene, domain));
        for vertex in 0..shape.mesh.rest_positions().len() {
            let mut displacement = [0.0; 3];
            add_modes(shape, q, vertex, &mut displacement);
            displacements.push(displacement);
        }
    }
    displacements
}

/// Adds the three rows of U q of a vertex to `sum`.
fn add_modes(shape: &Shape, q: &[f32], vertex: usize, sum: &mut [f64; 3]) {
    for (axis, sum) in sum.iter_mut().enumerate() {
        for (mode, coordinate) in q.iter().enumerate() {
            *sum += f64::from(shape.modes.entry(vertex, axis, mode)) * f64::from(*coordinate);
        }
    }
}
