//! A-priori bounds of the error of a deformer's x, one number per source of error.
//!
//! The sum of a vertex is a chain of fused multiply-adds from +0 over its modes in ascending order, then `+ x0`, then
//! three fused multiply-adds per row of T, all in f32. With u = 2^-24 and gamma_k = k u / (1 - k u), the error of a
//! chain of k roundings is at most gamma_k times the sum of the magnitudes of its terms (Higham, Accuracy and Stability
//! of Numerical Algorithms, 2nd ed., 2002, sections 2.2 and 3.1), plus 2^-150 for every rounding that underflows. The
//! error of a compensated sum is at most u |s| + gamma_k^2 sum|terms| (Ogita, Rump, Oishi, Accurate Sum and Dot
//! Product, 2005, proposition 5.5), plus 5 k 2^-149.
//!
//! T of a follower is a product T_m F, rounded as [`ComposedTransform::to_f32`] defines: three roundings per entry. The error
//! of its linear part is at most gamma_3 |T_m| |F| per entry, that of its translation gamma_3 (|T_m| |f| + |t_m|).
//!
//! A bound is a length, the maximum error of a vertex position in scene units. It holds for sums without overflow, and
//! is infinite where q times a factor overflows f32.

use rayon::prelude::*;

use super::{TensorCoreError, TiledModes};
use modalcast_model::domain::{ComposedTransform, Shape, Transform};
use modalcast_model::scene::StorageType;

/// Safety factor, slightly more than the few thousand f64 operations of a bound can lose.
const ROUND_UP: f64 = 1.0 + 1e-12;
/// Half a unit in the last place of f32, relative.
const UNIT: f64 = 1.0 / (1 << 24) as f64;
/// Half of the smallest f32.
const UNDERFLOW: f64 = f64::from_bits((1023 - 150) << 52);
const SQRT_3: f64 = 1.732_050_807_568_878;

/// Maximum error of a vertex of one tile or domain by source, in scene units.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct ErrorBound {
    /// Rounding of the entries of U to the storage type: for r modes `sum_j |q_j| step_j / 2` per axis.
    pub storage: f64,
    /// q times the factor or scale of a mode, rounded to f32.
    pub coordinates: f64,
    /// The sum over the modes.
    pub accumulation: f64,
    /// `x0 + u`.
    pub rest: f64,
    /// Multiplication by A and addition of the translation.
    pub transform: f64,
    /// Product of the transform of a root and the frame of its follower; 0 for a root.
    pub frame: f64,
}

impl ErrorBound {
    /// The sum of all sources.
    pub fn total(&self) -> f64 {
        (self.storage + self.coordinates + self.accumulation + self.rest + self.transform + self.frame) * ROUND_UP
    }

    /// The maximum per source.
    pub fn max(self, other: Self) -> Self {
        Self {
            storage: self.storage.max(other.storage),
            coordinates: self.coordinates.max(other.coordinates),
            accumulation: self.accumulation.max(other.accumulation),
            rest: self.rest.max(other.rest),
            transform: self.transform.max(other.transform),
            frame: self.frame.max(other.frame),
        }
    }
}

/// Inputs of a bound besides the shape.
#[derive(Debug, Clone, Copy)]
pub struct ErrorBoundInput<'a> {
    /// Coordinates of the domain; zero for truncated modes.
    pub q: &'a [f32],
    /// As returned by `modalcast_model::scene::SceneState::composed`.
    pub transform: ComposedTransform,
    pub compensated: bool,
}

/// Bounds of a mode in a tile.
#[derive(Debug, Clone, Copy, Default)]
struct ModeErrorTerms {
    /// The longest row of its vertices, as stored.
    length: f64,
    /// Maximum rounding error of an entry.
    half_step: f64,
    /// Decoded entries are stored entries times this factor.
    factor: f32,
}

/// Tables of one shape in one storage type from which bounds are computed.
#[derive(Debug, Clone)]
pub struct ShapeErrorModel {
    rank: usize,
    /// `[tile][mode]`.
    modes: Vec<ModeErrorTerms>,
    /// The longest x0 per tile.
    rest: Vec<f64>,
}

impl ShapeErrorModel {
    /// Reads every entry of `shape`, from which `tiles` were made.
    pub fn new(shape: &Shape, tiles: &TiledModes) -> Self {
        let modes = |tile: usize| (0..tiles.rank()).map(move |mode| reach(shape, tiles, tile, mode));
        let rest = |tile: usize| {
            let place = tiles.tile(tile);
            let rest = &shape.mesh.rest_positions()[place.first_vertex..][..place.vertices];
            rest.iter().map(|vertex| length(vertex.map(f64::from))).fold(0.0, f64::max) * ROUND_UP
        };
        Self {
            rank: tiles.rank(),
            modes: (0..tiles.count()).into_par_iter().flat_map_iter(modes).collect(),
            rest: (0..tiles.count()).map(rest).collect(),
        }
    }

    /// Bounds of the vertices of tile `tile`.
    pub fn tile(&self, tile: usize, step: &ErrorBoundInput) -> ErrorBound {
        let modes = &self.modes[self.rank * tile..][..self.rank];
        let (mut storage, mut lost, mut moved, mut terms) = (0.0, 0.0, 0.0, 0.0);
        for (reach, q) in modes.iter().zip(step.q) {
            let amount = f64::from(q.abs());
            storage += amount * reach.half_step;
            if amount == 0.0 || reach.length == 0.0 {
                continue;
            }
            // The product of two f32 is exact in f64, so its rounding error in f32 is known.
            let (exact, to_f32) = (amount * f64::from(reach.factor), f64::from(q.abs() * reach.factor));
            lost += stored_length(reach) * (exact - to_f32).abs();
            moved += stored_length(reach) * to_f32;
            terms += 1.0;
        }
        self.finish(tile, step, [SQRT_3 * storage, lost, moved, terms])
    }

    /// Additional error of the vertices of tile `tile` when its sums are computed by tensor cores, scene units.
    pub fn products(&self, tile: usize, step: &ErrorBoundInput, products: TensorCoreError) -> f64 {
        let modes = || self.modes[self.rank * tile..][..self.rank].iter().zip(step.q);
        let amount = |(reach, q): (&ModeErrorTerms, &f32)| f64::from(q.abs() * reach.factor);
        let largest = modes().map(amount).fold(TensorCoreError::least(), f64::max);
        let one = |(reach, q): (&ModeErrorTerms, &f32)| {
            let own = amount((reach, q)) * (products.coordinate + products.sum);
            stored_length(reach) * (own + products.floor * largest)
        };
        modes().map(one).sum::<f64>() * norm(&step.transform) * ROUND_UP
    }

    /// Bounds of all vertices.
    pub fn domain(&self, step: &ErrorBoundInput) -> ErrorBound {
        (0..self.rest.len()).map(|tile| self.tile(tile, step)).fold(ErrorBound::default(), ErrorBound::max)
    }

    /// Maximum error of u at the vertices of a tile, in scene units of the domain; independent of x0 and T.
    pub fn displacement(&self, tile: usize, q: &[f32], compensated: bool) -> f64 {
        let step = ErrorBoundInput { q, transform: Transform::IDENTITY.into(), compensated };
        let ErrorBound { storage, coordinates, accumulation, .. } = self.tile(tile, &step);
        (storage + coordinates + accumulation) * ROUND_UP
    }

    fn finish(&self, tile: usize, step: &ErrorBoundInput, parts: [f64; 4]) -> ErrorBound {
        let [storage, lost, moved, terms] = parts.map(|part| part * ROUND_UP);
        let accumulation = match step.compensated {
            false => gamma(terms) * moved + 2.0 * SQRT_3 * terms * UNDERFLOW,
            true => UNIT * moved + gamma(terms).powi(2) * moved + 10.0 * SQRT_3 * terms * UNDERFLOW,
        };
        let bent = self.rest[tile] + moved + accumulation;
        let rest = if terms > 0.0 { UNIT * bent } else { 0.0 };
        let (own, stretch) = (step.transform.to_f32(), norm(&step.transform));
        let entries = own.linear().norm() * ROUND_UP;
        let offset = own.translation().norm() * ROUND_UP;
        let [turned, moved] = rounding(&step.transform);
        let frame = (turned * (bent + rest) + moved) * ROUND_UP;
        let transform = gamma(3.0) * (entries * (bent + rest) + offset) + 6.0 * SQRT_3 * UNDERFLOW;
        let [storage, coordinates, accumulation, rest] =
            [storage, lost, accumulation, rest].map(|part| part * stretch * ROUND_UP);
        ErrorBound { storage, coordinates, accumulation, rest, transform: transform * ROUND_UP, frame }
    }
}

/// Maximum difference of the linear part (in the Frobenius norm) and of the translation of [`ComposedTransform::to_f32`] from
/// the exact product; zeros for a transform root.
fn rounding(transform: &ComposedTransform) -> [f64; 2] {
    let Some(frame) = transform.frame else { return [0.0; 2] };
    let sizes = ComposedTransform {
        root: Transform(transform.root.0.map(f32::abs)),
        frame: Some(Transform(frame.0.map(f32::abs))),
    };
    let entries = sizes.to_f64();
    let length = |of: &mut dyn Iterator<Item = f64>| {
        of.map(|entry| (gamma(3.0) * entry + 3.0 * UNDERFLOW).powi(2)).sum::<f64>().sqrt() * ROUND_UP
    };
    let is_linear = |at: &usize| at % 4 != 3;
    let all = 0..entries.len();
    let linear = length(&mut all.clone().filter(is_linear).map(|at| entries[at]));
    [linear, length(&mut all.filter(|at| !is_linear(at)).map(|at| entries[at]))]
}

/// Upper bound of `||A||_2` of the linear part, exact and as deformers round it. Too large by at most a relative 1e-7,
/// and for a follower by the rounding error that the product with its frame may add.
pub fn norm(transform: &ComposedTransform) -> f64 {
    let [turned, _] = rounding(transform);
    (norm_of(&transform.to_f32()) + turned) * ROUND_UP
}

/// Upper bound of `||A||_2`, too large by at most a relative 1e-7. The root of the largest eigenvalue of A^T A, by the
/// trigonometric formula for 3x3 matrices (Smith, Eigenvalues of a symmetric 3x3 matrix, 1961).
fn norm_of(transform: &Transform) -> f64 {
    let linear = transform.linear();
    let largest = linear.abs().max();
    if largest == 0.0 {
        return 0.0;
    }
    // Scale entries to at most 1, so that no square over- or underflows f64.
    let linear = linear / largest;
    let gram = linear.transpose() * linear;
    let mean = gram.trace() / 3.0;
    let off = gram - nalgebra::Matrix3::identity() * mean;
    let spread = (off.norm_squared() / 6.0).sqrt();
    let eigenvalue = if spread > 0.0 {
        let angle = ((off / spread).determinant() / 2.0).clamp(-1.0, 1.0).acos() / 3.0;
        mean + 2.0 * spread * angle.cos()
    } else {
        mean
    };
    eigenvalue.sqrt() * largest * (1.0 + 5e-8)
}

/// gamma_k of f32.
fn gamma(roundings: f64) -> f64 {
    roundings * UNIT / (1.0 - roundings * UNIT)
}

fn length(vector: [f64; 3]) -> f64 {
    vector.iter().map(|number| number * number).sum::<f64>().sqrt()
}

fn reach(shape: &Shape, tiles: &TiledModes, tile: usize, mode: usize) -> ModeErrorTerms {
    let place = tiles.tile(tile);
    let row = |vertex| length([0, 1, 2].map(|axis| tiles.decode_entry(vertex, axis, mode)));
    let longest = (place.first_vertex..place.first_vertex + place.vertices).map(row).fold(0.0, f64::max);
    let entries = &shape.modes.column(mode)[3 * place.first_vertex..][..3 * place.vertices];
    let largest = entries.iter().fold(0.0, |largest: f32, entry| largest.max(entry.abs()));
    ModeErrorTerms {
        length: longest * ROUND_UP,
        half_step: half_step(tiles, tile, mode, largest),
        factor: factor(tiles, tile, mode),
    }
}

/// The longest row in units of the factor; 0 for a mode of zeros.
fn stored_length(reach: &ModeErrorTerms) -> f64 {
    if reach.factor > 0.0 { reach.length / f64::from(reach.factor) } else { 0.0 }
}

fn factor(tiles: &TiledModes, tile: usize, mode: usize) -> f32 {
    match tiles.storage() {
        StorageType::F32 => 1.0,
        StorageType::F16 | StorageType::Bf16 => tiles.factors()[mode],
        StorageType::Int8 => tiles.scales()[tiles.tile(tile).first_scale + mode],
    }
}

/// Maximum rounding error of an entry of a tile in the storage type; `largest` is the tile's largest entry.
fn half_step(tiles: &TiledModes, tile: usize, mode: usize, largest: f32) -> f64 {
    let factor = f64::from(factor(tiles, tile, mode));
    // Half the spacing: 2^-11 of the power of two below for f16, 2^-8 for bf16; both types have a smallest spacing.
    let below = f64::exp2(f64::from(super::quantize::exponent(largest)));
    match tiles.storage() {
        _ if largest == 0.0 => 0.0,
        StorageType::F32 => 0.0,
        StorageType::F16 => (below * f64::exp2(-11.0)).max(factor * f64::exp2(-25.0)),
        // A whole smallest step: the value may be rounded twice, first to f32.
        StorageType::Bf16 => (below * f64::exp2(-8.0)).max(factor * f64::exp2(-133.0)),
        StorageType::Int8 => factor / 2.0 * ROUND_UP,
    }
}

#[cfg(test)]
mod tests;
