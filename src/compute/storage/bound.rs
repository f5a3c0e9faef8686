//! A-priori bounds of the error of a deformer's x = T (x0 + U q), one number per source of error. A is the linear part
//! of T.
//!
//! The sum of a vertex is a chain of fused multiply-adds from +0 over its modes in ascending order, then `+ x0`, then
//! three fused multiply-adds per row of T, all in f32. With the unit roundoff e = 2^-24 and gamma_k = k e / (1 - k e),
//! the error of a chain of k roundings is at most gamma_k times the sum of the magnitudes of its terms (Higham,
//! Accuracy and Stability of Numerical Algorithms, 2nd ed., 2002, sections 2.2 and 3.1), plus 2^-150 for every rounding
//! that underflows. The error of a compensated sum s of k terms is at most e |s| + gamma_k^2 sum|terms| (Ogita, Rump,
//! Oishi, Accurate Sum and Dot Product, 2005, proposition 5.5), plus 5 k 2^-149.
//!
//! A follower is a domain that moves with another domain, its root. Its T is the product T_root F of the root's
//! transform T_root and the follower's constant frame F. [`ComposedTransform::to_f32`] rounds each entry of T three
//! times. The error of an entry of the linear part is at most gamma_3 |T_root| |F|. The error of the translation is at
//! most gamma_3 (|T_root| |f| + |t_root|), where f and t_root are the translations of F and T_root.
//!
//! A bound is a length, the maximum error of a vertex position in scene units. It holds for sums without overflow, and
//! is infinite where q times a factor overflows f32.

use rayon::prelude::*;

use super::{TensorCoreError, TiledModes};
use modalcast_model::domain::{ComposedTransform, Shape, Transform};
use modalcast_model::scene::StorageType;

/// Safety factor: more than the rounding error of the few thousand f64 operations of a bound.
const ROUND_UP: f64 = 1.0 + 1e-12;
/// e, the unit roundoff of f32.
const UNIT_ROUNDOFF: f64 = 1.0 / (1 << 24) as f64;
/// 2^-150, half of the smallest positive f32: the maximum error of a rounding that underflows.
const UNDERFLOW: f64 = f64::from_bits((1023 - 150) << 52);
/// Maximum ratio of the norm of a vector to its largest component.
const SQRT_3: f64 = 1.732_050_807_568_878;

/// Bounds of the error of any vertex of one tile or domain, one per source of error, in scene units.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct ErrorBound {
    /// Rounding of the entries of U to the storage type, by at most half a step each.
    pub storage: f64,
    /// Rounding of q times the factor or scale of a mode.
    pub coordinates: f64,
    /// Rounding of the sum over the modes.
    pub accumulation: f64,
    /// Rounding of `x0 + u`.
    pub rest: f64,
    /// Rounding of the multiplication by A and the addition of the translation.
    pub transform: f64,
    /// Rounding of the product of a root's transform and the frame of its follower; 0 for a root.
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
    /// Coordinates of the domain.
    pub q: &'a [f32],
    /// As returned by `modalcast_model::scene::SceneState::composed_transform`.
    pub transform: ComposedTransform,
    /// Whether the sum over the modes is compensated.
    pub compensated: bool,
}

/// The quantities of one mode in one tile from which bounds are computed.
#[derive(Debug, Clone, Copy, Default)]
struct ModeErrorTerms {
    /// Largest norm of the three decoded entries of a vertex.
    max_row_norm: f64,
    /// Maximum rounding error of an entry: half the spacing of stored values.
    half_step: f64,
    /// Decoded entries are stored entries times this factor.
    factor: f32,
}

/// Sums over the modes of one tile, before multiplication by A.
#[derive(Debug, Clone, Copy, Default)]
struct ModeSums {
    /// Error of one axis of u from rounding U.
    storage: f64,
    /// Error of u (its norm) from rounding scaled coordinates.
    coordinates: f64,
    /// Upper bound of the sum of the magnitudes of all terms.
    magnitude_sum: f64,
    /// Number of terms that are not zero.
    term_count: f64,
}

/// Tables of one shape in one storage type from which bounds are computed.
#[derive(Debug, Clone)]
pub struct ShapeErrorModel {
    rank: usize,
    /// `[tile][mode]`.
    modes: Vec<ModeErrorTerms>,
    /// Largest norm of x0 per tile.
    max_rest_norms: Vec<f64>,
}

impl ShapeErrorModel {
    /// Reads every entry of `shape`, from which `tiles` were made.
    pub fn new(shape: &Shape, tiles: &TiledModes) -> Self {
        let modes = |tile: usize| (0..tiles.rank()).map(move |mode| mode_error_terms(shape, tiles, tile, mode));
        let max_rest_norm = |tile: usize| {
            let layout = tiles.tile(tile);
            let rest = &shape.mesh.rest_positions()[layout.first_vertex..][..layout.vertices];
            rest.iter().map(|position| norm_f64(position.map(f64::from))).fold(0.0, f64::max) * ROUND_UP
        };
        Self {
            rank: tiles.rank(),
            modes: (0..tiles.count()).into_par_iter().flat_map_iter(modes).collect(),
            max_rest_norms: (0..tiles.count()).map(max_rest_norm).collect(),
        }
    }

    /// Bounds of the vertices of tile `tile`.
    pub fn tile_bound(&self, tile: usize, input: &ErrorBoundInput) -> ErrorBound {
        let modes = &self.modes[self.rank * tile..][..self.rank];
        let mut sums = ModeSums::default();
        for (mode, q) in modes.iter().zip(input.q) {
            let coordinate = f64::from(q.abs());
            sums.storage += coordinate * mode.half_step;
            if coordinate == 0.0 || mode.max_row_norm == 0.0 {
                continue;
            }
            // The product of two f32 is exact in f64, so its rounding error in f32 is known.
            let exact = coordinate * f64::from(mode.factor);
            let rounded = f64::from(q.abs() * mode.factor);
            sums.coordinates += stored_row_norm(mode) * (exact - rounded).abs();
            sums.magnitude_sum += stored_row_norm(mode) * rounded;
            sums.term_count += 1.0;
        }
        self.bound_from_sums(tile, input, sums)
    }

    /// Bound of the additional error of the vertices of tile `tile` when tensor cores compute its sums, in scene units.
    pub fn tensor_core_bound(&self, tile: usize, input: &ErrorBoundInput, error: TensorCoreError) -> f64 {
        let modes = || self.modes[self.rank * tile..][..self.rank].iter().zip(input.q);
        let scaled_coordinate = |(mode, q): (&ModeErrorTerms, &f32)| f64::from(q.abs() * mode.factor);
        let largest = modes().map(scaled_coordinate).fold(TensorCoreError::min_largest_coordinate(), f64::max);
        let mode_error = |(mode, q): (&ModeErrorTerms, &f32)| {
            let relative_error = scaled_coordinate((mode, q)) * (error.coordinate + error.sum);
            stored_row_norm(mode) * (relative_error + error.floor * largest)
        };
        modes().map(mode_error).sum::<f64>() * linear_norm_bound(&input.transform) * ROUND_UP
    }

    /// Bounds of all vertices.
    pub fn domain_bound(&self, input: &ErrorBoundInput) -> ErrorBound {
        (0..self.max_rest_norms.len())
            .map(|tile| self.tile_bound(tile, input))
            .fold(ErrorBound::default(), ErrorBound::max)
    }

    /// Maximum error of u at the vertices of a tile, in scene units of the domain; independent of x0 and T.
    pub fn displacement_bound(&self, tile: usize, q: &[f32], compensated: bool) -> f64 {
        let input = ErrorBoundInput { q, transform: Transform::IDENTITY.into(), compensated };
        let ErrorBound { storage, coordinates, accumulation, .. } = self.tile_bound(tile, &input);
        (storage + coordinates + accumulation) * ROUND_UP
    }

    /// Computes the bounds of a tile from the sums over its modes.
    fn bound_from_sums(&self, tile: usize, input: &ErrorBoundInput, sums: ModeSums) -> ErrorBound {
        let storage = SQRT_3 * sums.storage * ROUND_UP;
        let [coordinates, magnitude_sum, term_count] =
            [sums.coordinates, sums.magnitude_sum, sums.term_count].map(|number| number * ROUND_UP);
        // For a plain sum, the factor 2 covers the growth of underflow errors by later roundings. For a compensated
        // sum, 10 UNDERFLOW is 5 * 2^-149 of the documentation of this module.
        let accumulation = match input.compensated {
            false => gamma(term_count) * magnitude_sum + 2.0 * SQRT_3 * term_count * UNDERFLOW,
            true => {
                UNIT_ROUNDOFF * magnitude_sum
                    + gamma(term_count).powi(2) * magnitude_sum
                    + 10.0 * SQRT_3 * term_count * UNDERFLOW
            }
        };
        // Maximum norm of x0 + u.
        let max_deformed_norm = self.max_rest_norms[tile] + magnitude_sum + accumulation;
        let rest = if term_count > 0.0 { UNIT_ROUNDOFF * max_deformed_norm } else { 0.0 };
        let (rounded_transform, norm) = (input.transform.to_f32(), linear_norm_bound(&input.transform));
        let linear_norm = rounded_transform.linear().norm() * ROUND_UP;
        let translation_norm = rounded_transform.translation().norm() * ROUND_UP;
        let frame_error = frame_rounding_error(&input.transform);
        let frame = (frame_error.linear * (max_deformed_norm + rest) + frame_error.translation) * ROUND_UP;
        // 6 UNDERFLOW: three roundings, with the factor 2 again.
        let transform =
            gamma(3.0) * (linear_norm * (max_deformed_norm + rest) + translation_norm) + 6.0 * SQRT_3 * UNDERFLOW;
        let [storage, coordinates, accumulation, rest] =
            [storage, coordinates, accumulation, rest].map(|error| error * norm * ROUND_UP);
        ErrorBound { storage, coordinates, accumulation, rest, transform: transform * ROUND_UP, frame }
    }
}

/// Maximum difference of [`ComposedTransform::to_f32`] from the exact product.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct FrameError {
    /// Frobenius norm of the difference of the linear parts.
    linear: f64,
    /// Norm of the difference of the translations.
    translation: f64,
}

/// The bound of the rounding error of a follower's transform; zero for a transform root.
fn frame_rounding_error(transform: &ComposedTransform) -> FrameError {
    let Some(frame) = transform.frame else { return FrameError::default() };
    let magnitudes = ComposedTransform {
        root: Transform(transform.root.0.map(f32::abs)),
        frame: Some(Transform(frame.0.map(f32::abs))),
    };
    let entries = magnitudes.to_f64();
    let error_norm = |entries: &mut dyn Iterator<Item = f64>| {
        entries.map(|entry| (gamma(3.0) * entry + 3.0 * UNDERFLOW).powi(2)).sum::<f64>().sqrt() * ROUND_UP
    };
    let is_linear = |index: &usize| index % 4 != 3;
    let indices = 0..entries.len();
    FrameError {
        linear: error_norm(&mut indices.clone().filter(is_linear).map(|index| entries[index])),
        translation: error_norm(&mut indices.filter(|index| !is_linear(index)).map(|index| entries[index])),
    }
}

/// Upper bound of `||A||_2`, both for the exact A and for A as deformers round it. The bound is too large by a relative
/// 1e-7 at most, and for a follower also by the rounding error of the product with its frame.
fn linear_norm_bound(transform: &ComposedTransform) -> f64 {
    (spectral_norm(&transform.to_f32()) + frame_rounding_error(transform).linear) * ROUND_UP
}

/// Upper bound of `||A||_2`, too large by a relative 1e-7 at most: the square root of the largest eigenvalue of A^T A,
/// computed by the trigonometric formula for 3x3 matrices (Smith, Eigenvalues of a symmetric 3x3 matrix, 1961).
fn spectral_norm(transform: &Transform) -> f64 {
    let linear = transform.linear();
    let max_entry = linear.abs().max();
    if max_entry == 0.0 {
        return 0.0;
    }
    // Scale entries to at most 1, so that no square overflows or underflows f64.
    let linear = linear / max_entry;
    let gram = linear.transpose() * linear;
    let mean = gram.trace() / 3.0;
    let deviator = gram - nalgebra::Matrix3::identity() * mean;
    let spread = (deviator.norm_squared() / 6.0).sqrt();
    let eigenvalue = if spread > 0.0 {
        let angle = ((deviator / spread).determinant() / 2.0).clamp(-1.0, 1.0).acos() / 3.0;
        mean + 2.0 * spread * angle.cos()
    } else {
        mean
    };
    // The last factor covers the rounding errors of the formula.
    eigenvalue.sqrt() * max_entry * (1.0 + 5e-8)
}

/// gamma_k of f32, for k `roundings`.
fn gamma(roundings: f64) -> f64 {
    roundings * UNIT_ROUNDOFF / (1.0 - roundings * UNIT_ROUNDOFF)
}

fn norm_f64(vector: [f64; 3]) -> f64 {
    vector.iter().map(|number| number * number).sum::<f64>().sqrt()
}

fn mode_error_terms(shape: &Shape, tiles: &TiledModes, tile: usize, mode: usize) -> ModeErrorTerms {
    let layout = tiles.tile(tile);
    let row_norm = |vertex| norm_f64([0, 1, 2].map(|axis| tiles.decode_entry(vertex, axis, mode)));
    let vertices = layout.first_vertex..layout.first_vertex + layout.vertices;
    let entries = &shape.modes.column(mode)[3 * layout.first_vertex..][..3 * layout.vertices];
    let max_entry = entries.iter().fold(0.0, |max_entry: f32, entry| max_entry.max(entry.abs()));
    ModeErrorTerms {
        max_row_norm: vertices.map(row_norm).fold(0.0, f64::max) * ROUND_UP,
        half_step: half_step(tiles, tile, mode, max_entry),
        factor: factor(tiles, tile, mode),
    }
}

/// The largest norm of the three stored entries of a vertex, before multiplication by the factor; 0 for a mode of
/// zeros.
fn stored_row_norm(mode: &ModeErrorTerms) -> f64 {
    if mode.factor > 0.0 { mode.max_row_norm / f64::from(mode.factor) } else { 0.0 }
}

/// Factor of the stored entries of a mode in a tile.
fn factor(tiles: &TiledModes, tile: usize, mode: usize) -> f32 {
    match tiles.storage() {
        StorageType::F32 => 1.0,
        StorageType::F16 | StorageType::Bf16 => tiles.factors()[mode],
        StorageType::Int8 => tiles.scales()[tiles.tile(tile).first_scale + mode],
    }
}

/// Maximum rounding error of an entry of one mode in a tile; `max_entry` is the largest magnitude of these entries.
fn half_step(tiles: &TiledModes, tile: usize, mode: usize, max_entry: f32) -> f64 {
    let factor = f64::from(factor(tiles, tile, mode));
    // Half the spacing of stored values near an entry is 2^-11 (f16) or 2^-8 (bf16) times the power of two at or below
    // the magnitude of the entry, but at least half the smallest spacing: 2^-24 / 2 (f16) or 2^-133 / 2 (bf16), times
    // the factor.
    let power_of_two = f64::exp2(f64::from(super::quantize::floor_log2(max_entry)));
    match tiles.storage() {
        _ if max_entry == 0.0 => 0.0,
        StorageType::F32 => 0.0,
        StorageType::F16 => (power_of_two * f64::exp2(-11.0)).max(factor * f64::exp2(-25.0)),
        // The whole smallest spacing 2^-133 instead of half, because the value may be rounded twice: to f32, then to
        // bf16.
        StorageType::Bf16 => (power_of_two * f64::exp2(-8.0)).max(factor * f64::exp2(-133.0)),
        StorageType::Int8 => factor / 2.0 * ROUND_UP,
    }
}

#[cfg(test)]
mod tests;
