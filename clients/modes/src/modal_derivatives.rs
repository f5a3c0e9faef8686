//! The basis of large motion: linear modes and their modal derivatives (Idelsohn, Cardona 1985; Barbič, James 2005). A
//! linear mode of a beam bends it without the shortening that belongs to a large rotation. The derivatives
//! Psi_ij = -K^-1 (d^2 f / du^2)(phi_i, phi_j) contain this shortening, so that the force of a Saint Venant-Kirchhoff
//! material is accurate in the basis.
//!
//! The derivative of modes i and j matters as much as both move. It is weighted by lambda_1^2 / (lambda_i lambda_j), and a
//! principal component analysis in the mass norm removes directions that are combinations of others. For a free body, the
//! load of each derivative is balanced by its rigid acceleration (inertia relief).

use faer::{Mat, MatRef, Side};
use modalcast_model::error::{Result, fault};

use crate::assembly::{SystemMatrices, dot};
use crate::eigensolver::{ElasticModes, Factor, make_largest_entry_positive};

/// Principal components below this share of the largest one are rounding errors, or combinations of the others.
const MIN_COMPONENT: f64 = 1e-6;

/// Limit on the residual of a derivative, relative to its load.
const TOLERANCE: f64 = 1e-11;

/// Limit on the iterations for a derivative. The shift of the factorization is small, so that a few are enough.
const MAX_ITERATIONS: usize = 60;

/// The second derivative of the internal force at rest in the directions of two vectors.
pub type SecondDerivative<'a> = dyn Fn(&[f64], &[f64]) -> Vec<f64> + 'a;

/// The equations K x = b of a body, free or held, by a factorization of K + s M.
struct StaticSolver<'a> {
    system: &'a SystemMatrices,
    factor: Factor,
    /// Rigid motions, mass-orthonormal.
    rigid: Vec<Vec<f64>>,
}

impl StaticSolver<'_> {
    /// The displacements under a load, without rigid motions.
    ///
    /// # Errors
    /// `Fault` if the iteration does not converge.
    fn solve(&self, mut load: Vec<f64>) -> Result<Vec<f64>> {
        for motion in &self.rigid {
            let share = dot(motion, &load);
            subtract(&mut load, share, &self.system.apply_mass(motion));
        }
        let scale = dot(&load, &load).sqrt();
        let mut solution = vec![0.0; load.len()];
        let mut residual = load;
        for _ in 0..MAX_ITERATIONS {
            let norm = dot(&residual, &residual).sqrt();
            if norm <= TOLERANCE * scale {
                return Ok(solution);
            }
            let mut correction = self.factor.solve(&residual);
            orthogonalize(&mut correction, &self.rigid, self.system);
            let image = self.system.apply_stiffness(&correction);
            // The step with the smallest residual, so that the iteration cannot diverge.
            let step = dot(&residual, &image) / dot(&image, &image);
            subtract(&mut solution, -step, &correction);
            subtract(&mut residual, step, &image);
        }
        let given = dot(&residual, &residual).sqrt() / scale;
        Err(fault("modal derivatives", format!("expected a residual of at most {TOLERANCE:e}, got {given:.1e}")))
    }
}

/// Extends linear modes by their derivatives. The result has at most N (N + 1) / 2 more vectors than the N modes; all are mass-orthonormal, diagonalize
/// the stiffness, and ascend. `rigid` and `shift` are those of [`crate::eigensolver::find_elastic_modes`].
///
/// # Errors
/// `Fault` if a derivative has no solution.
pub fn extend_by_derivatives(
    system: &SystemMatrices,
    rigid: &[Vec<f64>],
    shift: f64,
    modes: &mut ElasticModes,
    second_derivative: &SecondDerivative<'_>,
    progress: &dyn Fn(f64),
) -> Result<()> {
    let count = modes.vectors.len();
    let mut solver = StaticSolver { system, factor: Factor::new(system, shift)?, rigid: Vec::new() };
    for motion in rigid {
        let mut motion = motion.clone();
        orthonormalize(&mut motion, &solver.rigid, system);
        solver.rigid.push(motion);
    }
    let mut derivatives = Vec::new();
    for i in 0..count {
        for j in i..count {
            let mut load = second_derivative(&modes.vectors[i], &modes.vectors[j]);
            let weight = modes.eigenvalues[0].powi(2) / (modes.eigenvalues[i] * modes.eigenvalues[j]);
            load.iter_mut().for_each(|entry| *entry *= -weight);
            let mut derivative = solver.solve(load)?;
            // Twice, because the first pass leaves rounding errors of the parts that it removes.
            orthogonalize(&mut derivative, &modes.vectors, system);
            orthogonalize(&mut derivative, &modes.vectors, system);
            derivatives.push(derivative);
        }
        progress((i + 1) as f64 / count as f64);
    }
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for mut component in principal_components(system, &derivatives)? {
        let known = [&modes.vectors[..], &basis[..]].concat();
        orthonormalize(&mut component, &known, system);
        basis.push(component);
    }
    let images: Vec<Vec<f64>> = basis.iter().map(|vector| system.apply_stiffness(vector)).collect();
    let stiffness = products(&basis, &images);
    let (_, directions) = decompose(stiffness.as_ref())?;
    for direction in directions {
        let mut vector = combine(&basis, &direction);
        orthonormalize(&mut vector, &modes.vectors, system);
        make_largest_entry_positive(&mut vector);
        modes.eigenvalues.push(dot(&vector, &system.apply_stiffness(&vector)));
        modes.vectors.push(vector);
    }
    Ok(())
}

/// The directions of a set of vectors with the largest mass norms, largest first, without those below [`MIN_COMPONENT`].
fn principal_components(system: &SystemMatrices, vectors: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
    let images: Vec<Vec<f64>> = vectors.iter().map(|vector| system.apply_mass(vector)).collect();
    let (squares, directions) = decompose(products(vectors, &images).as_ref())?;
    let largest = squares.last().copied().unwrap_or_default();
    let pairs = squares.iter().zip(&directions).rev();
    let significant = pairs.filter(|(square, _)| **square > MIN_COMPONENT * MIN_COMPONENT * largest);
    Ok(significant.map(|(_, direction)| combine(vectors, direction)).collect())
}

/// The dot products of each vector with each image.
fn products(vectors: &[Vec<f64>], images: &[Vec<f64>]) -> Mat<f64> {
    Mat::from_fn(vectors.len(), vectors.len(), |row, column| dot(&vectors[row], &images[column]))
}

/// Eigenvalues of a symmetric matrix, ascending, and their eigenvectors.
fn decompose(matrix: MatRef<'_, f64>) -> Result<(Vec<f64>, Vec<Vec<f64>>)> {
    let decomposition = matrix.self_adjoint_eigen(Side::Lower);
    let decomposition = decomposition.map_err(|error| fault("modal derivatives", format!("{error:?}")))?;
    let size = matrix.nrows();
    let vector = |column: usize| decomposition.U().col(column).iter().copied().collect();
    Ok(((0..size).map(|index| decomposition.S()[index]).collect(), (0..size).map(vector).collect()))
}

/// The sum of vectors with weights.
pub(crate) fn combine(vectors: &[Vec<f64>], weights: &[f64]) -> Vec<f64> {
    let mut sum = vec![0.0; vectors.first().map_or(0, Vec::len)];
    for (vector, weight) in vectors.iter().zip(weights) {
        subtract(&mut sum, -weight, vector);
    }
    sum
}

/// Removes the components along mass-orthonormal vectors.
fn orthogonalize(vector: &mut [f64], others: &[Vec<f64>], system: &SystemMatrices) {
    let image = system.apply_mass(vector);
    for other in others {
        subtract(vector, dot(other, &image), other);
    }
}

/// Makes a vector mass-orthonormal to others.
fn orthonormalize(vector: &mut [f64], others: &[Vec<f64>], system: &SystemMatrices) {
    for _ in 0..2 {
        orthogonalize(vector, others, system);
        let scale = dot(vector, &system.apply_mass(vector)).sqrt().recip();
        vector.iter_mut().for_each(|entry| *entry *= scale);
    }
}

/// `vector -= share * other`.
fn subtract(vector: &mut [f64], share: f64, other: &[f64]) {
    vector.iter_mut().zip(other).for_each(|(entry, component)| *entry -= share * component);
}
