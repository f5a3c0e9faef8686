//! x = T (x0 + U q) in f32. Twin: `reference/deform.rs`.

use pulp::NullaryFnOnce;

use super::extent::Extent;
use super::kept::Kept;
use super::simd::vectorized;
use super::sum::{Coordinates, Scratch, Summed, sum};
use super::tile::{self, Packed, PerTile, Tile};
use crate::storage::{QUAD, TILE_QUADS, Tiles};
use modalcast_model::domain::Transform;
use modalcast_model::scene::{Scene, State};

/// Maximum number of vertices of a tile.
pub(super) const TILE: usize = QUAD * TILE_QUADS;

/// The inputs of a step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inputs<'a> {
    pub(super) scene: &'a Scene,
    pub(super) state: &'a State,
    /// Per shape.
    pub(super) shapes: &'a [Tiles],
    pub(super) kept: Option<&'a Kept>,
    /// 0, 1, 2 and so on: the chunks of a domain without truncated modes.
    pub(super) every_chunk: &'a [u16],
}

/// Three f32 per vertex; the extent of each tile; and three more f32 per vertex if the scene keeps displacements.
pub(super) type Outputs<'a> = (Packed<'a>, PerTile<'a, Extent>, Option<Packed<'a>>);

/// Writes positions, extents and displacements of these tiles. A tile's extent is not finite if one of its positions,
/// or one of the displacements that the scene keeps, is not.
pub(super) fn deform(inputs: Inputs, tiles: &[Tile], outputs: Outputs) {
    if inputs.scene.needs.compensated {
        tile::spread(tiles, outputs, &|tiles, outputs| vectorized(Run::<true> { inputs, tiles, outputs }));
    } else {
        tile::spread(tiles, outputs, &|tiles, outputs| vectorized(Run::<false> { inputs, tiles, outputs }));
    }
}

/// A run of neighboring tiles on one core.
struct Run<'a, const COMPENSATED: bool> {
    inputs: Inputs<'a>,
    tiles: &'a [Tile],
    outputs: Outputs<'a>,
}

impl<const COMPENSATED: bool> NullaryFnOnce for Run<'_, COMPENSATED> {
    type Output = ();

    #[inline(always)]
    fn call(mut self) {
        let mut scratch = Scratch::new();
        for tile in self.tiles {
            let (positions, extents, displacements) = &mut self.outputs;
            let out =
                Out { positions: positions.of(tile), displacements: displacements.as_mut().map(|all| all.of(tile)) };
            *extents.of(tile) = deform_tile::<COMPENSATED>(&self.inputs, tile, &mut scratch, out);
        }
    }
}

/// A tile's part of the outputs.
struct Out<'a> {
    positions: &'a mut [f32],
    displacements: Option<&'a mut [f32]>,
}

#[inline(always)]
fn deform_tile<const COMPENSATED: bool>(inputs: &Inputs, tile: &Tile, scratch: &mut Scratch, out: Out) -> Extent {
    let tiles = inputs.tiles_of(tile);
    let place = tiles.tile(tile.first() / TILE);
    if tiles.rank() > 0 {
        sum::<COMPENSATED>(tiles, &place, inputs.summed(tile), scratch);
    } else {
        scratch.sums[..12 * place.quads].fill(0.0);
    }
    let spoil = out.displacements.map_or(0.0, |displacements| keep(inputs, tile, &scratch.sums, displacements));
    add_rest(&tiles.rest()[place.first_quad..][..place.quads], &mut scratch.sums);
    let transform = inputs.state.transform_of(inputs.scene, tile.domain());
    let extent = put(&transform, &mut scratch.sums, 4 * place.quads, out.positions);
    let extent = if extent.is_finite() { extent } else { rescue(inputs, tile, out.positions) };
    extent.spoilt_by(spoil)
}

/// Copies the sums of a tile, `[axis][vertex]`, to the displacements of its vertices. Displacements that are not finite
/// are summed again in f64, so that only values that f32 cannot hold are lost. Returns 0, or NaN if any is lost.
#[inline(always)]
fn keep(inputs: &Inputs, tile: &Tile, sums: &Coordinates, out: &mut [f32]) -> f32 {
    let width = tile.count().next_multiple_of(QUAD);
    let mut spoil = 0.0;
    for (vertex, out) in out.chunks_exact_mut(3).enumerate() {
        out.copy_from_slice(&[sums[vertex], sums[width + vertex], sums[2 * width + vertex]]);
        spoil += (out[0] + out[1] + out[2]) * 0.0;
    }
    if spoil == 0.0 { spoil } else { rescue_displacements(inputs, tile, out) }
}

#[cold]
#[inline(never)]
fn rescue_displacements(inputs: &Inputs, tile: &Tile, out: &mut [f32]) -> f32 {
    let (tiles, q) = (inputs.tiles_of(tile), inputs.q_of(tile));
    let mut spoil = 0.0;
    for (at, out) in out.chunks_exact_mut(3).enumerate() {
        if !out.iter().all(|number| number.is_finite()) {
            let exact = displacement_in_f64(tiles, q, tile.first() + at).map(|number| number as f32);
            out.copy_from_slice(&exact);
        }
        out.iter().for_each(|number| spoil += number * 0.0);
    }
    spoil
}

impl<'a> Inputs<'a> {
    #[inline(always)]
    fn tiles_of(&self, tile: &Tile) -> &'a Tiles {
        &self.shapes[self.scene.domains[tile.domain()].shape]
    }

    #[inline(always)]
    fn summed(&self, tile: &Tile) -> Summed<'a> {
        let chunks = self.tiles_of(tile).chunks();
        match self.kept {
            Some(kept) => kept.of(tile.domain()),
            None => Summed { q: self.state.q_of(self.scene, tile.domain()), chunks: &self.every_chunk[..chunks] },
        }
    }

    /// The coordinates that a tile's domain sums.
    fn q_of(&self, tile: &Tile) -> &'a [f32] {
        if self.tiles_of(tile).rank() > 0 { self.summed(tile).q } else { &[] }
    }
}

#[inline(always)]
fn add_rest(rest: &[[f32; 12]], sums: &mut Coordinates) {
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
fn put(transform: &Transform, bent: &mut Coordinates, width: usize, out: &mut [f32]) -> Extent {
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
    Extent::of([&x[..count], &y[..count], &z[..count]])
}

/// Recomputes in f64 the vertices that are not finite: an f32 intermediate of a finite result may have overflowed.
#[cold]
#[inline(never)]
fn rescue(inputs: &Inputs, tile: &Tile, out: &mut [f32]) -> Extent {
    let tiles = inputs.tiles_of(tile);
    let transform = inputs.state.composed(inputs.scene, tile.domain()).exact();
    let q = inputs.q_of(tile);
    let mut extent = Extent::EMPTY;
    for (at, out) in out.chunks_exact_mut(3).enumerate() {
        if !out.iter().all(|number| number.is_finite()) {
            let bent = bent_in_f64(tiles, q, tile.first() + at);
            for (row, out) in out.iter_mut().enumerate() {
                let [x, y, z, offset] = [0, 1, 2, 3].map(|column| transform[4 * row + column]);
                *out = (x * bent[0] + y * bent[1] + z * bent[2] + offset) as f32;
            }
        }
        extent = extent.union(Extent::of([&out[..1], &out[1..2], &out[2..]]));
    }
    extent
}

fn bent_in_f64(tiles: &Tiles, q: &[f32], vertex: usize) -> [f64; 3] {
    let moved = displacement_in_f64(tiles, q, vertex);
    [0, 1, 2].map(|axis| moved[axis] + f64::from(tiles.rest()[vertex / QUAD][QUAD * axis + vertex % QUAD]))
}

fn displacement_in_f64(tiles: &Tiles, q: &[f32], vertex: usize) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let part = |(mode, q): (usize, &f32)| tiles.decoded(vertex, axis, mode) * f64::from(*q);
        q.iter().enumerate().map(part).sum::<f64>()
    })
}
