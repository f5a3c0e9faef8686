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
use sha2::{Digest as _, Sha256};

use crate::checkpoint::hexadecimal;
use crate::error::{Result, invalid_input};

/// Size of the header of a file: four i32.
const HEADER_BYTES: usize = 16;

/// Largest difference of two coefficients that should be equal, as a fraction of the largest coefficient of their
/// degree. Vega's files have differences below 1e-10.
const GRADIENT_TOLERANCE: f64 = 1e-6;

/// A polynomial force, which is the gradient of a quartic potential. It is stored as its Jacobian, which is symmetric:
/// entry (i, j) with i <= j is a row ("pair") of the matrices below. By Euler's theorem on homogeneous functions, the
/// Jacobian J_d of the term of degree d gives the force J_d q / d and the potential q . J_d q / (d (d + 1)).
///
/// A file has every coefficient of the potential several times, with rounding errors. Their mean is stored, because the
/// conservation of energy needs an exact gradient.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedForce {
    rank: usize,
    /// r x r: the stiffness at rest.
    linear_block: DMatrix<f64>,
    /// The Jacobian of the term of degree two: one row per pair, one column per coordinate.
    quadratic_jacobian: DMatrix<f64>,
    /// The Jacobian of the term of degree three: one row per pair, one column per monomial of degree two.
    cubic_jacobian: DMatrix<f64>,
}

/// Force, Jacobian and potential at one q.
#[derive(Debug, Clone)]
pub struct ForceEvaluation {
    pub force: DVector<f64>,
    /// df/dq, r x r, symmetric.
    pub jacobian: DMatrix<f64>,
    pub potential: f64,
}

impl ReducedForce {
    /// Creates a force from its blocks, row-major matrices with one row per force component.
    ///
    /// # Errors
    /// `Invalid` if r is not 1 to 512, a block has the wrong length, an entry is not finite, or the force is not the
    /// gradient of a potential.
    pub fn new(rank: usize, linear: &[f64], quadratic: &[f64], cubic: &[f64]) -> Result<Self> {
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
        for (field, block) in [("cub.linear", linear), ("cub.quadratic", quadratic), ("cub.cubic", cubic)] {
            if let Some(index) = block.iter().position(|entry| !entry.is_finite()) {
                return Err(invalid_input(format!("{field}[{index}]"), "a finite number", block[index]));
            }
        }
        check_gradient("cub.linear", rank, 1, linear)?;
        check_gradient("cub.quadratic", rank, 2, quadratic)?;
        check_gradient("cub.cubic", rank, 3, cubic)?;
        let linear_block = DMatrix::from_row_slice(rank, rank, linear);
        Ok(Self {
            rank,
            linear_block: (&linear_block + linear_block.transpose()) * 0.5,
            quadratic_jacobian: assemble_jacobian(rank, 2, quadratic),
            cubic_jacobian: assemble_jacobian(rank, 3, cubic),
        })
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
        Self::new(rank, &linear, &quadratic, &cubic)
    }

    /// The number of coordinates r.
    pub const fn rank(&self) -> usize {
        self.rank
    }

    /// The SHA-256 of all coefficients, 64 hexadecimal digits.
    pub(crate) fn content_hash(&self) -> String {
        let mut hasher = Sha256::new();
        for block in [&self.linear_block, &self.quadratic_jacobian, &self.cubic_jacobian] {
            block.iter().for_each(|coefficient| hasher.update(coefficient.to_le_bytes()));
        }
        hexadecimal(&hasher.finalize())
    }

    /// The stiffness at rest, r x r.
    pub const fn rest_stiffness(&self) -> &DMatrix<f64> {
        &self.linear_block
    }

    /// The force f(q), r entries.
    pub fn force(&self, q: &DVector<f64>) -> DVector<f64> {
        self.evaluate(q).force
    }

    /// The potential V(q), whose gradient is f.
    pub fn potential(&self, q: &DVector<f64>) -> f64 {
        self.evaluate(q).potential
    }

    /// Force, Jacobian and potential.
    pub fn evaluate(&self, q: &DVector<f64>) -> ForceEvaluation {
        let rank = self.rank;
        let mut monomials = DVector::zeros(rank * (rank + 1) / 2);
        let products = (0..rank).flat_map(|i| (i..rank).map(move |j| q[i] * q[j]));
        monomials.iter_mut().zip(products).for_each(|(monomial, product)| *monomial = product);
        let quadratic_pairs = &self.quadratic_jacobian * q;
        let cubic_pairs = &self.cubic_jacobian * monomials;
        let mut force = &self.linear_block * q;
        let mut jacobian = self.linear_block.clone();
        // The products of q with the forces of degree two and three.
        let (mut quadratic_work, mut cubic_work) = (0.0, 0.0);
        let linear_work = q.dot(&force);
        let mut pairs = quadratic_pairs.iter().zip(&cubic_pairs);
        for i in 0..rank {
            for (j, (quadratic, cubic)) in (i..rank).zip(&mut pairs) {
                jacobian[(i, j)] += quadratic + cubic;
                let force_entry = quadratic / 2.0 + cubic / 3.0;
                force[i] += force_entry * q[j];
                let mut product = q[i] * q[j];
                if j > i {
                    jacobian[(j, i)] = jacobian[(i, j)];
                    force[j] += force_entry * q[i];
                    product *= 2.0;
                }
                quadratic_work += quadratic / 2.0 * product;
                cubic_work += cubic / 3.0 * product;
            }
        }
        ForceEvaluation { force, jacobian, potential: linear_work / 2.0 + quadratic_work / 3.0 + cubic_work / 4.0 }
    }
}

/// The Jacobian of the force of one degree: one row per pair (i, j) with i <= j, one column per monomial of the degree
/// below. The monomial v M of the potential adds v d^2 M / (dq_i dq_j) to the pair (i, j).
fn assemble_jacobian(rank: usize, degree: usize, block: &[f64]) -> DMatrix<f64> {
    let monomials = list_monomials(rank, degree);
    let (pairs, columns) = (list_monomials(rank, 2), list_monomials(rank, degree - 1));
    let mut jacobian = DMatrix::zeros(pairs.len(), columns.len());
    for potential_monomial in list_monomials(rank, degree + 1) {
        let mut components = potential_monomial.clone();
        components.dedup();
        let exponent = |component: usize| potential_monomial.iter().filter(|index| **index == component).count() as f64;
        let coefficient = |component: &usize| {
            let column = find_monomial(&monomials, &potential_monomial, &[*component]);
            block[component * monomials.len() + column] / exponent(*component)
        };
        let mean_coefficient = components.iter().map(coefficient).sum::<f64>() / components.len() as f64;
        for (position, i) in components.iter().enumerate() {
            for j in &components[position..] {
                let factor = if i == j { exponent(*i) * (exponent(*i) - 1.0) } else { exponent(*i) * exponent(*j) };
                if factor > 0.0 {
                    let pair = pairs.binary_search(&vec![*i, *j]).unwrap_or_default();
                    let column = find_monomial(&columns, &potential_monomial, &[*i, *j]);
                    jacobian[(pair, column)] += factor * mean_coefficient;
                }
            }
        }
    }
    jacobian
}

/// The index in `monomials` of a monomial divided by some of its coordinates.
fn find_monomial(monomials: &[Vec<usize>], monomial: &[usize], divisors: &[usize]) -> usize {
    let mut quotient = monomial.to_vec();
    for divisor in divisors {
        if let Ok(position) = quotient.binary_search(divisor) {
            quotient.remove(position);
        }
    }
    monomials.binary_search(&quotient).unwrap_or_default()
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
        spring_chain_blocks(eigenvalues, quartic_coefficient, cubic_coefficient).force()
    }

    /// The blocks of a file: row-major, one row per force component, one column per monomial.
    #[derive(Clone)]
    pub(crate) struct Blocks {
        rank: usize,
        linear: Vec<f64>,
        quadratic: Vec<f64>,
        cubic: Vec<f64>,
    }

    impl Blocks {
        pub(crate) fn force(&self) -> ReducedForce {
            ReducedForce::new(self.rank, &self.linear, &self.quadratic, &self.cubic).expect("a valid force")
        }

        /// The bytes of a `.cub` file.
        fn encode(&self) -> Vec<u8> {
            let counts = monomial_counts(self.rank).expect("a supported rank");
            let counts = [self.rank].into_iter().chain(counts);
            let numbers = self.linear.iter().chain(&self.quadratic).chain(&self.cubic);
            let header = counts.flat_map(|count| (count as i32).to_le_bytes());
            header.chain(numbers.flat_map(|number| number.to_le_bytes())).collect()
        }
    }

    /// The Duffing oscillator with the force w^2 (q + 10 q^3) and a frequency of 1 Hz at rest.
    pub(crate) fn duffing() -> ReducedForce {
        let w2 = std::f64::consts::TAU.powi(2);
        Blocks { rank: 1, linear: vec![w2], quadratic: vec![0.0], cubic: vec![10.0 * w2] }.force()
    }

    /// The gradient of a random potential with a positive quartic term: V = q.A q / 2 + cubic terms
    /// + sum (w_n . q)^4 / 4.
    pub(crate) fn random_force(seed: u64, rank: usize) -> ReducedForce {
        let [_, quadratic_count, cubic_count] = monomial_counts(rank).expect("a supported rank");
        let mut blocks = Blocks {
            rank,
            linear: DMatrix::from_diagonal(&DVector::from_fn(rank, |mode, _| 10.0 * (1.0 + mode as f64).powi(2)))
                .as_slice()
                .to_vec(),
            quadratic: vec![0.0; rank * quadratic_count],
            cubic: vec![0.0; rank * cubic_count],
        };
        let (pairs, triples) = (list_monomials(rank, 2), list_monomials(rank, 3));
        // The force of the potential (w . q)^n / n in component c is w_c (w . q)^(n - 1).
        for vector in 0..3 * rank as u64 {
            let w = random_vector(100 * seed + vector, rank) * 2.0;
            for component in 0..rank {
                let row = &mut blocks.quadratic[component * quadratic_count..][..quadratic_count];
                for (entry, pair) in row.iter_mut().zip(&pairs) {
                    *entry += w[component] * multiplicity(pair) * w[pair[0]] * w[pair[1]];
                }
                let row = &mut blocks.cubic[component * cubic_count..][..cubic_count];
                for (entry, triple) in row.iter_mut().zip(&triples) {
                    *entry +=
                        w[component] * multiplicity(triple) * triple.iter().map(|index| w[*index]).product::<f64>();
                }
            }
        }
        blocks.force()
    }

    /// The number of orders of the coordinates of a monomial of degree two or three.
    fn multiplicity(monomial: &[usize]) -> f64 {
        let mut distinct = monomial.to_vec();
        distinct.dedup();
        match (monomial.len(), distinct.len()) {
            (_, 1) => 1.0,
            (2, _) => 2.0,
            (_, 2) => 3.0,
            _ => 6.0,
        }
    }

    fn spring_chain_blocks(eigenvalues: &[f64], quartic_coefficient: f64, cubic_coefficient: f64) -> Blocks {
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
        Blocks { rank, linear: linear.as_slice().to_vec(), quadratic: quadratic_block, cubic: cubic_block }
    }

    /// Errors of a Jacobian, relative to its largest entry.
    struct JacobianErrors {
        /// Largest difference from central differences of the force.
        difference: f64,
        /// Largest difference from the transpose of the Jacobian; above 0 if the force is not a gradient.
        asymmetry: f64,
    }

    fn jacobian_errors(force: &ReducedForce, q: &DVector<f64>) -> JacobianErrors {
        let jacobian = force.evaluate(q).jacobian;
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
        let blocks = spring_chain_blocks(&[3.0, 5.0, 11.0, 400.0], 0.7, 0.4);
        let force = blocks.force();
        assert_eq!(ReducedForce::parse(&blocks.encode()).expect("a valid file"), force);
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
        let blocks = spring_chain_blocks(&[3.0, 5.0, 11.0, 400.0], 0.7, 0.4);
        let (mut linear, mut quadratic, mut cubic) = (blocks.clone(), blocks.clone(), blocks.clone());
        linear.linear[2] += 1.0;
        quadratic.quadratic[1] += 1.0;
        cubic.cubic[1] += 1.0;
        for (invalid, field) in [(linear, "cub.linear"), (quadratic, "cub.quadratic"), (cubic, "cub.cubic")] {
            let error = ReducedForce::parse(&invalid.encode()).expect_err("a force without potential").to_string();
            assert!(error.starts_with(field) && error.contains("forces of a potential"), "{error}");
        }
        // Rounding errors of an exporter.
        let mut rounded = blocks;
        rounded.cubic[1] += 1e-9;
        ReducedForce::parse(&rounded.encode()).expect("a valid file");
    }

    /// Component 0 of the force of [`spring_chain`] with two springs, written out.
    #[test]
    fn force_equals_the_polynomial_of_the_file() {
        let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
        for seed in 0..4 {
            let q = random_vector(seed, 2);
            let expected = 40.0 * q[0] + 8.0 * q[0] * q[1] + 120.0 * (q[0] - q[1]).powi(3);
            assert!((force.force(&q)[0] - expected).abs() <= 1e-12 * expected.abs().max(1.0), "{expected}");
        }
    }

    #[test]
    fn truncated_oversized_and_invalid_files_are_rejected() {
        let valid_file = spring_chain_blocks(&[1.0, 2.0], 0.1, 0.1).encode();
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
