//! Rigid normals, transformed by the inverse transpose of A, and tangents, transformed by A, in f32. A is the linear
//! part of T. Twin: `reference/rigid_normals.rs`.

use nalgebra::{Matrix3, Vector3};

use super::tile::{self, DomainTile, PackedOutput};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::scene::{Scene, SceneState};

/// Writes the normals, three f32 per corner, and the tangents, four f32 per corner, if the scene has normal maps.
pub(super) fn compute_rigid_normals(
    scene: &Scene,
    state: &SceneState,
    tiles: &[DomainTile],
    surface: &mut DeformedSurface,
) {
    tile::run_parallel(tiles, PackedOutput::new(3, &mut surface.normals), &|tiles, mut out| {
        tiles.iter().for_each(|tile| write_rigid_normals(scene, state, tile, out.numbers_of(tile)));
    });
    if scene.features.normal_maps {
        tile::run_parallel(tiles, PackedOutput::new(4, &mut surface.tangents), &|tiles, mut out| {
            tiles.iter().for_each(|tile| write_rigid_tangents(scene, state, tile, out.numbers_of(tile)));
        });
    }
}

/// Writes the world normals of a tile.
pub(super) fn write_rigid_normals(scene: &Scene, state: &SceneState, tile: &DomainTile, out: &mut [f32]) {
    let linear = state.composed_transform(scene, tile.domain()).linear();
    // Without shear, the inverse transpose of A is A times a positive factor, which normalization removes.
    let normal_transform =
        if scene.features.shear { cofactors(&linear) * linear.determinant().signum() } else { linear };
    let normal_transform = limit_entries(normal_transform);
    let normals = &scene.shape_of(tile.domain()).mesh.corners().normals[tile.first_item()..][..tile.item_count()];
    for (normal, out) in normals.iter().zip(out.chunks_exact_mut(3)) {
        out.copy_from_slice(normalize_or_z(normal_transform * Vector3::from(*normal)).as_slice());
    }
}

/// Writes the world tangents of a tile if the shape has tangents.
pub(super) fn write_rigid_tangents(scene: &Scene, state: &SceneState, tile: &DomainTile, out: &mut [f32]) {
    let tangents = scene.shape_of(tile.domain()).tangents();
    if tangents.is_empty() {
        return;
    }
    let linear = state.composed_transform(scene, tile.domain()).linear();
    let determinant_sign = linear.determinant().signum() as f32;
    let tangent_transform = limit_entries(linear);
    for ([x, y, z, sign], out) in tangents[tile.first_item()..][..tile.item_count()].iter().zip(out.chunks_exact_mut(4))
    {
        out[..3].copy_from_slice(normalize_or_z(tangent_transform * Vector3::new(*x, *y, *z)).as_slice());
        out[3] = sign * determinant_sign;
    }
}

/// Scales entries to at most 1, so that squares of very large or small entries neither overflow nor underflow f32.
fn limit_entries(matrix: Matrix3<f64>) -> Matrix3<f32> {
    let max_entry = matrix.abs().max();
    if max_entry > 0.0 { (matrix / max_entry).cast() } else { matrix.cast() }
}

/// The cofactors of A: its determinant times its inverse transpose.
pub(super) fn cofactors(linear: &Matrix3<f64>) -> Matrix3<f64> {
    let cofactor = |row: usize, column: usize| {
        // Cyclic indices give each 2 x 2 minor its sign.
        let entry = |i: usize, j: usize| linear[((row + i) % 3, (column + j) % 3)];
        entry(1, 1) * entry(2, 2) - entry(1, 2) * entry(2, 1)
    };
    Matrix3::from_fn(cofactor)
}

/// Divides a vector by its length. Returns +Z if the length is at most 1e-15, so that no division overflows.
pub(super) fn normalize_or_z(vector: Vector3<f32>) -> Vector3<f32> {
    let length_squared = vector.norm_squared();
    if length_squared > 1e-30 { vector / length_squared.sqrt() } else { Vector3::z() }
}
