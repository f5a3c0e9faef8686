//! The bounds of one tile, cached so that tiles that did not change still count in the bounds of the scene.

use nalgebra::Vector3;
use rayon::prelude::*;

use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// Bounds of f32 positions: all NaN if a position is not finite, `min > max` if there are none.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileBounds {
    min: [f32; 3],
    max: [f32; 3],
}

const LANES: usize = 8;

impl TileBounds {
    pub(super) const EMPTY: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    /// Bounds of positions given by axis.
    #[inline(always)]
    pub(super) fn of(axes: [&[f32]; 3]) -> Self {
        let mut tile_bounds = Self::EMPTY;
        let mut poison = 0.0;
        for (axis, numbers) in axes.into_iter().enumerate() {
            let (mut min, mut max, mut sums) = ([f32::INFINITY; LANES], [f32::NEG_INFINITY; LANES], [0.0_f32; LANES]);
            let mut eights = numbers.chunks_exact(LANES);
            for eight in eights.by_ref() {
                for lane in 0..LANES {
                    let number = eight[lane];
                    min[lane] = if number < min[lane] { number } else { min[lane] };
                    max[lane] = if number > max[lane] { number } else { max[lane] };
                    // Infinity times zero is NaN, and NaN propagates: the sum shows whether all numbers are finite.
                    sums[lane] += number * 0.0;
                }
            }
            for number in eights.remainder() {
                (min[0], max[0], sums[0]) = (min[0].min(*number), max[0].max(*number), sums[0] + number * 0.0);
            }
            tile_bounds.min[axis] = min.into_iter().fold(f32::INFINITY, f32::min);
            tile_bounds.max[axis] = max.into_iter().fold(f32::NEG_INFINITY, f32::max);
            poison += sums.iter().sum::<f32>();
        }
        tile_bounds.poisoned(poison)
    }

    /// The smallest extent that contains both.
    #[inline(always)]
    pub(super) fn union(self, other: Self) -> Self {
        // An empty extent is infinite but not NaN, and must not make the union NaN.
        let poison = if self.min[0].is_nan() || other.min[0].is_nan() { f32::NAN } else { 0.0 };
        Self {
            min: std::array::from_fn(|axis| self.min[axis].min(other.min[axis])),
            max: std::array::from_fn(|axis| self.max[axis].max(other.max[axis])),
        }
        .poisoned(poison)
    }

    /// Whether all positions are finite, and there is at least one.
    #[inline(always)]
    pub(super) const fn is_finite(&self) -> bool {
        self.min[0].is_finite()
    }

    /// Bounds of all tiles.
    pub(super) fn all(extents: &[Self]) -> BoundingBox {
        extents.par_iter().with_min_len(4096).copied().reduce(|| Self::EMPTY, Self::union).to_bounds()
    }

    /// Bounds of all tiles along these axes, from the corners of their boxes.
    pub(super) fn along(extents: &[Self], axes: &[Vector3<f64>; 3]) -> OrientedBounds {
        let one = |tile_bounds: &Self| OrientedBounds::enclosing(axes, &tile_bounds.to_bounds());
        extents.par_iter().with_min_len(4096).map(one).reduce(|| OrientedBounds::EMPTY, OrientedBounds::union)
    }

    /// Bounds of the tiles of one domain.
    pub(super) fn of_domain(extents: &[Self]) -> BoundingBox {
        extents.iter().copied().fold(Self::EMPTY, Self::union).to_bounds()
    }

    fn to_bounds(self) -> BoundingBox {
        BoundingBox { min: self.min.map(f64::from), max: self.max.map(f64::from) }
    }

    /// The extent, made NaN if `number` is not finite.
    #[inline(always)]
    pub(super) fn poison_with(self, number: f32) -> Self {
        self.poisoned(number * 0.0)
    }

    /// The extent, unchanged if `poison` is 0, all NaN if it is NaN.
    #[inline(always)]
    fn poisoned(self, poison: f32) -> Self {
        Self { min: self.min.map(|number| number + poison), max: self.max.map(|number| number + poison) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_extent_holds_every_position_and_any_that_is_not_finite_spoils_it() {
        let axes: [Vec<f32>; 3] = [0, 1, 2].map(|axis| (0..21).map(|at| (at * 8 % 21 + axis) as f32).collect());
        let of = |axes: &[Vec<f32>; 3]| TileBounds::of([&axes[0], &axes[1], &axes[2]]);
        let tile_bounds = of(&axes);
        assert_eq!((tile_bounds.min, tile_bounds.max), ([0.0, 1.0, 2.0], [20.0, 21.0, 22.0]));
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for place in 0..63 {
                let mut spoiled = axes.clone();
                spoiled[place % 3][place / 3] = bad;
                assert!(!of(&spoiled).is_finite());
                assert!(!TileBounds::all(&[tile_bounds, of(&spoiled), tile_bounds]).is_finite());
            }
        }
        let other = TileBounds::of([&[30.0], &[-5.0], &[3.0]]);
        let both = TileBounds::all(&[tile_bounds, other, TileBounds::EMPTY]);
        assert_eq!((both.min, both.max), ([0.0, -5.0, 2.0], [30.0, 21.0, 22.0]));
    }
}
