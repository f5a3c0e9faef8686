//! x = T (x0 + U q) in f32. Twin: `reference/deform.rs`.

use pulp::NullaryFnOnce;

use super::retained_modes::RetainedModes;
use super::simd::run_vectorized;
use super::sum::{ModeSelection, Scratch, TileVertices, sum};
use super::tile::{self, DomainTile, PackedOutput, PerTileOutput};
use super::tile_bounds::TileBounds;
use crate::storage::{QUAD, TILE_QUADS, TiledModes};
use modalcast_model::domain::Transform;
use modalcast_model::scene::{Scene, SceneState};

/// Maximum number of vertices of a tile.
pub(super) const MAX_TILE_VERTICES: usize = QUAD * TILE_QUADS;

/// The inputs of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct DeformInputs<'a> {
    pub(super) scene: &'a Scene,
    pub(super) state: &'a SceneState,
    /// Per shape.
    pub(super) shapes: &'a [TiledModes],
    pub(super) retained_modes: Option<&'a RetainedModes>,
    /// 0, 1, 2 and so on: the chunks of a domain without truncated modes.
    pub(super) all_chunks: &'a [u16],
}

/// Three f32 per vertex; the extent of each tile; and three more f32 per vertex if the scene keeps displacements.
pub(super) type TileOutputs<'a> = (PackedOutput<'a>, PerTileOutput<'a, TileBounds>, Option<PackedOutput<'a>>);

/// Writes positions, extents and displacements of these tiles. A tile's extent is not finite if one of its positions,
/// or one of the displacements that the scene keeps, is not.
pub(super) fn deform(inputs: DeformInputs, tiles: &[DomainTile], outputs: TileOutputs) {
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

/// A run of neighboring tiles on one core.
struct DeformTask<'a, const COMPENSATED: bool> {
    inputs: DeformInputs<'a>,
    tiles: &'a [DomainTile],
    outputs: TileOutputs<'a>,
}

impl<const COMPENSATED: bool> NullaryFnOnce for DeformTask<'_, COMPENSATED> {
    type Output = ();

    #[inline(always)]
    fn call(mut self) {
        let mut scratch = Scratch::new();
        for tile in self.tiles {
            let (positions, extents, displacements) = &mut self.outputs;
            let out = TileOutput {
                positions: positions.of(tile),
                displacements: displacements.as_mut().map(|all| all.of(tile)),
            };
            *extents.of(tile) = deform_tile::<COMPENSATED>(&self.inputs, tile, &mut scratch, out);
        }
    }
}

/// A tile's part of the outputs.
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
    let tiles = inputs.tiles_of(tile);
    let place = tiles.tile(tile.first() / MAX_TILE_VERTICES);
    if tiles.rank() > 0 {
        sum::<COMPENSATED>(tiles, &place, inputs.mode_selection(tile), scratch);
    } else {
        scratch.sums[..12 * place.quads].fill(0.0);
    }
    let spoil =
        out.displacements.map_or(0.0, |displacements| store_displacements(inputs, tile, &scratch.sums, displacements));
    add_rest(&tiles.rest()[place.first_quad..][..place.quads], &mut scratch.sums);
    let transform = inputs.state.transform_of(inputs.scene, tile.domain());
    let tile_bounds = store_positions(&transform, &mut scratch.sums, 4 * place.quads, out.positions);
    let tile_bounds =
        if tile_bounds.is_finite() { tile_bounds } else { repair_non_finite(inputs, tile, out.positions) };
    tile_bounds.poison_with(spoil)
}

/// Copies the sums of a tile, `[axis][vertex]`, to the displacements of its vertices. Displacements that are not finite
/// are summed again in f64, so that only values that f32 cannot hold are lost. Returns 0, or NaN if any is lost.
#[inline(always)]
fn store_displacements(inputs: &DeformInputs, tile: &DomainTile, sums: &TileVertices, out: &mut [f32]) -> f32 {
    let width = tile.count().next_multiple_of(QUAD);
    let mut spoil = 0.0;
    for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
        out.copy_from_slice(&[sums[vertex], sums[width + vertex], sums[2 * width + vertex]]);
        spoil += (out[0] + out[1] + out[2]) * 0.0;
    }
    if spoil == 0.0 { spoil } else { repair_displacements(inputs, tile, out) }
}

#[cold]
#[inline(never)]
fn repair_displacements(inputs: &DeformInputs, tile: &DomainTile, out: &mut [f32]) -> f32 {
    let (tiles, q) = (inputs.tiles_of(tile), inputs.q_of(tile));
    let mut spoil = 0.0;
    for (at, out) in out.chunks_exact_mut(3).enumerate() {
        if !out.iter().all(|number| number.is_finite()) {
            let exact = displacement_f64(tiles, q, tile.first() + at).map(|number| number as f32);
            out.copy_from_slice(&exact);
        }
        out.iter().for_each(|number| spoil += number * 0.0);
    }
    spoil
}

impl<'a> DeformInputs<'a> {
    #[inline(always)]
    fn tiles_of(&self, tile: &DomainTile) -> &'a TiledModes {
        &self.shapes[self.scene.domains[tile.domain()].shape]
    }

    #[inline(always)]
    fn mode_selection(&self, tile: &DomainTile) -> ModeSelection<'a> {
        let chunks = self.tiles_of(tile).chunks();
        match self.retained_modes {
            Some(retained_modes) => retained_modes.of(tile.domain()),
            None => ModeSelection { q: self.state.q_of(self.scene, tile.domain()), chunks: &self.all_chunks[..chunks] },
        }
    }

    /// The coordinates that a tile's domain sums.
    fn q_of(&self, tile: &DomainTile) -> &'a [f32] {
        if self.tiles_of(tile).rank() > 0 { self.mode_selection(tile).q } else { &[] }
    }
}

#[inline(always)]
fn add_rest(rest: &[[f32; 12]], sums: &mut TileVertices) {
    let width = QUAD * rest.len();
    for (axis, sums) in sums[..3 * width].chunks_exact_mut(width).enumerate() {
        for (sums, quad) in sums.chunks_exact_mut(QUAD).zip(rest) {
            for (sum, rest) in sums.iter_mut().zip(&quad[QUAD * axis..][..QUAD]) {
                *sum += *rest;
            }
        }
    }
}

/// World positions of a tile from `[axis][vertex]`, `width` vertices per axis. Overwrites `bent`.
#[inline(always)]
fn store_positions(transform: &Transform, bent: &mut TileVertices, width: usize, out: &mut [f32]) -> TileBounds {
    let t = transform.0;
    let (x, yz) = bent[..3 * width].split_at_mut(width);
    let (y, z) = yz.split_at_mut(width);
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
    TileBounds::of([&x[..count], &y[..count], &z[..count]])
}

/// Recomputes in f64 the vertices that are not finite: an f32 intermediate of a finite result may have overflowed.
#[cold]
#[inline(never)]
fn repair_non_finite(inputs: &DeformInputs, tile: &DomainTile, out: &mut [f32]) -> TileBounds {
    let tiles = inputs.tiles_of(tile);
    let transform = inputs.state.composed_transform(inputs.scene, tile.domain()).to_f64();
    let q = inputs.q_of(tile);
    let mut tile_bounds = TileBounds::EMPTY;
    for (at, out) in out.chunks_exact_mut(3).enumerate() {
        if !out.iter().all(|number| number.is_finite()) {
            let bent = deformed_rest_f64(tiles, q, tile.first() + at);
            for (row, out) in out.iter_mut().enumerate() {
                let [x, y, z, offset] = [0, 1, 2, 3].map(|column| transform[4 * row + column]);
                *out = (x * bent[0] + y * bent[1] + z * bent[2] + offset) as f32;
            }
        }
        tile_bounds = tile_bounds.union(TileBounds::of([&out[..1], &out[1..2], &out[2..]]));
    }
    tile_bounds
}

fn deformed_rest_f64(tiles: &TiledModes, q: &[f32], vertex: usize) -> [f64; 3] {
    let moved = displacement_f64(tiles, q, vertex);
    [0, 1, 2].map(|axis| moved[axis] + f64::from(tiles.rest()[vertex / QUAD][QUAD * axis + vertex % QUAD]))
}

fn displacement_f64(tiles: &TiledModes, q: &[f32], vertex: usize) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let part = |(mode, q): (usize, &f32)| tiles.decode_entry(vertex, axis, mode) * f64::from(*q);
        q.iter().enumerate().map(part).sum::<f64>()
    })
}
