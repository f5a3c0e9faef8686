//! Large motion of a volume mesh: extends the linear modes by their derivatives, computes the reduced forces of the Saint
//! Venant-Kirchhoff (StVK) material in this basis, and finds how far they can be trusted.

use modalcast_model::error::{Result, invalid};
use nalgebra::DVector;

use crate::assembly::SystemMatrices;
use crate::eigensolver::ElasticModes;
use crate::modal_derivatives::{combine, extend_by_derivatives};
use crate::reduced_force::{MAX_RANK, ReducedForce, file_bytes};
use crate::stvk::{MIN_STRETCH, StvkSolid};

/// Linear modes unless another number is given. With their derivatives, they have 20 coordinates.
pub const DEFAULT_LINEAR_MODES: usize = 5;

/// Loads on a mode, as the linear displacements that they cause in sizes of the body: from the smallest one to about one
/// size, each larger than the one before by a factor.
const SMALLEST_LOAD: f64 = 1.0 / 64.0;
const LOAD_FACTOR: f64 = std::f64::consts::SQRT_2;
const LOAD_STEPS: i32 = 13;

/// Maximum number of Newton iterations per load.
const MAX_ITERATIONS: usize = 30;

/// Limit on the residual at equilibrium, relative to the load.
const TOLERANCE: f64 = 1e-8;

/// The forces of large motion.
#[derive(Debug, Clone, PartialEq)]
pub struct LargeMotion {
    /// In the basis of [`ElasticModes`], whose first vectors are the linear modes.
    pub force: ReducedForce,
    pub linear_modes: usize,
    /// For each linear mode.
    pub safe_ranges: Vec<SafeRange>,
}

/// How far loads on a mode can be trusted: in both directions, no smaller load compresses a point of integration below
/// [`MIN_STRETCH`]. At most a linear displacement of about the size of the body is examined.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SafeRange {
    /// The coordinate of the mode at the largest load.
    pub coordinate: f64,
    /// The largest displacement of a node then, meters.
    pub displacement: f64,
}

/// The number of coordinates of linear modes with all of their derivatives.
pub const fn rank_of(linear_modes: usize) -> usize {
    linear_modes + linear_modes * (linear_modes + 1) / 2
}

/// Fails if the modes with their derivatives have too many coordinates.
///
/// # Errors
/// `Invalid` with the size of their forces.
pub fn check_linear_modes(linear_modes: usize) -> Result<()> {
    let rank = rank_of(linear_modes);
    match rank <= MAX_RANK {
        true => Ok(()),
        false => {
            let most = (1..).take_while(|modes| rank_of(*modes) <= MAX_RANK).last().unwrap_or(1);
            let size = file_bytes(rank);
            let expected = format!("at most {most}, which have {} coordinates with their derivatives", rank_of(most));
            let given = format!("{linear_modes}, with {rank} coordinates and cubic forces of {size} bytes");
            Err(invalid("--modes with --large", expected, given))
        }
    }
}

/// Extends the linear modes of a solid to the basis of large motion, and computes its forces, whose linear term is the
/// diagonal of eigenvalues. `rigid` and `shift` are those of [`crate::eigensolver::find_elastic_modes`].
///
/// # Errors
/// `Invalid` if the basis has too many coordinates; `Fault` if a derivative cannot be computed.
pub fn add_large_motion(
    solid: &StvkSolid<'_>,
    system: &SystemMatrices,
    rigid: &[Vec<f64>],
    shift: f64,
    modes: &mut ElasticModes,
    progress: &dyn Fn(f64, &str),
) -> Result<LargeMotion> {
    let linear_modes = modes.vectors.len();
    check_linear_modes(linear_modes)?;
    progress(0.0, "modal derivatives");
    let second_derivative = |first: &[f64], second: &[f64]| solid.second_derivative(first, second);
    let derivative_progress = |share: f64| progress(0.4 * share, "modal derivatives");
    extend_by_derivatives(system, rigid, shift, modes, &second_derivative, &derivative_progress)?;
    progress(0.4, "reduced forces");
    let mut force = ReducedForce::integrate(solid, &modes.vectors)?;
    force.set_stiffness(&modes.eigenvalues);
    progress(0.8, "largest compression");
    let safe_range = |mode: usize| {
        let [up, down] = [1.0, -1.0].map(|sign| safe_range(solid, modes, &force, mode, sign));
        if up.displacement <= down.displacement { up } else { down }
    };
    let safe_ranges = (0..linear_modes).map(safe_range).collect();
    Ok(LargeMotion { force, linear_modes, safe_ranges })
}

/// The range of growing loads on one mode in the direction of a sign, before a point is compressed below [`MIN_STRETCH`] or
/// there is no equilibrium.
fn safe_range(solid: &StvkSolid<'_>, modes: &ElasticModes, force: &ReducedForce, mode: usize, sign: f64) -> SafeRange {
    let (low, high) = solid.mesh.bounds();
    let largest_coordinate = (high - low).norm() / largest_displacement(&modes.vectors[mode]);
    let mut q = vec![0.0; modes.vectors.len()];
    let mut range = SafeRange { coordinate: 0.0, displacement: 0.0 };
    for step in 0..LOAD_STEPS {
        let coordinate = sign * SMALLEST_LOAD * LOAD_FACTOR.powi(step) * largest_coordinate;
        let mut load = vec![0.0; q.len()];
        load[mode] = modes.eigenvalues[mode] * coordinate;
        let Some(equilibrium) = find_equilibrium(force, &load, q) else { return range };
        q = equilibrium;
        let displacements = combine(&modes.vectors, &q);
        if solid.smallest_stretch(&displacements) < MIN_STRETCH {
            return range;
        }
        range = SafeRange { coordinate: q[mode].abs(), displacement: largest_displacement(&displacements) };
    }
    range
}

/// The coordinates at rest under a load, by Newton's method from `q`. `None` if it does not converge.
fn find_equilibrium(force: &ReducedForce, load: &[f64], q: Vec<f64>) -> Option<Vec<f64>> {
    let load = DVector::from_column_slice(load);
    let mut q = DVector::from_vec(q);
    for _ in 0..MAX_ITERATIONS {
        let missing = &load - DVector::from_vec(force.evaluate(q.as_slice()));
        if missing.norm() <= TOLERANCE * load.norm() {
            return Some(q.as_slice().to_vec());
        }
        // Not positive definite: the solid buckles.
        q += force.jacobian(q.as_slice()).cholesky()?.solve(&missing);
    }
    None
}

/// The largest displacement of a node.
fn largest_displacement(displacements: &[f64]) -> f64 {
    let norms = displacements.chunks_exact(3).map(|entries| entries.iter().map(|entry| entry * entry).sum::<f64>());
    norms.fold(0.0, f64::max).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_many_modes_are_refused_with_the_size_of_their_forces() {
        check_linear_modes(9).expect("54 coordinates");
        let error = check_linear_modes(10).expect_err("65 coordinates").to_string();
        assert!(error.contains("at most 9") && error.contains(&file_bytes(65).to_string()), "{error}");
        check_linear_modes(512).expect_err("a size that does not overflow");
    }
}
