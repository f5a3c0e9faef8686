//! Normals and tangents that follow the deformed triangles. Twin of `kernels/normals.cu`.
//!
//! # Definition
//! For each smoothing group (see [`modalcast_model::domain::SmoothingGroups`]), the area vectors (b - a) x (c - a) of
//! its triangles are summed twice. The rest sum uses the rest positions. It is transformed by the cofactors of A (the
//! linear part of T), as area vectors are. The current sum uses the positions x of this step. The exact normal is the
//! rigid normal of `reference/rigid_normals.rs`, rotated by the smallest rotation that takes the direction of the rest
//! sum to that of the current sum. It follows that
//! - at q = 0 the exact normal is the rigid normal, even if the author smoothed, weighted or tilted rest normals;
//! - where rest normals are those of the triangles, the exact normal is the area-weighted normal of the deformed
//!   triangles;
//! - where rest normals oppose the winding, the exact normal is the opposite of that area-weighted normal, because a
//!   rotation that takes a vector g to h takes -g to -h;
//! - a mirroring T needs no special case: T transforms both sums alike, and the rigid normal has the sign of its
//!   determinant;
//! - corners of one group with the same rest normal keep a common normal: seams stay closed and hard edges stay hard.
//!
//! A tangent is rotated by the same rotation, then made orthogonal to the new normal. The bitangent keeps its sign, or
//! is flipped by a mirroring T as in the rigid case. Tangents need no memory and no reads beyond those of rigid
//! tangents and exact normals. The tangent follows the tilt of the surface. It does not follow rotation or shear within
//! the surface, which would need texture gradients per triangle. A kernel would have to read 8 more bytes for each
//! vertex around a group.
//!
//! # Fallback
//! A corner keeps its rigid normal and tangent where no rotation can be determined:
//! - its shape has no modes;
//! - its group has no area at rest, or areas that cancel;
//! - the area of its group in this step is not above [`RESOLUTION`] times B.
//!
//! B, the rounding scale, is the sum of l (l + w) over the two edges of each triangle that meet at the group's vertex.
//! l is the sum of the absolute components of an edge, and w is this sum for the position of the vertex. Rounding
//! positions to f32 moves an edge by at most 2^-23 (l + w), and so the sum of area vectors by at most 2^-23 B. For
//! positions that were rounded once, the direction of the sum is therefore off by at most asin(2^-23 B / |sum|). This
//! is less than asin(2^-5) < 1.8 degrees if |sum| is above `RESOLUTION` B = 2^-18 B. A rotation that rounding alone
//! could cause is not applied. A domain of one meter at 10^7 meters thus has rigid normals, unless the scene's origin
//! is near it.
//!
//! # Flattened surfaces
//! A singular A flattens a surface to a plane, and the parts of it that are perpendicular to this plane to lines. Their
//! rest sum is then lost, because the cofactors of A map it to zero or to rounding noise: at most [`FLATTENED`] times
//! the norm of the cofactors. If the current sum of such a group is resolved, U q has tilted it, and no rotation from
//! rest is needed to know its normal: it is the direction of the current sum, on the side of the surface on which the
//! rest normal is.
//!
//! Close to half a turn the axis of the smallest rotation is ill-conditioned. Rest normals that differ from the
//! geometric ones by an angle d may be off by 2 d there. At half a turn, the component perpendicular to the normal is
//! not rotated.

use nalgebra::{Matrix3, Vector3};

use super::rigid_normals::{cofactors, rigid_normals, rigid_tangents};
use modalcast_model::domain::Mesh;
use modalcast_model::scene::{Scene, SceneState};

/// 2^-18: the fraction of B that an area must exceed.
const RESOLUTION: f64 = 1.0 / 262_144.0;

/// 2^-20: a unit normal is lost if the cofactors of A map it to a vector of at most this fraction of their norm. The
/// rounding of rest normals to f32 alone gives up to 2^-24.
const FLATTENED: f64 = 1.0 / 1_048_576.0;

/// Two unit vectors are opposite if the squared length of their sum is below this: half a turn, within 1e-5 rad.
const MIN_BISECTOR_SQUARED_LENGTH: f64 = 1e-10;

/// World unit normals, one per corner, of a surface at `positions` (the result of `deform` for the same state).
pub fn exact_normals(scene: &Scene, state: &SceneState, positions: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let rigid_normals = rigid_normals(scene, state);
    let mut normals = rigid_normals.clone();
    for_each_rotated_corner(scene, state, positions, &rigid_normals, |corner, rotation| {
        normals[corner] = rotate_normal(rotation, normals[corner]).into()
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
    let rigid_normals = rigid_normals(scene, state);
    for_each_rotated_corner(scene, state, positions, &rigid_normals, |corner, rotation| {
        let [x, y, z, sign] = tangents[corner];
        if sign != 0.0 {
            let tangent =
                orthogonalize(rotation.rotate(Vector3::new(x, y, z)), rotate_normal(rotation, rigid_normals[corner]));
            tangents[corner] = [tangent.x, tangent.y, tangent.z, sign];
        }
    });
    tangents
}

/// The smallest rotation of a group's surface: from the unit direction of its rest sum to that of its current sum.
struct ShortestArc {
    rest_direction: Vector3<f64>,
    current_direction: Vector3<f64>,
}

impl ShortestArc {
    /// Applies the smallest rotation that takes `rest_direction` to `current_direction`. The component parallel to
    /// `rest_direction` becomes parallel to `current_direction`. The perpendicular component is reflected at the plane
    /// perpendicular to the bisector.
    fn rotate(&self, vector: Vector3<f64>) -> Vector3<f64> {
        let parallel_component = self.rest_direction.dot(&vector);
        let perpendicular = vector - self.rest_direction * parallel_component;
        let bisector = self.rest_direction + self.current_direction;
        if bisector.norm_squared() < MIN_BISECTOR_SQUARED_LENGTH {
            return self.current_direction * parallel_component + perpendicular;
        }
        self.current_direction * parallel_component + perpendicular
            - bisector * (2.0 * bisector.dot(&perpendicular) / bisector.norm_squared())
    }
}

fn rotate_normal(rotation: &ShortestArc, rigid_normal: [f64; 3]) -> Vector3<f64> {
    normalize_scaled(rotation.rotate(rigid_normal.into())).unwrap_or(rotation.current_direction)
}

/// A tangent without its component along the normal; if nothing remains, any unit vector perpendicular to the normal.
fn orthogonalize(tangent: Vector3<f64>, normal: Vector3<f64>) -> Vector3<f64> {
    let projected = tangent - normal * normal.dot(&tangent);
    // An axis that is not nearly parallel to the normal.
    let axis = if normal.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    if projected.norm() > 1e-6 { projected.normalize() } else { normal.cross(&axis).normalize() }
}

/// Calls `process` with the packed index of each corner whose rotation can be determined, and with the rotation.
fn for_each_rotated_corner(
    scene: &Scene,
    state: &SceneState,
    positions: &[[f64; 3]],
    rigid_normals: &[[f64; 3]],
    mut process: impl FnMut(usize, &ShortestArc),
) {
    for (domain, layout) in scene.layout.domains.iter().enumerate() {
        let shape = scene.shape_of(domain);
        let Some(smoothing) = shape.smoothing() else { continue };
        let rest_areas = sum_areas(&shape.mesh, smoothing.corner_groups(), |vertex| {
            shape.mesh.rest_positions()[vertex].map(f64::from)
        });
        let current_areas =
            sum_areas(&shape.mesh, smoothing.corner_groups(), |vertex| positions[layout.first_vertex + vertex]);
        let linear = state.composed_transform(scene, domain).linear();
        let (area_transform, determinant_sign) = (cofactors(&linear), linear.determinant().signum());
        for (corner, group) in smoothing.corner_groups().iter().enumerate() {
            let group = *group as usize;
            // The geometric normal of a group without area at rest is zero.
            let has_normal = smoothing.normals()[group] != [0.0; 3];
            let is_resolved = current_areas[group].sum.norm() > RESOLUTION * current_areas[group].rounding_scale;
            if !has_normal || !is_resolved {
                continue;
            }
            let Some(mut current_direction) = normalize_scaled(current_areas[group].sum) else { continue };
            let group_normal = Vector3::from(smoothing.normals()[group]).cast::<f64>();
            let rest_direction = if is_flattened(&area_transform, group_normal) {
                // The corner's own normal turns to the surface.
                current_direction *= determinant_sign;
                let rest_normal = Vector3::from(shape.mesh.corners().normals[corner]).cast::<f64>();
                let side = if rest_normal.dot(&group_normal) < 0.0 { -1.0 } else { 1.0 };
                Some(Vector3::from(rigid_normals[layout.first_corner + corner]) * side)
            } else {
                normalize_scaled(area_transform * rest_areas[group].sum)
            };
            let Some(rest_direction) = rest_direction else { continue };
            process(layout.first_corner + corner, &ShortestArc { rest_direction, current_direction });
        }
    }
}

/// Whether the cofactors of A lose this unit normal ([`FLATTENED`]).
fn is_flattened(cofactors: &Matrix3<f64>, normal: Vector3<f64>) -> bool {
    (cofactors * normal).norm() <= FLATTENED * cofactors.norm()
}

/// The sum of the area vectors around a group, and its rounding scale B.
#[derive(Clone, Default)]
struct Area {
    sum: Vector3<f64>,
    rounding_scale: f64,
}

/// The area of each group. The result has one element per corner, which is at least the number of groups.
fn sum_areas(mesh: &Mesh, corner_groups: &[u32], position: impl Fn(usize) -> [f64; 3]) -> Vec<Area> {
    let mut group_areas = vec![Area::default(); corner_groups.len()];
    let l1 = |vector: Vector3<f64>| vector.abs().sum();
    for triangle in mesh.triangles() {
        let [a, b, c] = triangle.map(|corner| mesh.corners().vertices[corner as usize]);
        if a == b || b == c || c == a {
            continue;
        }
        let position_of =
            |corner: usize| Vector3::from(position(mesh.corners().vertices[triangle[corner % 3] as usize] as usize));
        for corner in 0..3 {
            let (center, first_edge, second_edge) = (
                position_of(corner),
                position_of(corner + 1) - position_of(corner),
                position_of(corner + 2) - position_of(corner),
            );
            let area = &mut group_areas[corner_groups[triangle[corner] as usize] as usize];
            area.sum += first_edge.cross(&second_edge);
            area.rounding_scale +=
                [first_edge, second_edge].map(|edge| l1(edge) * (l1(edge) + l1(center))).iter().sum::<f64>();
        }
    }
    group_areas
}

/// A vector divided by its length, without overflow or underflow; `None` if it is zero or not finite.
fn normalize_scaled(vector: Vector3<f64>) -> Option<Vector3<f64>> {
    let max_component = vector.amax();
    (max_component > 0.0 && max_component.is_finite()).then(|| (vector / max_component).normalize())
}
