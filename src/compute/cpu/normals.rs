//! Normals and tangents that follow the deformed triangles. Twin: `reference/normals.rs`, which defines them.
//!
//! Each corner gathers its group's ring: threads share nothing, and a sum has the order of its ring. Positions and
//! results are f32. Sums are f64: differences and products of two f32 neither over- nor underflow there, so no input
//! needs scaling, and the gather costs more than the arithmetic.

use nalgebra::{Matrix3, Vector3};

use super::rigid_normals::{self, cofactors};
use super::tile::{self, DomainTile, PackedOutput};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{RING_START, SmoothingGroups};
use modalcast_model::scene::{Scene, SceneState};

/// As in the twin: the part of B that an area must exceed.
const RESOLUTION: f64 = 1.0 / 262_144.0;

/// As in the twin: squared length of the sum of two opposite unit vectors.
const OPPOSITE: f64 = 1e-10;

/// Writes the normals of these tiles, three f32 per corner, and the tangents, four f32 per corner, if the scene has
/// normal maps. Reads the surface's positions.
pub(super) fn normals(scene: &Scene, state: &SceneState, tiles: &[DomainTile], surface: &mut DeformedSurface) {
    let DeformedSurface { positions, normals, tangents, .. } = surface;
    let positions = positions.as_slice();
    // In a scene without tangents, a tile has zero numbers of them.
    let tangents = PackedOutput::new(if scene.features.normal_maps { 4 } else { 0 }, tangents);
    tile::run_parallel(tiles, (PackedOutput::new(3, normals), tangents), &|tiles, (mut normals, mut tangents)| {
        for tile in tiles {
            let (normals, tangents) = (normals.of(tile), tangents.of(tile));
            rigid_normals::write_rigid_normals(scene, state, tile, normals);
            if !tangents.is_empty() {
                rigid_normals::write_rigid_tangents(scene, state, tile, tangents);
            }
            rotate_to_surface(
                &DeformedDomain::new(scene, state, tile.domain(), positions),
                tile.first(),
                normals,
                tangents,
            );
        }
    });
}

/// Rotates the rigid normals and tangents of a domain's corners, from `first` on, with the surface.
fn rotate_to_surface(bent: &DeformedDomain, first: usize, normals: &mut [f32], tangents: &mut [f32]) {
    let Some(smoothing) = bent.smoothing else { return };
    let mut tangents = tangents.chunks_exact_mut(4);
    for (group, normal) in smoothing.corner_groups()[first..].iter().zip(normals.chunks_exact_mut(3)) {
        let tangent = tangents.next();
        let Some(surface_rotation) = bent.surface_rotation(smoothing, *group as usize) else { continue };
        let carried = surface_rotation.rotate(vector(normal)).try_normalize(0.0).unwrap_or(surface_rotation.to);
        normal.copy_from_slice(carried.cast::<f32>().as_slice());
        if let Some(tangent) = tangent.filter(|tangent| tangent[3] != 0.0) {
            let flat = orthogonalize(surface_rotation.rotate(vector(tangent)), carried);
            tangent[..3].copy_from_slice(flat.cast::<f32>().as_slice());
        }
    }
}

/// The deformed surface of a domain.
struct DeformedDomain<'a> {
    smoothing: Option<&'a SmoothingGroups>,
    /// Three f32 per vertex of the domain.
    positions: &'a [f32],
    /// Transforms area vectors from rest to world.
    area_transform: Matrix3<f64>,
}

impl<'a> DeformedDomain<'a> {
    fn new(scene: &'a Scene, state: &SceneState, domain: usize, positions: &'a [f32]) -> Self {
        let slot = scene.layout.domains[domain];
        Self {
            smoothing: scene.shape_of(domain).smoothing(),
            positions: &positions[3 * slot.first_vertex..][..3 * slot.vertices],
            area_transform: cofactors(&state.composed_transform(scene, domain).linear()),
        }
    }

    /// The rotation of the surface around a group; `None` where it cannot be determined.
    fn surface_rotation(&self, smoothing: &SmoothingGroups, group: usize) -> Option<ShortestArc> {
        let (sum, rounding) = self.area(smoothing.ring(group));
        let resolved = sum.norm() > RESOLUTION * rounding;
        let from = self.area_transform * Vector3::from(smoothing.normals()[group]).cast();
        // Scaled first, because the square of cofactors of tiny entries may underflow.
        let largest = from.amax();
        (resolved && largest > 0.0).then(|| ShortestArc { from: (from / largest).normalize(), to: sum.normalize() })
    }

    /// The sum of the area vectors around a ring, and its rounding scale B as the twin defines it.
    fn area(&self, ring: &[u32]) -> (Vector3<f64>, f64) {
        let at = |entry: u32| vector(&self.positions[3 * (entry & !RING_START) as usize..]);
        let own = at(ring[0]);
        let height = own.abs().sum();
        let (mut sum, mut rounding) = (Vector3::zeros(), 0.0);
        let (mut before, mut reach_before) = (Vector3::zeros(), 0.0);
        for entry in &ring[1..] {
            let edge = at(*entry) - own;
            let length = edge.abs().sum();
            let reach = length * (length + height);
            if entry & RING_START == 0 {
                sum += before.cross(&edge);
                rounding += reach_before + reach;
            }
            (before, reach_before) = (edge, reach);
        }
        (sum, rounding)
    }
}

/// The rotation of a surface, as its unit directions before and after.
struct ShortestArc {
    from: Vector3<f64>,
    to: Vector3<f64>,
}

impl ShortestArc {
    /// Applies the smallest rotation that takes `from` to `to`.
    fn rotate(&self, rigid: Vector3<f64>) -> Vector3<f64> {
        let along = self.from.dot(&rigid);
        let across = rigid - self.from * along;
        let middle = self.from + self.to;
        let square = middle.norm_squared();
        let reflected = if square < OPPOSITE { across } else { across - middle * (2.0 * middle.dot(&across) / square) };
        self.to * along + reflected
    }
}

/// A tangent without its component along the normal; if nothing remains, any unit vector perpendicular to the normal.
fn orthogonalize(tangent: Vector3<f64>, normal: Vector3<f64>) -> Vector3<f64> {
    let flat = tangent - normal * normal.dot(&tangent);
    let axis = if normal.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    flat.try_normalize(1e-6).unwrap_or_else(|| normal.cross(&axis).normalize())
}

fn vector(numbers: &[f32]) -> Vector3<f64> {
    Vector3::new(numbers[0], numbers[1], numbers[2]).cast()
}
