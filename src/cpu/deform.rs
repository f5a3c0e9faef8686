//! x = T (x0 + U q) in f32. Twin: `reference/deform.rs`.

use rayon::prelude::*;

use super::tile::{self, TILE, Tile};
use crate::scene::{Bounds, Scene, State};

/// Writes three f32 per vertex into `positions` and returns their bounds, which are not finite when a sum overflowed.
pub(super) fn deform(scene: &Scene, state: &State, tiles: &[Tile], positions: &mut [f32]) -> Bounds {
    let simd = pulp::Arch::new();
    let one = |(tile, out): (Tile, &mut [f32])| simd.dispatch(|| deform_tile(scene, state, tile, out));
    let parts = tile::share(tiles, positions, 3);
    parts.into_par_iter().with_min_len(16).map(one).reduce(|| Bounds::EMPTY, Bounds::union)
}

#[inline(always)]
fn deform_tile(scene: &Scene, state: &State, tile: Tile, out: &mut [f32]) -> Bounds {
    let shape = scene.shape_of(tile.domain);
    let rest = &shape.mesh.rest().as_flattened()[3 * tile.first..][..3 * tile.count];
    let mut bent = [0.0_f32; 3 * TILE];
    let bent = &mut bent[..3 * tile.count];
    let q = state.q_of(scene, tile.domain);
    // Four modes at a time keep the sums in registers four times as long; the order of the sum stays that of the modes.
    let column = |mode: usize| &shape.modes.column(mode)[3 * tile.first..][..3 * tile.count];
    let mut quads = q.chunks_exact(4);
    for (quad, four) in quads.by_ref().enumerate() {
        add_four(bent, [0, 1, 2, 3].map(|lane| column(4 * quad + lane)), [four[0], four[1], four[2], four[3]]);
    }
    for (lane, amount) in quads.remainder().iter().enumerate() {
        add_one(bent, column(q.len() / 4 * 4 + lane), *amount);
    }
    for (sum, rest) in bent.iter_mut().zip(rest) {
        *sum += *rest;
    }
    place(&state.transforms[tile.domain].0, bent, out)
}

#[inline(always)]
fn add_four(sums: &mut [f32], columns: [&[f32]; 4], q: [f32; 4]) {
    let [a, b, c, d] = columns;
    for ((((sum, a), b), c), d) in sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
        *sum = d.mul_add(q[3], c.mul_add(q[2], b.mul_add(q[1], a.mul_add(q[0], *sum))));
    }
}

#[inline(always)]
fn add_one(sums: &mut [f32], column: &[f32], q: f32) {
    for (sum, entry) in sums.iter_mut().zip(column) {
        *sum = entry.mul_add(q, *sum);
    }
}

/// World positions of a tile, and their bounds.
#[inline(always)]
fn place(world_from_domain: &[f32; 12], bent: &[f32], out: &mut [f32]) -> Bounds {
    let (mut min, mut max, mut poison) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3], 0.0_f32);
    for (point, world) in bent.chunks_exact(3).zip(out.chunks_exact_mut(3)) {
        for axis in 0..3 {
            let [x, y, z, offset] = [0, 1, 2, 3].map(|column| world_from_domain[4 * axis + column]);
            let value = z.mul_add(point[2], y.mul_add(point[1], x.mul_add(point[0], offset)));
            world[axis] = value;
            min[axis] = min[axis].min(value);
            max[axis] = max[axis].max(value);
            // Infinity times zero is NaN, and NaN stays: one number tells whether all were finite.
            poison += value * 0.0;
        }
    }
    let poison = f64::from(poison);
    Bounds { min: min.map(|number| f64::from(number) + poison), max: max.map(|number| f64::from(number) + poison) }
}
