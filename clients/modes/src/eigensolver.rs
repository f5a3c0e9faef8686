//! The lowest elastic modes of K x = lambda M x, by shift-invert with a sparse Cholesky factorization and a block Krylov
//! method (Golub, Underwood 1977) with full orthogonalization.
//!
//! The factorization, products, QR and dense eigenproblems are those of the library faer. Its own Krylov-Schur solver is
//! not used: its loop of reorthogonalization does not end where the rounding of a dot product exceeds its limit, which
//! happens for a sphere of 25,000 freedoms.
//!
//! With K + s M = L L^T for a small shift s > 0, the operator L^-1 M L^-T has the eigenvalues 1 / (lambda + s). The shift
//! makes the matrix of a free body definite. Rigid motions are known and projected out. A block Krylov method can miss
//! copies of eigenvalues with more copies than the block has vectors, so it runs again with the modes that were found
//! projected out, until it finds only higher ones.

use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::cholesky::llt::factor::LltRegularization;
use faer::linalg::matmul::matmul;
use faer::sparse::linalg::SupernodalThreshold;
use faer::sparse::linalg::cholesky::supernodal::SupernodalLltRef;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering, factorize_symbolic_cholesky,
};
use faer::{Accum, Conj, Mat, MatMut, MatRef, Par, Side};
use modalcast_model::error::{Result, fault, fault_in};

use crate::assembly::{SystemMatrices, dot};

/// Elastic modes, ascending. Vectors are mass-normalized: x^T M x = 1.
#[derive(Debug, Default)]
pub struct ElasticModes {
    /// (rad/s)^2.
    pub eigenvalues: Vec<f64>,
    /// One vector of all freedoms per mode.
    pub vectors: Vec<Vec<f64>>,
    /// |K x - lambda M x| / |lambda M x| of each mode.
    pub residuals: Vec<f64>,
}

impl ElasticModes {
    /// Keeps the first modes.
    pub fn truncate(&mut self, count: usize) {
        self.eigenvalues.truncate(count);
        self.vectors.truncate(count);
        self.residuals.truncate(count);
    }
}

/// Limit on the residual of a converged mode, relative to the largest eigenvalue of the operator.
const TOLERANCE: f64 = 1e-8;
/// Vectors of a block.
const BLOCK: usize = 8;
/// Limit on the blocks of a run, beyond twice the number of modes.
const EXTRA_BLOCKS: usize = 40;
/// Modes that are computed beyond the requested ones, so that the last cluster is complete.
const EXTRA_MODES: usize = 2;
/// Modes of a run that looks for missed copies.
const CHECKED_MODES: usize = 4;
/// Limit on the runs that look for missed copies.
const MAX_CHECKS: usize = 8;
/// The smallest eigenvalue of an elastic mode, relative to the shift.
const MIN_EIGENVALUE: f64 = 1e-6;
/// Eigenvalues that differ by less, relative to their size, form a cluster.
const CLUSTER_GAP: f64 = 1e-6;

/// Finds the `count` lowest elastic modes. `rigid` contains the rigid motions, and `shift` is a small eigenvalue,
/// (rad/s)^2. `progress` receives the share of the work that is done, 0 to 1.
///
/// # Errors
/// `Fault` if the factorization fails or the method does not converge.
pub fn find_elastic_modes(
    system: &SystemMatrices,
    rigid: &[Vec<f64>],
    shift: f64,
    count: usize,
    progress: &dyn Fn(f64, &str),
) -> Result<ElasticModes> {
    progress(0.0, "factorization");
    let factor = Factor::new(system, shift)?;
    progress(0.5, "eigenvalues");
    let mut operator = ShiftInvert { system, factor: &factor, deflated: Vec::new() };
    for motion in rigid {
        // K r = 0, so that L^T r = L^-1 (K + s M) r = s L^-1 M r.
        let mut vector = factor.permuted(&system.apply_mass(motion));
        factor.solve_lower(as_columns(&mut vector, 1));
        operator.deflate(vector);
    }
    let wanted = count + EXTRA_MODES;
    let mut vectors = operator.largest(wanted, 0, None)?;
    let scale = vectors.first().map(|(value, _)| *value);
    for check in 1..=MAX_CHECKS {
        progress(0.5 + 0.4 * check as f64 / (check + 1) as f64, "check for repeated eigenvalues");
        let rigid_count = operator.deflated.len();
        vectors.iter().for_each(|(_, vector)| operator.deflate(vector.clone()));
        let found = operator.largest(CHECKED_MODES, check as u64, scale)?;
        operator.deflated.truncate(rigid_count);
        let limit = vectors[vectors.len().min(wanted) - 1].0;
        let missed: Vec<(f64, Vec<f64>)> =
            found.into_iter().filter(|(value, _)| *value > limit * (1.0 + 1e-6)).collect();
        if missed.is_empty() {
            break;
        }
        if check == MAX_CHECKS {
            return Err(fault("eigensolver", format!("{} modes were missed by {MAX_CHECKS} runs", missed.len())));
        }
        vectors.extend(missed);
        vectors.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        vectors.truncate(wanted);
    }
    progress(0.95, "mode shapes");
    let shapes = vectors.into_iter().map(|(_, mut vector)| {
        factor.solve_upper(as_columns(&mut vector, 1));
        factor.unpermuted(&vector)
    });
    let modes = normalize(system, shapes.collect(), count);
    // A part that only fill connects to another moves almost without stiffness, and rounding can make it negative.
    let is_elastic = |eigenvalue: &&f64| **eigenvalue > MIN_EIGENVALUE * shift;
    match modes.eigenvalues.iter().find(|eigenvalue| !is_elastic(eigenvalue)) {
        None => Ok(modes),
        Some(eigenvalue) => {
            let reason = format!(
                "a mode has the eigenvalue {eigenvalue:.3e}, which is too small for an elastic body. Parts may be \
                 connected by less than a cell, or a clamp may hold a part at a single point; more --freedoms help"
            );
            Err(fault("eigensolver", reason))
        }
    }
}

/// Mass-normalizes the vectors, computes eigenvalues by Rayleigh quotients, and makes signs and bases unique.
fn normalize(system: &SystemMatrices, shapes: Vec<Vec<f64>>, count: usize) -> ElasticModes {
    let mut modes: Vec<(f64, Vec<f64>)> = shapes
        .into_iter()
        .map(|mut shape| {
            let scale = dot(&shape, &system.apply_mass(&shape)).sqrt().recip();
            shape.iter_mut().for_each(|entry| *entry *= scale);
            (dot(&shape, &system.apply_stiffness(&shape)), shape)
        })
        .collect();
    modes.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    let mut start = 0;
    while start < modes.len() {
        let mut stop = start + 1;
        while stop < modes.len() && modes[stop].0 - modes[stop - 1].0 < CLUSTER_GAP * modes[stop].0 {
            stop += 1;
        }
        choose_basis(&mut modes[start..stop]);
        start = stop;
    }
    // The basis of a cluster has other Rayleigh quotients.
    for (eigenvalue, shape) in &mut modes {
        *eigenvalue = dot(shape, &system.apply_stiffness(shape));
    }
    modes.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    modes.truncate(count);
    let mut result = ElasticModes::default();
    for (_, shape) in modes {
        let [stiffness, mass] = [system.apply_stiffness(&shape), system.apply_mass(&shape)];
        let eigenvalue = dot(&shape, &stiffness);
        let difference = stiffness.iter().zip(&mass).map(|(k, m)| (k - eigenvalue * m).powi(2)).sum::<f64>().sqrt();
        result.residuals.push(difference / (eigenvalue * dot(&mass, &mass).sqrt()));
        result.eigenvalues.push(eigenvalue);
        result.vectors.push(shape);
    }
    result
}

/// Replaces the vectors of a cluster by a unique basis of the same space: by pivoted Gram-Schmidt, vector k is the only
/// one from k on that moves at freedom k of a sequence of freedoms with the largest motion. The largest entry of each
/// vector is positive.
fn choose_basis(cluster: &mut [(f64, Vec<f64>)]) {
    let freedoms = cluster[0].1.len();
    let size = cluster.len();
    let mut directions: Vec<Vec<f64>> = Vec::new();
    while size > 1 && directions.len() < size {
        let remainder = |freedom: usize| {
            let mut row: Vec<f64> = cluster.iter().map(|(_, vector)| vector[freedom]).collect();
            for direction in &directions {
                let share = dot(&row, direction);
                row.iter_mut().zip(direction).for_each(|(entry, component)| *entry -= share * component);
            }
            row
        };
        let squared = |row: &[f64]| dot(row, row);
        let mut best = (0.0, 0);
        for freedom in 0..freedoms {
            let norm = squared(&remainder(freedom));
            if norm > best.0 {
                best = (norm, freedom);
            }
        }
        let mut direction = remainder(best.1);
        let scale = squared(&direction).sqrt().recip();
        direction.iter_mut().for_each(|entry| *entry *= scale);
        directions.push(direction);
    }
    if size > 1 {
        let combine = |direction: &Vec<f64>| -> Vec<f64> {
            let mut sum = vec![0.0; freedoms];
            for ((_, vector), weight) in cluster.iter().zip(direction) {
                sum.iter_mut().zip(vector).for_each(|(sum, entry)| *sum += weight * entry);
            }
            sum
        };
        let combined: Vec<Vec<f64>> = directions.iter().map(combine).collect();
        cluster.iter_mut().zip(combined).for_each(|((_, vector), combined)| *vector = combined);
    }
    cluster.iter_mut().for_each(|(_, vector)| make_largest_entry_positive(vector));
}

/// Makes the sign of a mode unique.
pub(crate) fn make_largest_entry_positive(vector: &mut [f64]) {
    let larger = |largest: f64, entry: &f64| if entry.abs() > largest.abs() { *entry } else { largest };
    if vector.iter().fold(0.0, larger) < 0.0 {
        vector.iter_mut().for_each(|entry| *entry = -*entry);
    }
}

/// The Cholesky factor of K + s M.
pub(crate) struct Factor {
    symbolic: SymbolicCholesky<usize>,
    values: Vec<f64>,
}

impl Factor {
    pub(crate) fn new(system: &SystemMatrices, shift: f64) -> Result<Self> {
        let matrix = system.shifted_stiffness(shift);
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SUPERNODAL,
            ..Default::default()
        };
        let symbolic = factorize_symbolic_cholesky(matrix.symbolic(), Side::Lower, SymmetricOrdering::Amd, params);
        let symbolic = symbolic.map_err(|error| fault("factorization", format!("{error:?}")))?;
        let mut values = Vec::new();
        values.try_reserve_exact(symbolic.len_val()).map_err(fault_in("factorization"))?;
        values.resize(symbolic.len_val(), 0.0);
        // One thread, so that the result does not depend on the number of threads.
        let scratch = symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
        let mut memory = MemBuffer::try_new(scratch).map_err(|error| fault("factorization", format!("{error:?}")))?;
        let stack = MemStack::new(&mut memory);
        symbolic
            .factorize_numeric_llt(
                &mut values,
                matrix.as_ref(),
                Side::Lower,
                LltRegularization::default(),
                Par::Seq,
                stack,
                Default::default(),
            )
            .map_err(|error| fault("factorization", format!("the stiffness is not positive definite ({error:?})")))?;
        Ok(Self { symbolic, values })
    }

    fn lower(&self) -> Option<SupernodalLltRef<'_, usize, f64>> {
        match self.symbolic.raw() {
            SymbolicCholeskyRaw::Supernodal(symbolic) => Some(SupernodalLltRef::new(symbolic, &self.values)),
            SymbolicCholeskyRaw::Simplicial(_) => None,
        }
    }

    /// (K + s M)^-1 b.
    pub(crate) fn solve(&self, load: &[f64]) -> Vec<f64> {
        let mut vector = self.permuted(load);
        self.solve_lower(as_columns(&mut vector, 1));
        self.solve_upper(as_columns(&mut vector, 1));
        self.unpermuted(&vector)
    }

    fn solve_scratch(&self, columns: usize) -> StackReq {
        self.symbolic.solve_in_place_scratch::<f64>(columns, Par::Seq)
    }

    /// Replaces each column b by L^-1 b, in the order of the factor.
    fn solve_lower(&self, vector: MatMut<'_, f64>) {
        let mut memory = MemBuffer::new(self.solve_scratch(vector.ncols()));
        if let Some(lower) = self.lower() {
            lower.l_solve_with_conj(Conj::No, vector, Par::Seq, MemStack::new(&mut memory));
        }
    }

    /// Replaces each column b by L^-T b, in the order of the factor.
    fn solve_upper(&self, vector: MatMut<'_, f64>) {
        let mut memory = MemBuffer::new(self.solve_scratch(vector.ncols()));
        if let Some(lower) = self.lower() {
            lower.l_transpose_solve_with_conj(Conj::No, vector, Par::Seq, MemStack::new(&mut memory));
        }
    }

    /// A vector in the order of the factor.
    fn permuted(&self, vector: &[f64]) -> Vec<f64> {
        match self.symbolic.perm() {
            Some(order) => order.arrays().0.iter().map(|index| vector[*index]).collect(),
            None => vector.to_vec(),
        }
    }

    /// A vector in the original order.
    fn unpermuted(&self, vector: &[f64]) -> Vec<f64> {
        match self.symbolic.perm() {
            Some(order) => order.arrays().1.iter().map(|index| vector[*index]).collect(),
            None => vector.to_vec(),
        }
    }
}

/// The operator L^-1 M L^-T without the deflated vectors.
struct ShiftInvert<'a> {
    system: &'a SystemMatrices,
    factor: &'a Factor,
    /// Orthonormal vectors in the order of the factor.
    deflated: Vec<Vec<f64>>,
}

impl ShiftInvert<'_> {
    /// Orthonormalizes a vector against the deflated ones and adds it.
    fn deflate(&mut self, mut vector: Vec<f64>) {
        self.project(&mut vector);
        self.project(&mut vector);
        let scale = dot(&vector, &vector).sqrt().recip();
        vector.iter_mut().for_each(|entry| *entry *= scale);
        self.deflated.push(vector);
    }

    /// Removes the components along the deflated vectors.
    fn project(&self, vector: &mut [f64]) {
        for deflated in &self.deflated {
            let share = dot(vector, deflated);
            vector.iter_mut().zip(deflated).for_each(|(entry, component)| *entry -= share * component);
        }
    }

    /// Replaces each of the columns by its product with the operator.
    fn apply(&self, columns: &mut [f64]) {
        let freedoms = self.system.freedoms();
        let count = columns.len() / freedoms;
        columns.chunks_exact_mut(freedoms).for_each(|column| self.project(column));
        self.factor.solve_upper(as_columns(columns, count));
        for column in columns.chunks_exact_mut(freedoms) {
            let product = self.system.apply_mass(&self.factor.unpermuted(column));
            column.copy_from_slice(&self.factor.permuted(&product));
        }
        self.factor.solve_lower(as_columns(columns, count));
        columns.chunks_exact_mut(freedoms).for_each(|column| self.project(column));
    }

    /// The largest eigenvalues, descending, with their vectors. The limit on the residuals is relative to `scale`, or to the
    /// largest eigenvalue.
    ///
    /// # Errors
    /// `Fault` if the residuals do not fall below the limit.
    fn largest(&self, count: usize, seed: u64, scale: Option<f64>) -> Result<Vec<(f64, Vec<f64>)>> {
        let freedoms = self.system.freedoms();
        let dimension = freedoms - self.deflated.len();
        let count = count.min(dimension);
        let limit = dimension.min(2 * count + EXTRA_BLOCKS * BLOCK);
        let mut random = fastrand::Rng::with_seed(seed);
        let mut block: Vec<f64> = (0..freedoms * BLOCK.min(dimension)).map(|_| random.f64() - 0.5).collect();
        // Orthonormal columns, and their products with the operator.
        let (mut basis, mut images) = (Vec::new(), Vec::new());
        loop {
            let columns = basis.len() / freedoms;
            block.truncate(freedoms * (limit - columns).min(BLOCK));
            self.orthonormalize(&mut block, &basis)?;
            basis.extend_from_slice(&block);
            self.apply(&mut block);
            images.extend_from_slice(&block);
            let columns = basis.len() / freedoms;
            if columns < count {
                continue;
            }
            let ritz = RitzPairs::new(&basis, &images, freedoms, count)?;
            let scale = scale.unwrap_or(ritz.values[0]);
            if columns == dimension || ritz.has_converged(scale) {
                return Ok(ritz.into_pairs());
            }
            if columns == limit {
                let worst = ritz.residuals.iter().copied().fold(0.0, f64::max) / scale;
                let reason = format!(
                    "{count} modes did not converge: expected residuals below {TOLERANCE:e}, got {worst:.1e}. Fewer --modes \
                     or more --freedoms help"
                );
                return Err(fault("eigensolver", reason));
            }
        }
    }

    /// Orthonormalizes the columns of a block against the deflated vectors, the basis and each other. A column that
    /// depends on the others becomes an arbitrary direction.
    fn orthonormalize(&self, block: &mut [f64], basis: &[f64]) -> Result<()> {
        let freedoms = self.system.freedoms();
        let count = block.len() / freedoms;
        let basis = MatRef::from_column_major_slice(basis, freedoms, basis.len() / freedoms);
        // The second pass removes what rounding leaves of dependent columns.
        for _ in 0..3 {
            block.chunks_exact_mut(freedoms).for_each(|column| self.project(column));
            let mut columns = as_columns(block, count);
            let mut shares = Mat::zeros(basis.ncols(), count);
            matmul(shares.as_mut(), Accum::Replace, basis.transpose(), columns.as_ref(), 1.0, Par::Seq);
            matmul(columns.as_mut(), Accum::Add, basis, shares.as_ref(), -1.0, Par::Seq);
            let orthonormal = columns.as_ref().qr().compute_thin_Q();
            columns.copy_from(&orthonormal);
        }
        match block.iter().all(|entry| entry.is_finite()) {
            true => Ok(()),
            false => Err(fault("eigensolver", "a vector is not finite")),
        }
    }
}

/// Approximate eigenpairs from a basis (Rayleigh-Ritz).
struct RitzPairs {
    /// Descending.
    values: Vec<f64>,
    vectors: Mat<f64>,
    /// Norms of the residuals S y - theta y.
    residuals: Vec<f64>,
}

impl RitzPairs {
    fn new(basis: &[f64], images: &[f64], freedoms: usize, count: usize) -> Result<Self> {
        let columns = basis.len() / freedoms;
        let basis = MatRef::from_column_major_slice(basis, freedoms, columns);
        let images = MatRef::from_column_major_slice(images, freedoms, columns);
        let mut projected = Mat::zeros(columns, columns);
        matmul(projected.as_mut(), Accum::Replace, basis.transpose(), images, 1.0, Par::Seq);
        // Entries of about 1: the dense eigensolver loses accuracy for entries below 1e-12.
        let scale = (0..columns).map(|index| projected[(index, index)].abs()).fold(f64::MIN_POSITIVE, f64::max);
        let symmetric =
            Mat::from_fn(columns, columns, |i, j| f64::midpoint(projected[(i, j)], projected[(j, i)]) / scale);
        let decomposition = symmetric.self_adjoint_eigen(Side::Lower);
        let decomposition = decomposition.map_err(|error| fault("eigensolver", format!("{error:?}")))?;
        let (values, coefficients) = (decomposition.S(), decomposition.U());
        // Eigenvalues ascend.
        let chosen = Mat::from_fn(columns, count, |row, index| coefficients[(row, columns - 1 - index)]);
        let values: Vec<f64> = (0..count).map(|index| scale * values[columns - 1 - index]).collect();
        let mut vectors = Mat::zeros(freedoms, count);
        matmul(vectors.as_mut(), Accum::Replace, basis, chosen.as_ref(), 1.0, Par::Seq);
        let mut differences = Mat::zeros(freedoms, count);
        matmul(differences.as_mut(), Accum::Replace, images, chosen.as_ref(), 1.0, Par::Seq);
        let residual = |index: usize| {
            let pairs = differences.col(index).iter().zip(vectors.col(index).iter());
            pairs.map(|(image, vector)| (image - values[index] * vector).powi(2)).sum::<f64>().sqrt()
        };
        let residuals = (0..count).map(residual).collect();
        Ok(Self { values, vectors, residuals })
    }

    fn has_converged(&self, scale: f64) -> bool {
        self.residuals.iter().all(|residual| *residual <= TOLERANCE * scale)
    }

    fn into_pairs(self) -> Vec<(f64, Vec<f64>)> {
        let column = |index: usize| self.vectors.col(index).iter().copied().collect();
        self.values.iter().enumerate().map(|(index, value)| (*value, column(index))).collect()
    }
}

/// Vectors, one after the other, as the columns of a matrix.
fn as_columns(vectors: &mut [f64], count: usize) -> MatMut<'_, f64> {
    let rows = vectors.len() / count;
    MatMut::from_column_major_slice_mut(vectors, rows, count)
}
