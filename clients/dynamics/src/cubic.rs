//! Reduced StVK (Saint Venant-Kirchhoff) forces of r coordinates, read from a `.cub` file of the FEM library Vega. The
//! force f(q) is a polynomial of degree three without a constant term. This module also computes its Jacobian and
//! potential.
//!
//! File format: four little-endian i32 (r, then the numbers of monomials of degree one, two and three: r, r(r+1)/2 and
//! r(r+1)(r+2)/6), followed by one f64 matrix per degree. A matrix is row-major, with one row per force component and
//! one column per monomial. The monomials q_i q_j (i <= j) and q_i q_j q_k (i <= j <= k) are in lexicographic order.

use std::path::Path;

use modalcast_client::Error as ClientError;
use nalgebra::{DMatrix, DVector};

use crate::error::{Result, invalid_input};

/// Size of the header of a file: four i32.
const HEADER_BYTES: usize = 16;

/// Largest difference of two coefficients that should be equal, as a fraction of the largest coefficient of their
/// degree. Vega's files have differences below 1e-10.
const GRADIENT_TOLERANCE: f64 = 1e-6;

/// Coefficients of a polynomial force, which is the gradient of a quartic potential.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedForce {
    rank: usize,
    /// r x r: the stiffness at rest.
    linear_block: DMatrix<f64>,
    /// Row-major: one row per force component, one column per monomial of degree two.
    quadratic_block: Vec<f64>,
    /// Row-major: one row per force component, one column per monomial of degree three.
    cubic_block: Vec<f64>,
}

impl ReducedForce {
    /// Creates a force from its blocks, row-major matrices with one row per force component.
    ///
    /// # Errors
    /// `Invalid` if r is not 1 to 512, a block has the wrong length, an entry is not finite, or the force is not the
    /// gradient of a potential.
    pub fn new(rank: usize, linear: &[f64], quadratic: Vec<f64>, cubic: Vec<f64>) -> Result<Self> {
        let counts = monomial_counts(rank).ok_or_else(|| invalid_input("cub.r", "1 to 512", rank))?;
        for (field, length, count) in [
            ("cub.linear", linear.len(), counts[0]),
            ("cub.quadratic", quadratic.len(), counts[1]),
            ("cub.cubic", cubic.len(), counts[2]),
        ] {
            if length != rank * count {
                return Err(invalid_input(field, format!("{rank} x {count} numbers"), length));
            }
        }
        for (field, block) in [("cub.linear", linear), ("cub.quadratic", &quadratic), ("cub.cubic", &cubic)] {
            if let Some(index) = block.iter().position(|entry| !entry.is_finite()) {
                return Err(invalid_input(format!("{field}[{index}]"), "a finite number", block[index]));
            }
        }
        let linear_block = DMatrix::from_row_slice(rank, rank, linear);
        check_gradient("cub.linear", rank, 1, linear)?;
        check_gradient("cub.quadratic", rank, 2, &quadratic)?;
        check_gradient("cub.cubic", rank, 3, &cubic)?;
        Ok(Self { rank, linear_block, quadratic_block: quadratic, cubic_block: cubic })
    }

    /// Reads a file.
    ///
    /// # Errors
    /// `Client` if it cannot be read; `Invalid` as for [`Self::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&std::fs::read(path).map_err(|error| ClientError::file(path, error))?)
    }

    /// Parses the bytes of a file.
    ///
    /// # Errors
    /// `Invalid` if the counts do not match r, the size does not match the counts, or as for [`Self::new`].
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let Some((header, body)) = bytes.split_at_checked(HEADER_BYTES) else {
            return Err(invalid_input("cub.size", "at least 16 bytes", bytes.len()));
        };
        let (words, _) = header.as_chunks();
        let [rank_word, count_words @ ..]: [i32; 4] = std::array::from_fn(|index| i32::from_le_bytes(words[index]));
        let rank = usize::try_from(rank_word).ok();
        let Some((rank, counts)) = rank.and_then(|rank| Some((rank, monomial_counts(rank)?))) else {
            return Err(invalid_input("cub.r", "1 to 512", rank_word));
        };
        let fields = ["cub.linear", "cub.quadratic", "cub.cubic"];
        for ((field, count), word) in fields.into_iter().zip(counts).zip(count_words) {
            if usize::try_from(word) != Ok(count) {
                return Err(invalid_input(field, format!("{count} monomials for r = {rank}"), word));
            }
        }
        // With r at most 512, the size is below 2^37 bytes and cannot overflow.
        let body_bytes = 8 * rank * counts.iter().sum::<usize>();
        if body.len() != body_bytes {
            return Err(invalid_input("cub.size", format!("{} bytes", HEADER_BYTES + body_bytes), bytes.len()));
        }
        let mut coefficients = body.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes));
        let mut read_block = |count: usize| coefficients.by_ref().take(rank * count).collect::<Vec<_>>();
        let (linear, quadratic, cubic) = (read_block(counts[0]), read_block(counts[1]), read_block(counts[2]));
        Self::new(rank, &linear, quadratic, cubic)
    }

    /// The number of coordinates r.
    pub const fn rank(&self) -> usize {
        self.rank
    }

    /// The stiffness at rest, r x r.
    pub const fn rest_stiffness(&self) -> &DMatrix<f64> {
        &self.linear_block
    }

    /// The force f(q), r entries.
    pub fn force(&self, q: &DVector<f64>) -> DVector<f64> {
        let [linear_term, quadratic_term, cubic_term] = self.force_terms(q);
        linear_term + quadratic_term + cubic_term
    }

    /// The potential V(q), whose gradient is f. By Euler's theorem on homogeneous functions, the term f_d of degree d
    /// has the potential q . f_d / (d + 1).
    pub fn potential(&self, q: &DVector<f64>) -> f64 {
        let [linear_term, quadratic_term, cubic_term] = self.force_terms(q);
        q.dot(&linear_term) / 2.0 + q.dot(&quadratic_term) / 3.0 + q.dot(&cubic_term) / 4.0
    }

    /// The Jacobian df/dq, r x r.
    pub fn jacobian(&self, q: &DVector<f64>) -> DMatrix<f64> {
        let mut matrix = self.linear_block.clone();
        let [_, quadratic_count, cubic_count] = monomial_counts(self.rank).unwrap_or_default();
        for row in 0..self.rank {
            let mut quadratic_entries = self.quadratic_block[row * quadratic_count..][..quadratic_count].iter();
            let mut cubic_entries = self.cubic_block[row * cubic_count..][..cubic_count].iter();
            for i in 0..self.rank {
                for (j, entry) in (i..self.rank).zip(&mut quadratic_entries) {
                    matrix[(row, i)] += entry * q[j];
                    matrix[(row, j)] += entry * q[i];
                }
            }
            for i in 0..self.rank {
                for j in i..self.rank {
                    let product = q[i] * q[j];
                    for (k, entry) in (j..self.rank).zip(&mut cubic_entries) {
                        matrix[(row, i)] += entry * q[j] * q[k];
                        matrix[(row, j)] += entry * q[i] * q[k];
                        matrix[(row, k)] += entry * product;
                    }
                }
            }
        }
        matrix
    }

    /// The terms of the force of degree one, two and three.
    fn force_terms(&self, q: &DVector<f64>) -> [DVector<f64>; 3] {
        let mut quadratic_monomials = Vec::with_capacity(self.rank * (self.rank + 1) / 2);
        let mut cubic_monomials = vec![];
        for i in 0..self.rank {
            for j in i..self.rank {
                let product = q[i] * q[j];
                quadratic_monomials.push(product);
                cubic_monomials.extend((j..self.rank).map(|k| product * q[k]));
            }
        }
        let multiply_block = |block: &[f64], monomials: &[f64]| {
            let rows = block.chunks_exact(monomials.len().max(1));
            let dot = |row: &[f64]| row.iter().zip(monomials).map(|(a, b)| a * b).sum::<f64>();
            DVector::from_iterator(self.rank, rows.map(dot))
        };
        let quadratic_term = multiply_block(&self.quadratic_block, &quadratic_monomials);
        let cubic_term = multiply_block(&self.cubic_block, &cubic_monomials);
        [&self.linear_block * q, quadratic_term, cubic_term]
    }
}

/// Checks that a block of monomials of one degree is the gradient of a potential. Without a potential, the stiffness is
/// asymmetric and the motion can gain energy without limit.
///
/// A monomial v M of the potential appears in the force component of each coordinate q_a that M contains: the component
/// has the monomial M / q_a with the coefficient v times the exponent of q_a in M. For example, v q_0^2 q_1 gives
/// 2 v q_0 q_1 in component 0 and v q_0^2 in component 1.
fn check_gradient(field: &str, rank: usize, degree: usize, block: &[f64]) -> Result<()> {
    let monomials = list_monomials(rank, degree);
    let tolerance = GRADIENT_TOLERANCE * block.iter().fold(0.0, |largest: f64, entry| largest.max(entry.abs()));
    // The coefficient of the potential according to the force component of the coordinate at `position` in M.
    let potential_coefficient = |potential_monomial: &[usize], position: usize| {
        let component = potential_monomial[position];
        let mut monomial = potential_monomial.to_vec();
        monomial.remove(position);
        let exponent = potential_monomial.iter().filter(|index| **index == component).count() as f64;
        let column = monomials.binary_search(&monomial).unwrap_or_default();
        block[component * monomials.len() + column] / exponent
    };
    for monomial in &monomials {
        for component in 0..rank {
            let mut potential_monomial = monomial.clone();
            let position = potential_monomial.partition_point(|index| *index < component);
            potential_monomial.insert(position, component);
            let (expected, given) =
                (potential_coefficient(&potential_monomial, 0), potential_coefficient(&potential_monomial, position));
            if (expected - given).abs() > tolerance {
                let field = format!("{field}, component {component}, monomial {monomial:?}");
                let expected = format!(
                    "forces of a potential (its coefficient is {expected:e} by component {})",
                    potential_monomial[0]
                );
                return Err(invalid_input(field, expected, format!("{given:e}")));
            }
        }
    }
    Ok(())
}

/// The monomials of a degree in lexicographic order, each as its ascending coordinates.
fn list_monomials(rank: usize, degree: usize) -> Vec<Vec<usize>> {
    let mut monomials = vec![vec![]];
    for _ in 0..degree {
        let extend = |monomial: Vec<usize>| {
            let first = monomial.last().copied().unwrap_or(0);
            (first..rank).map(move |index| [&monomial[..], &[index]].concat())
        };
        monomials = monomials.into_iter().flat_map(extend).collect();
    }
    monomials
}

/// The numbers of monomials of degree one, two and three in r coordinates; `None` unless r is 1 to 512.
fn monomial_counts(rank: usize) -> Option<[usize; 3]> {
    let is_supported = (1..=512).contains(&rank);
    is_supported.then(|| [rank, rank * (rank + 1) / 2, rank * (rank + 1) * (rank + 2) / 6])
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Pseudorandom numbers from -1 to 1, the same for the same seed (Knuth's linear congruential generator MMIX).
    pub(crate) fn random_vector(seed: u64, count: usize) -> DVector<f64> {
        let mut state = seed;
        DVector::from_fn(count, |_, _| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        })
    }

    /// Springs with the given eigenvalues. Neighbors add the potentials a (q_i - q_{i+1})^4 and b q_i^2 q_{i+1} with
    /// a = `quartic_coefficient` and b = `cubic_coefficient`.
    pub(crate) fn spring_chain(eigenvalues: &[f64], quartic_coefficient: f64, cubic_coefficient: f64) -> ReducedForce {
        let rank = eigenvalues.len();
        let [_, quadratic_count, cubic_count] = monomial_counts(rank).expect("a supported rank");
        let linear = DMatrix::from_diagonal(&DVector::from_column_slice(eigenvalues));
        let mut quadratic_block = vec![0.0; rank * quadratic_count];
        let mut cubic_block = vec![0.0; rank * cubic_count];
        let (mut quadratic_monomials, mut cubic_monomials) = (vec![], vec![]);
        for i in 0..rank {
            for j in i..rank {
                quadratic_monomials.push([i, j]);
                cubic_monomials.extend((j..rank).map(|k| [i, j, k]));
            }
        }
        let quadratic_column =
            |i, j| quadratic_monomials.iter().position(|monomial| *monomial == [i, j]).expect("a monomial");
        let cubic_column =
            |i, j, k| cubic_monomials.iter().position(|monomial| *monomial == [i, j, k]).expect("a monomial");
        for i in 0..rank.saturating_sub(1) {
            let j = i + 1;
            quadratic_block[i * quadratic_count + quadratic_column(i, j)] += 2.0 * cubic_coefficient;
            quadratic_block[j * quadratic_count + quadratic_column(i, i)] += cubic_coefficient;
            // The force of the quartic potential is 4 (q_i - q_j)^3 on i, and its negative on j.
            for (row, coefficient) in [(i, 4.0 * quartic_coefficient), (j, -4.0 * quartic_coefficient)] {
                cubic_block[row * cubic_count + cubic_column(i, i, i)] += coefficient;
                cubic_block[row * cubic_count + cubic_column(i, i, j)] -= 3.0 * coefficient;
                cubic_block[row * cubic_count + cubic_column(i, j, j)] += 3.0 * coefficient;
                cubic_block[row * cubic_count + cubic_column(j, j, j)] -= coefficient;
            }
        }
        ReducedForce::new(rank, linear.as_slice(), quadratic_block, cubic_block).expect("a valid force")
    }

    /// The bytes of a `.cub` file.
    fn encode_file(force: &ReducedForce) -> Vec<u8> {
        let mut bytes = vec![];
        let [linear_count, quadratic_count, cubic_count] = monomial_counts(force.rank).expect("a supported rank");
        for count in [force.rank, linear_count, quadratic_count, cubic_count] {
            bytes.extend((count as i32).to_le_bytes());
        }
        // nalgebra stores columns, so the slice of the transpose has the rows of the block.
        let linear = force.linear_block.transpose();
        let blocks = linear.as_slice().iter().chain(&force.quadratic_block).chain(&force.cubic_block);
        blocks.for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes
    }

    /// Errors of a Jacobian, relative to its largest entry.
    struct JacobianErrors {
        /// Largest difference from central differences of the force.
        difference: f64,
        /// Largest difference from the transpose of the Jacobian; above 0 if the force is not a gradient.
        asymmetry: f64,
    }

    fn jacobian_errors(force: &ReducedForce, q: &DVector<f64>) -> JacobianErrors {
        let jacobian = force.jacobian(q);
        let step = 1e-5 * q.abs().max();
        let mut central_differences = DMatrix::zeros(force.rank(), force.rank());
        for column in 0..force.rank() {
            let (mut upper, mut lower) = (q.clone(), q.clone());
            upper[column] += step;
            lower[column] -= step;
            central_differences.set_column(column, &((force.force(&upper) - force.force(&lower)) / (2.0 * step)));
        }
        let scale = jacobian.abs().max();
        let difference = (&jacobian - central_differences).abs().max() / scale;
        JacobianErrors { difference, asymmetry: (&jacobian - jacobian.transpose()).abs().max() / scale }
    }

    #[test]
    fn file_round_trips_and_derivatives_agree() {
        let force = spring_chain(&[3.0, 5.0, 11.0, 400.0], 0.7, 0.4);
        assert_eq!(ReducedForce::parse(&encode_file(&force)).expect("a valid file"), force);
        for seed in 0..8 {
            let q = random_vector(seed, 4);
            let JacobianErrors { difference, asymmetry } = jacobian_errors(&force, &q);
            assert!(difference <= 1e-8 && asymmetry <= 1e-14, "difference {difference}, asymmetry {asymmetry}");
            // By the chain rule, the derivative of V(s q) with respect to s at s = 1 is q . f(q).
            let slope = (force.potential(&(&q * (1.0 + 1e-6))) - force.potential(&(&q * (1.0 - 1e-6)))) / 2e-6;
            assert!((slope - q.dot(&force.force(&q))).abs() <= 1e-6 * slope.abs().max(1.0), "{slope}");
        }
        assert_eq!(force.force(&DVector::zeros(4)), DVector::zeros(4));
    }

    /// Each change breaks one equality: of the linear block, of the quadratic block (q_0 q_1 in component 0 and q_0 q_0
    /// in component 1), and of the cubic block (q_0 q_0 q_1 in component 0 and q_0 q_0 q_0 in component 1).
    #[test]
    fn forces_without_a_potential_are_rejected() {
        let force = spring_chain(&[3.0, 5.0, 11.0, 400.0], 0.7, 0.4);
        let parse = |force: &ReducedForce| ReducedForce::parse(&encode_file(force));
        let (mut linear, mut quadratic, mut cubic) = (force.clone(), force.clone(), force.clone());
        linear.linear_block[(0, 2)] += 1.0;
        quadratic.quadratic_block[1] += 1.0;
        cubic.cubic_block[1] += 1.0;
        for (invalid_force, field) in [(linear, "cub.linear"), (quadratic, "cub.quadratic"), (cubic, "cub.cubic")] {
            let asymmetry = jacobian_errors(&invalid_force, &random_vector(1, 4)).asymmetry;
            assert!(asymmetry > 1e-5, "expected an asymmetric Jacobian, got the asymmetry {asymmetry}");
            let error = parse(&invalid_force).expect_err("a force without potential").to_string();
            assert!(error.starts_with(field) && error.contains("forces of a potential"), "{error}");
        }
        // Rounding errors of an exporter.
        let mut rounded = force;
        rounded.cubic_block[1] += 1e-9;
        parse(&rounded).expect("a valid file");
    }

    #[test]
    fn truncated_oversized_and_invalid_files_are_rejected() {
        let valid_file = encode_file(&spring_chain(&[1.0, 2.0], 0.1, 0.1));
        // The header has r = 2 in bytes 0 to 3, then the three counts in bytes 4 to 7, 8 to 11 and 12 to 15.
        let replace_byte = |index: usize, byte: u8| {
            let mut bytes = valid_file.clone();
            bytes[index] = byte;
            bytes
        };
        let mut infinite_coefficient = valid_file.clone();
        infinite_coefficient[16..24].copy_from_slice(&f64::INFINITY.to_le_bytes());
        for (bytes, field) in [
            (vec![], "cub.size"),
            (valid_file[..15].to_vec(), "cub.size"),
            (valid_file[..valid_file.len() - 1].to_vec(), "cub.size"),
            ([valid_file.clone(), vec![0]].concat(), "cub.size"),
            // A negative r, an r above 512, r = 0, and an r that contradicts the counts.
            (replace_byte(3, 0xff), "cub.r"),
            (replace_byte(1, 0xff), "cub.r"),
            (replace_byte(0, 0), "cub.r"),
            (replace_byte(0, 3), "cub.linear"),
            (replace_byte(8, 9), "cub.quadratic"),
            (replace_byte(12, 9), "cub.cubic"),
            (infinite_coefficient, "cub.linear[0]"),
        ] {
            let error = ReducedForce::parse(&bytes).expect_err("an invalid file").to_string();
            assert!(error.starts_with(field), "expected an error of {field}, got: {error}");
        }
    }

    /// The folder of real input data.
    pub(crate) fn data_folder() -> std::path::PathBuf {
        let default_folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
        std::env::var_os("MODALCAST_DATA").map_or_else(|| default_folder.into(), Into::into)
    }

    /// Inputs that the fuzzer keeps: its corpus, and inputs that once caused a crash.
    #[test]
    fn kept_inputs_of_the_fuzzer_do_not_panic() {
        let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/fuzz");
        let list = |kind: &str| std::fs::read_dir(fuzz.join(kind).join("cub")).into_iter().flatten();
        for file in list("corpus").chain(list("crashes")) {
            let path = file.expect("a readable folder").path();
            eprintln!("{}", path.display());
            ReducedForce::parse(&std::fs::read(path).expect("a readable file")).ok();
        }
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_forces_are_gradients_and_vanish_at_rest() {
        for name in ["simpleBridge", "A"] {
            let path = data_folder().join(format!("vega/{name}/{name}.cub"));
            let force = ReducedForce::read(&path).expect("a valid file");
            // Both models have 20 modes.
            assert_eq!((force.rank(), force.force(&DVector::zeros(20)).norm()), (20, 0.0));
            for seed in 0..6 {
                let JacobianErrors { difference, asymmetry } = jacobian_errors(&force, &random_vector(seed, 20));
                assert!(difference <= 1e-7 && asymmetry <= 1e-10, "{name}: {difference} {asymmetry}");
            }
        }
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_bridge_file_has_lowest_frequency_of_one_hertz() {
        let path = data_folder().join("vega/simpleBridge/simpleBridge.cub");
        let force = ReducedForce::read(&path).expect("a valid file");
        let lowest_eigenvalue = force.rest_stiffness().clone().symmetric_eigenvalues().min();
        let hertz = lowest_eigenvalue.sqrt() / (2.0 * std::f64::consts::PI);
        assert!((hertz - 1.0).abs() <= 1e-3, "{hertz} Hz");
    }
}
