//! Normals and tangents that follow the deformed triangles. Twin of `kernels/normals.cu`.
//!
//! # Definition
//! Around each smoothing group (see [`modalcast_model::domain::SmoothingGroups`]) the area vectors (b - a) x (c - a) of its
//! triangles are summed twice: at rest, transformed by the cofactors of A as area vectors are, and over the positions x
//! of this step. The exact normal is the rigid normal of `reference/rigid_normals.rs`, rotated by the smallest rotation that
//! takes the first direction to the second. It follows that
//! - at q = 0 it is the rigid normal, whatever the author intended (smoothed, weighted, deliberately bent);
//! - where rest normals are those of the triangles, it is the area-weighted normal of the deformed triangles, and where
//!   they oppose the winding, its opposite: a rotation that takes g to h takes -g to -h;
//! - a mirroring T needs no rule of its own: it transforms both sums alike, and the rigid normal has its sign;
//! - corners of one group with the same rest normal keep a common normal: seams stay closed and hard edges stay hard.
//!
//! A tangent is rotated by the same rotation, then made orthogonal to the new normal. The bitangent keeps its sign, or
//! is flipped by a mirroring T as in the rigid case. That takes no memory and no reads beyond those of rigid tangents
//! and exact normals. The tangent follows the tilt of the surface, but not its rotation or shear by modes within the
//! surface. That would need texture gradients per triangle, and so 8 more bytes per entry of every ring.
//!
//! # Fallback
//! A corner keeps its rigid normal and tangent where no rotation can be determined: its shape has no modes; its group
//! has no area at rest, or areas that cancel; or its area in this step is not above [`RESOLUTION`] times B. Here B =
//! sum of l (l + w) over both edges of each triangle, with l the sum of an edge's absolute components and w that of the
//! group's own position. Rounding positions to f32 moves an edge by at most 2^-23 (l + w), and so the sum of area
//! vectors by at most 2^-23 B. For positions that were rounded once, the direction of the sum is therefore off by at
//! most asin(2^-23 B / |sum|) < 1.8 degrees, and no rotation that rounding alone could cause is applied. A domain of
//! one meter at 10^7 meters thus shows rigid normals; put the scene's origin near it.
//!
//! Close to half a turn the axis of the smallest rotation is ill-conditioned. Rest normals that differ from the
//! geometric ones by an angle d may be off by 2 d there, and in the limit the component perpendicular to the normal is
//! not rotated.

use nalgebra::Vector3;

use super::rigid_normals::{cofactors, rigid_normals, rigid_tangents};
use modalcast_model::domain::Mesh;
use modalcast_model::scene::{Scene, SceneState};

/// 2^-18: the part of B that an area must exceed.
const RESOLUTION: f64 = 1.0 / 262_144.0;

/// Squared length of the sum of two unit vectors below which they are opposite: half a turn, within 1e-5 rad.
const OPPOSITE: f64 = 1e-10;

/// World unit normals, one per corner, of a surface at `positions` (the result of `deform` for the same state).
pub fn exact_normals(scene: &Scene, state: &SceneState, positions: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let mut normals = rigid_normals(scene, state);
    for_each_rotated_corner(scene, state, positions, |corner, turn| {
        normals[corner] = rotated_normal(turn, normals[corner]).into()
    });
    normals
}

/// World unit tangents and bitangent signs, one per corner; empty when the scene has no normal map. A shape without
/// tangents gives zeros.
pub fn exact_tangents(scene: &Scene, state: &SceneState, positions: &[[f64; 3]]) -> Vec<[f64; 4]> {
    let mut tangents = rigid_tangents(scene, state);
    if tangents.is_empty() {
        return tangents;
    }
    let rigid = rigid_normals(scene, state);
    for_each_rotated_corner(scene, state, positions, |corner, turn| {
        let [x, y, z, sign] = tangents[corner];
        if sign != 0.0 {
            let flat = orthogonalize(turn.rotate(Vector3::new(x, y, z)), rotated_normal(turn, rigid[corner]));
            tangents[corner] = [flat.x, flat.y, flat.z, sign];
        }
    });
    tangents
}

/// The rotation of a group's surface, as its unit directions before and after.
struct ShortestArc {
    from: Vector3<f64>,
    to: Vector3<f64>,
}

impl ShortestArc {
    /// Applies the smallest rotation that takes `from` to `to`: the component along `from` is moved to `to`, the rest
    /// is reflected at the plane perpendicular to their bisector.
    fn rotate(&self, vector: Vector3<f64>) -> Vector3<f64> {
        let along = self.from.dot(&vector);
        let across = vector - self.from * along;
        let middle = self.from + self.to;
        if middle.norm_squared() < OPPOSITE {
            return self.to * along + across;
        }
        self.to * along + across - middle * (2.0 * middle.dot(&across) / middle.norm_squared())
    }
}

fn rotated_normal(turn: &ShortestArc, rigid: [f64; 3]) -> Vector3<f64> {
    direction(turn.rotate(rigid.into())).unwrap_or(turn.to)
}

/// A tangent without its component along the normal; if nothing remains, any unit vector perpendicular to the normal.
fn orthogonalize(tangent: Vector3<f64>, normal: Vector3<f64>) -> Vector3<f64> {
    let flat = tangent - normal * normal.dot(&tangent);
    let axis = if normal.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    if flat.norm() > 1e-6 { flat.normalize() } else { normal.cross(&axis).normalize() }
}

/// Calls `act` with each packed corner for which the rotation of the surface can be determined.
fn for_each_rotated_corner(
    scene: &Scene,
    state: &SceneState,
    positions: &[[f64; 3]],
    mut act: impl FnMut(usize, &ShortestArc),
) {
    for (domain, slot) in scene.layout.domains.iter().enumerate() {
        let shape = scene.shape_of(domain);
        let Some(smoothing) = shape.smoothing() else { continue };
        let rest =
            areas(&shape.mesh, smoothing.corner_groups(), |vertex| shape.mesh.rest_positions()[vertex].map(f64::from));
        let now = areas(&shape.mesh, smoothing.corner_groups(), |vertex| positions[slot.first_vertex + vertex]);
        let area_transform = cofactors(&state.composed_transform(scene, domain).linear());
        for (corner, group) in smoothing.corner_groups().iter().enumerate() {
            let group = *group as usize;
            let has_normal = smoothing.normals()[group] != [0.0; 3];
            let resolved = now[group].sum.norm() > RESOLUTION * now[group].rounding;
            let ends = (direction(area_transform * rest[group].sum), direction(now[group].sum));
            if let (true, (Some(from), Some(to))) = (has_normal && resolved, ends) {
                act(slot.first_corner + corner, &ShortestArc { from, to });
            }
        }
    }
}

/// The sum of the area vectors around a group, and its rounding scale B.
#[derive(Clone, Default)]
struct Area {
    sum: Vector3<f64>,
    rounding: f64,
}

/// The areas of all groups.
fn areas(mesh: &Mesh, members: &[u32], position: impl Fn(usize) -> [f64; 3]) -> Vec<Area> {
    let mut areas = vec![Area::default(); members.len()];
    let l1 = |vector: Vector3<f64>| vector.abs().sum();
    for triangle in mesh.triangles() {
        let [a, b, c] = triangle.map(|corner| mesh.corners().vertices[corner as usize]);
        if a == b || b == c || c == a {
            continue;
        }
        let place = |at: usize| Vector3::from(position(mesh.corners().vertices[triangle[at % 3] as usize] as usize));
        for at in 0..3 {
            let (own, edge, other) = (place(at), place(at + 1) - place(at), place(at + 2) - place(at));
            let area = &mut areas[members[triangle[at] as usize] as usize];
            area.sum += edge.cross(&other);
            area.rounding += [edge, other].map(|edge| l1(edge) * (l1(edge) + l1(own))).iter().sum::<f64>();
        }
    }
    areas
}

/// A vector divided by its length, without overflow or underflow; `None` if it is zero or not finite.
fn direction(vector: Vector3<f64>) -> Option<Vector3<f64>> {
    let largest = vector.amax();
    (largest > 0.0 && largest.is_finite()).then(|| (vector / largest).normalize())
}
