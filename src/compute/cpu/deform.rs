//! x = T (x0 + U q) in f32. Twin: `reference/deform.rs`.

use pulp::NullaryFnOnce;

use super::simd::run_vectorized;
use super::sum::{Scratch, TileVertices, sum_modes};
use super::tile::{self, DomainTile, PackedOutput, PerTileOutput, SplitOutput};
use super::tile_bounds::TileBounds;
use crate::storage::{QUAD, TILE_QUADS, TiledModes};
use modalcast_model::domain::Transform;
use modalcast_model::scene::{Scene, SceneState};

/// Maximum number of vertices of a tile. The tiles of vertices are those of the stored U, of [`TILE_QUADS`] quads.
pub(super) const MAX_TILE_VERTICES: usize = QUAD * TILE_QUADS;

/// The inputs of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct DeformInputs<'a> {
    pub(super) scene: &'a Scene,
    pub(super) state: &'a SceneState,
    /// Per shape.
    pub(super) shapes: &'a [TiledModes],
}

/// The outputs of a step.
pub(super) struct DeformOutputs<'a> {
    /// Three f32 per vertex.
    pub(super) positions: PackedOutput<'a>,
    /// Per tile. Not finite if a position or a displacement of the tile is not finite.
    pub(super) bounds: PerTileOutput<'a, TileBounds>,
    /// Three f32 per vertex; `None` if displacements are not an output of the scene.
    pub(super) displacements: Option<PackedOutput<'a>>,
}

impl SplitOutput for DeformOutputs<'_> {
    fn split_at_tile(self, tile: &DomainTile) -> (Self, Self) {
        let (left_positions, right_positions) = self.positions.split_at_tile(tile);
        let (left_bounds, right_bounds) = self.bounds.split_at_tile(tile);
        let (left_displacements, right_displacements) = self.displacements.split_at_tile(tile);
        (
            Self { positions: left_positions, bounds: left_bounds, displacements: left_displacements },
            Self { positions: right_positions, bounds: right_bounds, displacements: right_displacements },
        )
    }
}

/// Writes positions, bounds and displacements of these tiles.
pub(super) fn deform(inputs: DeformInputs, tiles: &[DomainTile], outputs: DeformOutputs) {
    if inputs.scene.features.compensated {
        tile::run_parallel(tiles, outputs, &|tiles, outputs| {
            run_vectorized(DeformTask::<true> { inputs, tiles, outputs })
        });
    } else {
        tile::run_parallel(tiles, outputs, &|tiles, outputs| {
            run_vectorized(DeformTask::<false> { inputs, tiles, outputs })
        });
    }
}

/// A run of consecutive tiles that one core computes.
struct DeformTask<'a, const COMPENSATED: bool> {
    inputs: DeformInputs<'a>,
    tiles: &'a [DomainTile],
    outputs: DeformOutputs<'a>,
}

impl<const COMPENSATED: bool> NullaryFnOnce for DeformTask<'_, COMPENSATED> {
    type Output = ();

    #[inline(always)]
    fn call(mut self) {
        let mut scratch = Scratch::new();
        let DeformOutputs { positions, bounds, displacements } = &mut self.outputs;
        for tile in self.tiles {
            let out = TileOutput {
                positions: positions.numbers_of(tile),
                displacements: displacements.as_mut().map(|displacements| displacements.numbers_of(tile)),
            };
            *bounds.value_of(tile) = deform_tile::<COMPENSATED>(&self.inputs, tile, &mut scratch, out);
        }
    }
}

/// The part of the outputs that belongs to one tile.
struct TileOutput<'a> {
    positions: &'a mut [f32],
    displacements: Option<&'a mut [f32]>,
}

#[inline(always)]
fn deform_tile<const COMPENSATED: bool>(
    inputs: &DeformInputs,
    tile: &DomainTile,
    scratch: &mut Scratch,
    out: TileOutput,
) -> TileBounds {
    let tiled_modes = inputs.tiled_modes_of(tile);
    let layout = tiled_modes.tile(tile.first_item() / MAX_TILE_VERTICES);
    if tiled_modes.rank() > 0 {
        sum_modes::<COMPENSATED>(tiled_modes, &layout, inputs.q_of(tile), scratch);
    } else {
        scratch.sums[..3 * QUAD * layout.quads].fill(0.0);
    }
    let zero_or_nan =
        out.displacements.map_or(0.0, |displacements| store_displacements(inputs, tile, &scratch.sums, displacements));
    add_rest_positions(&tiled_modes.rest()[layout.first_quad..][..layout.quads], &mut scratch.sums);
    let transform = inputs.state.transform_of(inputs.scene, tile.domain());
    let tile_bounds = store_positions(&transform, &mut scratch.sums, QUAD * layout.quads, out.positions);
    let tile_bounds =
        if tile_bounds.is_finite() { tile_bounds } else { repair_non_finite(inputs, tile, out.positions) };
    tile_bounds.nan_unless_finite(zero_or_nan)
}

/// Copies the sums of a tile, `[axis][vertex]`, to the displacements of its vertices, and repairs displacements that
/// are not finite. Returns NaN if a displacement is not finite in f32 even after the repair, else 0.
#[inline(always)]
fn store_displacements(inputs: &DeformInputs, tile: &DomainTile, sums: &TileVertices, out: &mut [f32]) -> f32 {
    let axis_stride = tile.item_count().next_multiple_of(QUAD);
    let mut zero_or_nan = 0.0;
    for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
        out.copy_from_slice(&[sums[vertex], sums[axis_stride + vertex], sums[2 * axis_stride + vertex]]);
        // A finite number times zero is 0; infinity or NaN times zero is NaN.
        zero_or_nan += (out[0] + out[1] + out[2]) * 0.0;
    }
    if zero_or_nan == 0.0 { zero_or_nan } else { repair_displacements(inputs, tile, out) }
}

/// Computes the displacements that are not finite again, with sums in f64. Returns NaN if one of these displacements is
/// still not finite in f32, else 0.
#[cold]
#[inline(never)]
fn repair_displacements(inputs: &DeformInputs, tile: &DomainTile, out: &mut [f32]) -> f32 {
    let (tiled_modes, q) = (inputs.tiled_modes_of(tile), inputs.q_of(tile));
    let mut zero_or_nan = 0.0;
    for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
        if !out.iter().all(|number| number.is_finite()) {
            let displacement = displacement_f64(tiled_modes, q, tile.first_item() + vertex).map(|number| number as f32);
            out.copy_from_slice(&displacement);
        }
        out.iter().for_each(|number| zero_or_nan += number * 0.0);
    }
    zero_or_nan
}

impl<'a> DeformInputs<'a> {
    /// The stored U of the shape of a tile's domain.
    #[inline(always)]
    fn tiled_modes_of(&self, tile: &DomainTile) -> &'a TiledModes {
        &self.shapes[self.scene.domains[tile.domain()].shape]
    }

    /// The coordinates of a tile's domain; empty without modes.
    #[inline(always)]
    fn q_of(&self, tile: &DomainTile) -> &'a [f32] {
        self.state.q_of(self.scene, tile.domain())
    }
}

/// Adds x0 to the sums of a tile, `[axis][vertex]`.
#[inline(always)]
fn add_rest_positions(rest: &[[f32; 12]], sums: &mut TileVertices) {
    let axis_stride = QUAD * rest.len();
    for (axis, sums) in sums[..3 * axis_stride].chunks_exact_mut(axis_stride).enumerate() {
        for (sums, quad) in sums.chunks_exact_mut(QUAD).zip(rest) {
            for (sum, rest) in sums.iter_mut().zip(&quad[QUAD * axis..][..QUAD]) {
                *sum += *rest;
            }
        }
    }
}

/// Writes the world positions of a tile. `deformed` is x0 + u as `[axis][vertex]` with `axis_stride` vertices per axis,
/// and is overwritten.
#[inline(always)]
fn store_positions(
    transform: &Transform,
    deformed: &mut TileVertices,
    axis_stride: usize,
    out: &mut [f32],
) -> TileBounds {
    let t = transform.0;
    let (x, yz) = deformed[..3 * axis_stride].split_at_mut(axis_stride);
    let (y, z) = yz.split_at_mut(axis_stride);
    for ((x, y), z) in x.iter_mut().zip(y.iter_mut()).zip(z.iter_mut()) {
        // No closure here: it would be compiled without fused multiply-adds.
        let [a, b, c] = [*x, *y, *z];
        *x = c.mul_add(t[2], b.mul_add(t[1], a.mul_add(t[0], t[3])));
        *y = c.mul_add(t[6], b.mul_add(t[5], a.mul_add(t[4], t[7])));
        *z = c.mul_add(t[10], b.mul_add(t[9], a.mul_add(t[8], t[11])));
    }
    let count = out.len() / 3;
    for (((out, x), y), z) in out.chunks_exact_mut(3).zip(&*x).zip(&*y).zip(&*z) {
        out.copy_from_slice(&[*x, *y, *z]);
    }
    TileBounds::of_axes([&x[..count], &y[..count], &z[..count]])
}

/// Recomputes in f64 the positions that are not finite, because only an intermediate f32 may have overflowed. Returns
/// the bounds of all positions.
#[cold]
#[inline(never)]
fn repair_non_finite(inputs: &DeformInputs, tile: &DomainTile, out: &mut [f32]) -> TileBounds {
    let tiled_modes = inputs.tiled_modes_of(tile);
    let transform = inputs.state.composed_transform(inputs.scene, tile.domain()).to_f64();
    let q = inputs.q_of(tile);
    let mut tile_bounds = TileBounds::EMPTY;
    for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
        if !out.iter().all(|number| number.is_finite()) {
            let deformed = deformed_position_f64(tiled_modes, q, tile.first_item() + vertex);
            for (row, out) in out.iter_mut().enumerate() {
                let [x, y, z, offset] = [0, 1, 2, 3].map(|column| transform[4 * row + column]);
                *out = (x * deformed[0] + y * deformed[1] + z * deformed[2] + offset) as f32;
            }
        }
        tile_bounds = tile_bounds.union(TileBounds::of_axes([&out[..1], &out[1..2], &out[2..]]));
    }
    tile_bounds
}

/// x0 + u of a vertex.
fn deformed_position_f64(tiled_modes: &TiledModes, q: &[f32], vertex: usize) -> [f64; 3] {
    let displacement = displacement_f64(tiled_modes, q, vertex);
    [0, 1, 2].map(|axis| displacement[axis] + f64::from(tiled_modes.rest()[vertex / QUAD][QUAD * axis + vertex % QUAD]))
}

/// u of a vertex.
fn displacement_f64(tiled_modes: &TiledModes, q: &[f32], vertex: usize) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let mode_term = |(mode, q): (usize, &f32)| tiled_modes.decode_entry(vertex, axis, mode) * f64::from(*q);
        q.iter().enumerate().map(mode_term).sum::<f64>()
    })
}
