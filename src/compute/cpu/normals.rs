//! Normals and tangents that follow the deformed triangles. Twin: `reference/normals.rs`, which defines them.
//!
//! Each corner belongs to a smoothing group. The ring of a group lists its vertex, then the vertices around it in fans:
//! two consecutive vertices of a fan form a triangle with the group's vertex. The first vertex of a fan has the flag
//! [`RING_START`] ([`SmoothingGroups`]). Each corner sums the area vectors around its group in the order of the ring,
//! so threads share no sums. Positions and results are f32. Sums are f64, in which differences and products of two f32
//! neither overflow nor underflow. This costs little, because reading the ring takes longer than the arithmetic.

use nalgebra::{Matrix3, Vector3};

use super::rigid_normals::{self, cofactors};
use super::tile::{self, DomainTile, PackedOutput};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{RING_START, SmoothingGroups};
use modalcast_model::scene::{Scene, SceneState};

/// 2^-18, as in the twin: the area of a group must exceed this fraction of its rounding scale (the B of the twin).
const RESOLUTION: f64 = 1.0 / 262_144.0;

/// 2^-20, as in the twin: a unit normal is lost if the cofactors of A map it to at most this fraction of their norm.
const FLATTENED: f64 = 1.0 / 1_048_576.0;

/// As in the twin: squared length below which the sum of two unit vectors counts as zero.
const MIN_BISECTOR_SQUARED_LENGTH: f64 = 1e-10;

/// Writes the normals of these tiles, three f32 per corner, and the tangents, four f32 per corner, if the scene has
/// normal maps. Reads the surface's positions.
pub(super) fn compute_normals(scene: &Scene, state: &SceneState, tiles: &[DomainTile], output: &mut DeformedSurface) {
    let DeformedSurface { positions, normals, tangents, .. } = output;
    let positions = positions.as_slice();
    // In a scene without tangents, the output has a width of 0 numbers per corner.
    let tangents = PackedOutput::new(if scene.features.normal_maps { 4 } else { 0 }, tangents);
    tile::run_parallel(tiles, (PackedOutput::new(3, normals), tangents), &|tiles, (mut normals, mut tangents)| {
        for tile in tiles {
            let (normals, tangents) = (normals.numbers_of(tile), tangents.numbers_of(tile));
            rigid_normals::write_rigid_normals(scene, state, tile, normals);
            if !tangents.is_empty() {
                rigid_normals::write_rigid_tangents(scene, state, tile, tangents);
            }
            rotate_to_surface(
                &DeformedDomain::new(scene, state, tile.domain(), positions),
                tile.first_item(),
                normals,
                tangents,
            );
        }
    });
}

/// Rotates the rigid normals and tangents of a domain's corners, from `first_corner` on, with the surface.
fn rotate_to_surface(surface: &DeformedDomain, first_corner: usize, normals: &mut [f32], tangents: &mut [f32]) {
    let Some(smoothing) = surface.smoothing else { return };
    let mut tangents = tangents.chunks_exact_mut(4);
    for (corner, normal) in (first_corner..).zip(normals.chunks_exact_mut(3)) {
        let tangent = tangents.next();
        let rigid_normal = to_vector(normal);
        let Some(surface_rotation) = surface.surface_rotation(smoothing, corner, rigid_normal) else { continue };
        let rotated_normal =
            surface_rotation.rotate(rigid_normal).try_normalize(0.0).unwrap_or(surface_rotation.deformed_direction);
        normal.copy_from_slice(rotated_normal.cast::<f32>().as_slice());
        if let Some(tangent) = tangent.filter(|tangent| tangent[3] != 0.0) {
            let rotated_tangent = orthogonalize(surface_rotation.rotate(to_vector(tangent)), rotated_normal);
            tangent[..3].copy_from_slice(rotated_tangent.cast::<f32>().as_slice());
        }
    }
}

/// The deformed surface of a domain.
struct DeformedDomain<'a> {
    /// `None` for a shape without modes, whose normals are rigid.
    smoothing: Option<&'a SmoothingGroups>,
    /// Per corner.
    rest_normals: &'a [[f32; 3]],
    /// Three f32 per vertex of the domain.
    positions: &'a [f32],
    /// Transforms area vectors from rest to world: the cofactors of A, the linear part of T.
    area_transform: Matrix3<f64>,
    /// Sign of the determinant of A.
    determinant_sign: f64,
}

impl<'a> DeformedDomain<'a> {
    fn new(scene: &'a Scene, state: &SceneState, domain: usize, positions: &'a [f32]) -> Self {
        let layout = scene.layout.domains[domain];
        let shape = scene.shape_of(domain);
        let linear = state.composed_transform(scene, domain).linear();
        Self {
            smoothing: shape.smoothing(),
            rest_normals: &shape.mesh.corners().normals,
            positions: &positions[3 * layout.first_vertex..][..3 * layout.vertices],
            area_transform: cofactors(&linear),
            determinant_sign: linear.determinant().signum(),
        }
    }

    /// The rotation of the surface around a corner, whose rigid normal is given; `None` where it cannot be determined.
    fn surface_rotation(
        &self,
        smoothing: &SmoothingGroups,
        corner: usize,
        rigid_normal: Vector3<f64>,
    ) -> Option<ShortestArc> {
        let group = smoothing.corner_groups()[corner] as usize;
        let group_normal = to_vector(&smoothing.normals()[group]);
        let (area_sum, rounding_scale) = self.sum_areas(smoothing.ring(group));
        let is_resolved = area_sum.norm() > RESOLUTION * rounding_scale;
        if !is_resolved || group_normal == Vector3::zeros() {
            return None;
        }
        let rest_area = self.area_transform * group_normal;
        if rest_area.norm() <= FLATTENED * self.area_transform.norm() {
            // The rest direction is lost. The corner's own normal turns to the surface, on its side.
            let is_opposite = to_vector(&self.rest_normals[corner]).dot(&group_normal) < 0.0;
            return Some(ShortestArc {
                rigid_direction: if is_opposite { -rigid_normal } else { rigid_normal },
                deformed_direction: area_sum.normalize() * self.determinant_sign,
            });
        }
        // Scale first, because the squares of tiny cofactors may underflow.
        Some(ShortestArc {
            rigid_direction: (rest_area / rest_area.amax()).normalize(),
            deformed_direction: area_sum.normalize(),
        })
    }

    /// The sum of the area vectors around a ring, and its rounding scale: the number B of the twin's documentation.
    fn sum_areas(&self, ring: &[u32]) -> (Vector3<f64>, f64) {
        let position = |entry: u32| to_vector(&self.positions[3 * (entry & !RING_START) as usize..]);
        let center = position(ring[0]);
        let center_l1 = center.abs().sum();
        let (mut sum, mut rounding_scale) = (Vector3::zeros(), 0.0);
        let (mut previous_edge, mut previous_rounding) = (Vector3::zeros(), 0.0);
        for entry in &ring[1..] {
            let edge = position(*entry) - center;
            let edge_l1 = edge.abs().sum();
            let edge_rounding = edge_l1 * (edge_l1 + center_l1);
            if entry & RING_START == 0 {
                sum += previous_edge.cross(&edge);
                rounding_scale += previous_rounding + edge_rounding;
            }
            (previous_edge, previous_rounding) = (edge, edge_rounding);
        }
        (sum, rounding_scale)
    }
}

/// The smallest rotation of a surface: from its rigid to its deformed unit direction.
struct ShortestArc {
    rigid_direction: Vector3<f64>,
    deformed_direction: Vector3<f64>,
}

impl ShortestArc {
    /// Applies the smallest rotation that takes `rigid_direction` to `deformed_direction`.
    fn rotate(&self, vector: Vector3<f64>) -> Vector3<f64> {
        let parallel_component = self.rigid_direction.dot(&vector);
        let perpendicular = vector - self.rigid_direction * parallel_component;
        let bisector = self.rigid_direction + self.deformed_direction;
        let bisector_squared = bisector.norm_squared();
        let reflected = if bisector_squared < MIN_BISECTOR_SQUARED_LENGTH {
            perpendicular
        } else {
            perpendicular - bisector * (2.0 * bisector.dot(&perpendicular) / bisector_squared)
        };
        self.deformed_direction * parallel_component + reflected
    }
}

/// A tangent without its component along the normal; if nothing remains, any unit vector perpendicular to the normal.
fn orthogonalize(tangent: Vector3<f64>, normal: Vector3<f64>) -> Vector3<f64> {
    let projected = tangent - normal * normal.dot(&tangent);
    // An axis that is not nearly parallel to the normal.
    let axis = if normal.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    projected.try_normalize(1e-6).unwrap_or_else(|| normal.cross(&axis).normalize())
}

fn to_vector(numbers: &[f32]) -> Vector3<f64> {
    Vector3::new(numbers[0], numbers[1], numbers[2]).cast()
}
