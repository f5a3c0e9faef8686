//! Bounds of one tile, and of a scene. The deformer stores them between steps, because the bounds of a scene include
//! unchanged tiles.

use std::ops::Range;

use rayon::prelude::*;

use modalcast_model::deform::BoundingAxes;
use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// Bounds of f32 positions: all NaN if a position is not finite, `min > max` if there are none.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileBounds {
    min: [f32; 3],
    max: [f32; 3],
}

/// Number of independent minima and maxima: one per lane of a 256-bit vector of f32.
const LANES: usize = 8;

impl TileBounds {
    pub(super) const EMPTY: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    /// Bounds of positions. `axes` has the x of all positions, then their y and their z.
    #[inline(always)]
    pub(super) fn of_axes(axes: [&[f32]; 3]) -> Self {
        let mut tile_bounds = Self::EMPTY;
        let mut zero_or_nan = 0.0;
        for (axis, numbers) in axes.into_iter().enumerate() {
            let (mut min, mut max, mut sums) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES], [0.0_f32; LANES]);
            let mut blocks = numbers.chunks_exact(LANES);
            for block in blocks.by_ref() {
                for lane in 0..LANES {
                    let number = block[lane];
                    min[lane] = if number < min[lane] { number } else { min[lane] };
                    max[lane] = if number > max[lane] { number } else { max[lane] };
                    // The sum stays 0 if all numbers are finite: infinity times zero is NaN, and NaN propagates.
                    sums[lane] += number * 0.0;
                }
            }
            for number in blocks.remainder() {
                (min[0], max[0], sums[0]) = (min[0].min(*number), max[0].max(*number), sums[0] + number * 0.0);
            }
            tile_bounds.min[axis] = min.into_iter().fold(f32::INFINITY, f32::min);
            tile_bounds.max[axis] = max.into_iter().fold(f32::NEG_INFINITY, f32::max);
            zero_or_nan += sums.iter().sum::<f32>();
        }
        tile_bounds.add_zero_or_nan(zero_or_nan)
    }

    /// The smallest bounds that contain both.
    #[inline(always)]
    pub(super) fn union(self, other: Self) -> Self {
        // `add_zero_or_nan(number * 0.0)` would be wrong for empty bounds, which are infinite: they must not make the
        // union NaN.
        let zero_or_nan = if self.min[0].is_nan() || other.min[0].is_nan() { f32::NAN } else { 0.0 };
        Self {
            min: std::array::from_fn(|axis| self.min[axis].min(other.min[axis])),
            max: std::array::from_fn(|axis| self.max[axis].max(other.max[axis])),
        }
        .add_zero_or_nan(zero_or_nan)
    }

    /// Whether all positions are finite, and there is at least one.
    #[inline(always)]
    pub(super) const fn is_finite(&self) -> bool {
        self.min[0].is_finite()
    }

    /// Bounds of the tiles of one domain.
    pub(super) fn of_domain(tile_bounds: &[Self]) -> BoundingBox {
        Self::of_tiles(tile_bounds).to_bounds()
    }

    fn of_tiles(tile_bounds: &[Self]) -> Self {
        tile_bounds.iter().copied().fold(Self::EMPTY, Self::union)
    }

    fn to_bounds(self) -> BoundingBox {
        BoundingBox { min: self.min.map(f64::from), max: self.max.map(f64::from) }
    }

    /// Makes the bounds NaN if `number` is not finite.
    #[inline(always)]
    pub(super) fn nan_unless_finite(self, number: f32) -> Self {
        self.add_zero_or_nan(number * 0.0)
    }

    /// Adds 0, which changes nothing, or NaN, which makes all bounds NaN.
    #[inline(always)]
    fn add_zero_or_nan(self, zero_or_nan: f32) -> Self {
        Self { min: self.min.map(|number| number + zero_or_nan), max: self.max.map(|number| number + zero_or_nan) }
    }
}

/// Number of tiles in a block.
const BLOCK_TILES: usize = 64;

/// Bounds of all tiles of a scene, which a step updates at the cost of the tiles that it changes.
#[derive(Debug)]
pub(super) struct SceneBounds {
    axes: Option<BoundingAxes>,
    /// Bounds of each [`BLOCK_TILES`] consecutive tiles.
    blocks: Vec<BlockBounds>,
}

#[derive(Debug, Clone, Copy)]
struct BlockBounds {
    bounds: TileBounds,
    /// Bounds along the axes, if there are any. They enclose the boxes of the tiles, so they may be larger than the
    /// bounds of the positions.
    oriented: OrientedBounds,
}

impl BlockBounds {
    const EMPTY: Self = Self { bounds: TileBounds::EMPTY, oriented: OrientedBounds::EMPTY };

    fn of_tiles(tile_bounds: &[TileBounds], axes: Option<&BoundingAxes>) -> Self {
        let oriented = axes.map_or(OrientedBounds::EMPTY, |axes| {
            let bounds_of_tile = |tile: &TileBounds| OrientedBounds::enclosing(axes, &tile.to_bounds());
            tile_bounds.iter().map(bounds_of_tile).fold(OrientedBounds::EMPTY, OrientedBounds::union)
        });
        Self { bounds: TileBounds::of_tiles(tile_bounds), oriented }
    }

    fn union(self, other: Self) -> Self {
        Self { bounds: self.bounds.union(other.bounds), oriented: self.oriented.union(other.oriented) }
    }
}

impl SceneBounds {
    pub(super) const fn new() -> Self {
        Self { axes: None, blocks: Vec::new() }
    }

    /// Also bounds the positions of every step along these axes.
    pub(super) fn set_axes(&mut self, axes: Option<BoundingAxes>) {
        (self.axes, self.blocks) = (axes, Vec::new());
    }

    /// Updates the bounds of the changed tiles: ascending ranges, or all tiles.
    pub(super) fn update(
        &mut self,
        tile_bounds: &[TileBounds],
        changed_tiles: Option<impl Iterator<Item = Range<usize>>>,
    ) {
        let Self { axes, blocks } = self;
        let of_block = |block: usize| {
            let first = block * BLOCK_TILES;
            let tiles = &tile_bounds[first..tile_bounds.len().min(first + BLOCK_TILES)];
            BlockBounds::of_tiles(tiles, axes.as_ref())
        };
        let block_count = tile_bounds.len().div_ceil(BLOCK_TILES);
        match changed_tiles.filter(|_| blocks.len() == block_count) {
            Some(ranges) => {
                let mut next_block = 0;
                for range in ranges.filter(|range| !range.is_empty()) {
                    let end = range.end.div_ceil(BLOCK_TILES);
                    let first = next_block.max(range.start / BLOCK_TILES).min(end);
                    for (block, bounds) in (first..).zip(&mut blocks[first..end]) {
                        *bounds = of_block(block);
                    }
                    next_block = end;
                }
            }
            None => (0..block_count).into_par_iter().with_min_len(64).map(of_block).collect_into_vec(blocks),
        }
    }

    /// Bounds of the scene, and bounds along the axes, if there are any.
    pub(super) fn get(&self) -> (BoundingBox, Option<OrientedBounds>) {
        let scene = self.blocks.iter().copied().fold(BlockBounds::EMPTY, BlockBounds::union);
        (scene.bounds.to_bounds(), self.axes.map(|_| scene.oriented))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_contain_positions_and_are_nan_for_non_finite_ones() {
        // `index * 8 % 21` has each number from 0 to 20 once.
        let axes: [Vec<f32>; 3] = [0, 1, 2].map(|axis| (0..21).map(|index| (index * 8 % 21 + axis) as f32).collect());
        let bounds_of = |axes: &[Vec<f32>; 3]| TileBounds::of_axes([&axes[0], &axes[1], &axes[2]]);
        let tile_bounds = bounds_of(&axes);
        assert_eq!((tile_bounds.min, tile_bounds.max), ([0.0, 1.0, 2.0], [20.0, 21.0, 22.0]));
        for non_finite in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for index in 0..63 {
                let mut poisoned_axes = axes.clone();
                poisoned_axes[index % 3][index / 3] = non_finite;
                let poisoned = bounds_of(&poisoned_axes);
                assert!(!poisoned.is_finite());
                assert!(!TileBounds::of_tiles(&[tile_bounds, poisoned, tile_bounds]).is_finite());
            }
        }
        let point_bounds = TileBounds::of_axes([&[30.0], &[-5.0], &[3.0]]);
        let union = TileBounds::of_tiles(&[tile_bounds, point_bounds, TileBounds::EMPTY]);
        assert_eq!((union.min, union.max), ([0.0, -5.0, 2.0], [30.0, 21.0, 22.0]));
    }

    /// Changed tiles at the ends of blocks, over several blocks and in the last block, which is shorter.
    #[test]
    fn updated_bounds_equal_the_bounds_of_all_tiles() {
        let axes = modalcast_model::scene::light_axes(
            nalgebra::Vector3::new(0.3, -0.8, 0.5),
            modalcast_model::scene::UpAxis::Y,
        );
        let point = |number: f32| TileBounds::of_axes([&[number], &[-2.0 * number], &[0.5 * number]]);
        let mut tiles: Vec<TileBounds> = (0..1000).map(|index| point(index as f32)).collect();
        let bounds_of_all = |tiles: &[TileBounds]| {
            let mut bounds = SceneBounds::new();
            bounds.set_axes(Some(axes));
            bounds.update(tiles, None::<std::vec::IntoIter<Range<usize>>>);
            bounds
        };
        let mut bounds = bounds_of_all(&tiles);
        for ranges in [vec![0..1, 1..1], vec![63..64, 64..65], vec![10..300, 300..300, 310..311], vec![5..6, 998..1000]]
        {
            let before = bounds.get();
            for (factor, is_larger) in [(1.0, true), (-1.0, true), (0.0, false)] {
                ranges.iter().cloned().flatten().for_each(|tile| tiles[tile] = point(factor * 5000.0));
                bounds.update(&tiles, Some(ranges.clone().into_iter()));
                assert_eq!(bounds.get(), bounds_of_all(&tiles).get(), "{ranges:?}");
                assert!(!is_larger || bounds.get() != before, "control: {ranges:?}");
            }
        }
    }
}
