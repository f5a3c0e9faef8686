//! Rigid normals by the inverse transpose of A, tangents by A, in f32. Twin: `reference/rigid_normals.rs`.

use nalgebra::{Matrix3, Vector3};

use super::tile::{self, DomainTile, PackedOutput};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::scene::{Scene, SceneState};

/// Writes the normals, three f32 per corner, and the tangents, four f32 per corner, if the scene has normal maps.
pub(super) fn rigid_normals(scene: &Scene, state: &SceneState, tiles: &[DomainTile], surface: &mut DeformedSurface) {
    tile::run_parallel(tiles, PackedOutput::new(3, &mut surface.normals), &|tiles, mut out| {
        tiles.iter().for_each(|tile| write_rigid_normals(scene, state, tile, out.of(tile)));
    });
    if scene.features.normal_maps {
        tile::run_parallel(tiles, PackedOutput::new(4, &mut surface.tangents), &|tiles, mut out| {
            tiles.iter().for_each(|tile| write_rigid_tangents(scene, state, tile, out.of(tile)));
        });
    }
}

/// World normals of a tile.
pub(super) fn write_rigid_normals(scene: &Scene, state: &SceneState, tile: &DomainTile, out: &mut [f32]) {
    let linear = state.composed_transform(scene, tile.domain()).linear();
    // Without shear A itself transforms normals, up to the sign of a reflection, which the cofactors include.
    let turn = if scene.features.shear { cofactors(&linear) * linear.determinant().signum() } else { linear };
    let turn = scaled(turn);
    let normals = &scene.shape_of(tile.domain()).mesh.corners().normals[tile.first()..][..tile.count()];
    for (normal, out) in normals.iter().zip(out.chunks_exact_mut(3)) {
        out.copy_from_slice(unit(turn * Vector3::from(*normal)).as_slice());
    }
}

/// World tangents of a tile; not written if the shape has none.
pub(super) fn write_rigid_tangents(scene: &Scene, state: &SceneState, tile: &DomainTile, out: &mut [f32]) {
    let tangents = scene.shape_of(tile.domain()).tangents();
    if tangents.is_empty() {
        return;
    }
    let linear = state.composed_transform(scene, tile.domain()).linear();
    let hand = linear.determinant().signum() as f32;
    let turn = scaled(linear);
    for ([x, y, z, sign], out) in tangents[tile.first()..][..tile.count()].iter().zip(out.chunks_exact_mut(4)) {
        out[..3].copy_from_slice(unit(turn * Vector3::new(*x, *y, *z)).as_slice());
        out[3] = sign * hand;
    }
}

/// Scales entries to at most 1, so that squares of very large or small transforms do not over- or underflow f32.
fn scaled(matrix: Matrix3<f64>) -> Matrix3<f32> {
    let largest = matrix.abs().max();
    if largest > 0.0 { (matrix / largest).cast() } else { matrix.cast() }
}

pub(super) fn cofactors(linear: &Matrix3<f64>) -> Matrix3<f64> {
    let adjugate = |row: usize, column: usize| {
        let at = |i: usize, j: usize| linear[((row + i) % 3, (column + j) % 3)];
        at(1, 1) * at(2, 2) - at(1, 2) * at(2, 1)
    };
    Matrix3::from_fn(adjugate)
}

/// A vector divided by its length; +Z if its length is about zero.
pub(super) fn unit(vector: Vector3<f32>) -> Vector3<f32> {
    let square = vector.norm_squared();
    if square > 1e-30 { vector / square.sqrt() } else { Vector3::z() }
}
