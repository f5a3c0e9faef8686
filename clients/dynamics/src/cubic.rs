//! Reduced StVK forces of r coordinates, read from a `.cub` file: f(q) = L q + quadratic + cubic monomials, with
//! Jacobian and potential.
//!
//! File format: four little-endian i32 (r, then the numbers of monomials of degree one, two and three: r, r(r+1)/2 and
//! r(r+1)(r+2)/6), followed by one f64 block per degree, row-major per force component. The monomials q_i q_j (i <= j)
//! and q_i q_j q_k (i <= j <= k) are in lexicographic order.

use std::path::Path;

use modalcast_client::Error as ClientError;
use nalgebra::{DMatrix, DVector};

use crate::error::{Result, invalid};

/// Coefficients of a polynomial force, which is the gradient of a quartic potential.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedForce {
    rank: usize,
    linear: DMatrix<f64>,
    /// Row-major: one row per force component.
    quadratic: Vec<f64>,
    cubic: Vec<f64>,
}

impl ReducedForce {
    /// Creates a force from its blocks, each row-major per force component.
    ///
    /// # Errors
    /// `Invalid` if r is not 1 to 512, a block has the wrong length, or an entry is not finite.
    pub fn new(rank: usize, linear: &[f64], quadratic: Vec<f64>, cubic: Vec<f64>) -> Result<Self> {
        let monomials = counts(rank).ok_or_else(|| invalid("cub.r", "1 to 512", rank))?;
        for (field, given, count) in [
            ("cub.linear", linear.len(), monomials[0]),
            ("cub.quadratic", quadratic.len(), monomials[1]),
            ("cub.cubic", cubic.len(), monomials[2]),
        ] {
            if given != rank * count {
                return Err(invalid(field, format!("{rank} x {count} numbers"), given));
            }
        }
        for (field, block) in [("cub.linear", linear), ("cub.quadratic", &quadratic), ("cub.cubic", &cubic)] {
            if let Some(at) = block.iter().position(|entry| !entry.is_finite()) {
                return Err(invalid(format!("{field}[{at}]"), "a finite number", block[at]));
            }
        }
        Ok(Self { rank, linear: DMatrix::from_row_slice(rank, rank, linear), quadratic, cubic })
    }

    /// Reads a file.
    ///
    /// # Errors
    /// `Client` if it cannot be read; `Invalid` as for [`Self::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&std::fs::read(path).map_err(|fault| ClientError::file(path, fault))?)
    }

    /// Parses the bytes of a file.
    ///
    /// # Errors
    /// `Invalid` if the counts do not match r, the size does not match the counts, or a number is not finite.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let Some((head, body)) = bytes.split_at_checked(16) else {
            return Err(invalid("cub.size", "at least 16 bytes", bytes.len()));
        };
        let mut words = head.chunks_exact(4).map(|word| i32::from_le_bytes([word[0], word[1], word[2], word[3]]));
        let mut word = || words.next().unwrap_or(-1);
        let given = word();
        let rank = usize::try_from(given).ok();
        let Some((rank, monomials)) = rank.and_then(|rank| Some((rank, counts(rank)?))) else {
            return Err(invalid("cub.r", "1 to 512", given));
        };
        for (field, count) in ["cub.linear", "cub.quadratic", "cub.cubic"].into_iter().zip(monomials) {
            let given = word();
            if usize::try_from(given) != Ok(count) {
                return Err(invalid(field, format!("{count} monomials for r = {rank}"), given));
            }
        }
        // Cannot overflow: with r at most 512 the size is below 2^37 bytes.
        let expected = 8 * rank * monomials.iter().sum::<usize>();
        if body.len() != expected {
            return Err(invalid("cub.size", format!("{} bytes", 16 + expected), bytes.len()));
        }
        let mut numbers = body
            .chunks_exact(8)
            .map(|word| f64::from_le_bytes([word[0], word[1], word[2], word[3], word[4], word[5], word[6], word[7]]));
        let mut block = |count: usize| numbers.by_ref().take(rank * count).collect::<Vec<_>>();
        let (linear, quadratic, cubic) = (block(monomials[0]), block(monomials[1]), block(monomials[2]));
        Self::new(rank, &linear, quadratic, cubic)
    }

    /// The number of coordinates r.
    pub const fn rank(&self) -> usize {
        self.rank
    }

    /// The stiffness at rest, r x r.
    pub const fn linear(&self) -> &DMatrix<f64> {
        &self.linear
    }

    /// The force f(q), r entries.
    pub fn force(&self, q: &DVector<f64>) -> DVector<f64> {
        let [first, second, third] = self.by_degree(q);
        first + second + third
    }

    /// The potential V(q), whose gradient is f. The part f_d of degree d has the potential q . f_d / (d + 1) (Euler's
    /// theorem on homogeneous functions).
    pub fn potential(&self, q: &DVector<f64>) -> f64 {
        let [first, second, third] = self.by_degree(q);
        q.dot(&first) / 2.0 + q.dot(&second) / 3.0 + q.dot(&third) / 4.0
    }

    /// The Jacobian df/dq, r x r.
    pub fn jacobian(&self, q: &DVector<f64>) -> DMatrix<f64> {
        let mut matrix = self.linear.clone();
        let [_, pairs, triples] = counts(self.rank).unwrap_or_default();
        for row in 0..self.rank {
            let mut quadratic = self.quadratic[row * pairs..][..pairs].iter();
            let mut cubic = self.cubic[row * triples..][..triples].iter();
            for i in 0..self.rank {
                for (j, entry) in (i..self.rank).zip(&mut quadratic) {
                    matrix[(row, i)] += entry * q[j];
                    matrix[(row, j)] += entry * q[i];
                }
            }
            for i in 0..self.rank {
                for j in i..self.rank {
                    let pair = q[i] * q[j];
                    for (k, entry) in (j..self.rank).zip(&mut cubic) {
                        matrix[(row, i)] += entry * q[j] * q[k];
                        matrix[(row, j)] += entry * q[i] * q[k];
                        matrix[(row, k)] += entry * pair;
                    }
                }
            }
        }
        matrix
    }

    /// The parts of the force of degree one, two and three.
    fn by_degree(&self, q: &DVector<f64>) -> [DVector<f64>; 3] {
        let mut pairs = Vec::with_capacity(self.rank * (self.rank + 1) / 2);
        let mut triples = vec![];
        for i in 0..self.rank {
            for j in i..self.rank {
                let pair = q[i] * q[j];
                pairs.push(pair);
                triples.extend((j..self.rank).map(|k| pair * q[k]));
            }
        }
        let times = |block: &[f64], monomials: &[f64]| {
            let rows = block.chunks_exact(monomials.len().max(1));
            let dot = |row: &[f64]| row.iter().zip(monomials).map(|(a, b)| a * b).sum::<f64>();
            DVector::from_iterator(self.rank, rows.map(dot))
        };
        [&self.linear * q, times(&self.quadratic, &pairs), times(&self.cubic, &triples)]
    }
}

/// The numbers of monomials of degree one, two and three in r coordinates; `None` unless r is 1 to 512.
fn counts(rank: usize) -> Option<[usize; 3]> {
    let fits = (1..=512).contains(&rank);
    fits.then(|| [rank, rank * (rank + 1) / 2, rank * (rank + 1) * (rank + 2) / 6])
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Pseudorandom numbers from -1 to 1, the same for the same seed.
    pub(crate) fn noise(seed: u64, count: usize) -> DVector<f64> {
        let mut state = seed;
        DVector::from_fn(count, |_, _| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        })
    }

    /// Springs with eigenvalues `stiff`, and between neighbors the potentials `fourth` (q_i - q_{i+1})^4 and
    /// `third` q_i^2 q_{i+1}.
    pub(crate) fn chain(stiff: &[f64], fourth: f64, third: f64) -> ReducedForce {
        let rank = stiff.len();
        let [_, pairs, triples] = counts(rank).expect("small");
        let linear = DMatrix::from_diagonal(&DVector::from_column_slice(stiff));
        let (mut quadratic, mut cubic) = (vec![0.0; rank * pairs], vec![0.0; rank * triples]);
        let mut names = (vec![], vec![]);
        for i in 0..rank {
            for j in i..rank {
                names.0.push([i, j]);
                names.1.extend((j..rank).map(|k| [i, j, k]));
            }
        }
        for i in 0..rank.saturating_sub(1) {
            let j = i + 1;
            let pair = |a, b| names.0.iter().position(|name| *name == [a, b]).expect("named");
            let triple = |a, b, c| names.1.iter().position(|name| *name == [a, b, c]).expect("named");
            quadratic[i * pairs + pair(i, j)] += 2.0 * third;
            quadratic[j * pairs + pair(i, i)] += third;
            // The force is 4 (q_i - q_j)^3 on i, and its negative on j.
            for (row, sign) in [(i, 4.0 * fourth), (j, -4.0 * fourth)] {
                cubic[row * triples + triple(i, i, i)] += sign;
                cubic[row * triples + triple(i, i, j)] -= 3.0 * sign;
                cubic[row * triples + triple(i, j, j)] += 3.0 * sign;
                cubic[row * triples + triple(j, j, j)] -= sign;
            }
        }
        ReducedForce::new(rank, linear.as_slice(), quadratic, cubic).expect("valid")
    }

    pub(crate) fn encode(force: &ReducedForce) -> Vec<u8> {
        let mut bytes = vec![];
        let [first, second, third] = counts(force.rank).expect("valid");
        for count in [force.rank, first, second, third] {
            bytes.extend((count as i32).to_le_bytes());
        }
        let linear = force.linear.transpose();
        let blocks = linear.as_slice().iter().chain(&force.quadratic).chain(&force.cubic);
        blocks.for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes
    }

    /// The largest relative differences of the Jacobian from central differences, and from its transpose.
    fn wrongness(force: &ReducedForce, q: &DVector<f64>) -> (f64, f64) {
        let jacobian = force.jacobian(q);
        let step = 1e-5 * q.abs().max();
        let mut differences = DMatrix::zeros(force.rank(), force.rank());
        for column in 0..force.rank() {
            let (mut more, mut less) = (q.clone(), q.clone());
            more[column] += step;
            less[column] -= step;
            differences.set_column(column, &((force.force(&more) - force.force(&less)) / (2.0 * step)));
        }
        let scale = jacobian.abs().max();
        let skew = (&jacobian - jacobian.transpose()).abs().max();
        ((&jacobian - differences).abs().max() / scale, skew / scale)
    }

    #[test]
    fn file_round_trips_and_derivatives_agree() {
        let force = chain(&[3.0, 5.0, 11.0, 400.0], 0.7, 0.4);
        assert_eq!(ReducedForce::parse(&encode(&force)).expect("parses"), force);
        for seed in 0..8 {
            let q = noise(seed, 4);
            let (difference, skew) = wrongness(&force, &q);
            assert!(difference <= 1e-8 && skew <= 1e-14, "{difference} {skew}");
            let slope = (force.potential(&(&q * (1.0 + 1e-6))) - force.potential(&(&q * (1.0 - 1e-6)))) / 2e-6;
            assert!((slope - q.dot(&force.force(&q))).abs() <= 1e-6 * slope.abs().max(1.0), "{slope}");
        }
        assert_eq!(force.force(&DVector::zeros(4)), DVector::zeros(4));
        let mut bent = force;
        bent.cubic[1] += 50.0;
        assert!(wrongness(&bent, &noise(1, 4)).1 > 1e-4, "a force that is no gradient passes");
    }

    #[test]
    fn truncated_oversized_and_invalid_files_are_refused() {
        let whole = encode(&chain(&[1.0, 2.0], 0.1, 0.1));
        let with = |at: usize, byte: u8| {
            let mut bytes = whole.clone();
            bytes[at] = byte;
            bytes
        };
        let mut infinite = whole.clone();
        infinite[16..24].copy_from_slice(&f64::INFINITY.to_le_bytes());
        for (bytes, field) in [
            (vec![], "cub.size"),
            (whole[..15].to_vec(), "cub.size"),
            (whole[..whole.len() - 1].to_vec(), "cub.size"),
            ([whole.clone(), vec![0]].concat(), "cub.size"),
            (with(3, 0xff), "cub.r"),
            (with(1, 0xff), "cub.r"),
            (with(0, 0), "cub.r"),
            (with(0, 3), "cub.linear"),
            (with(8, 9), "cub.quadratic"),
            (with(12, 9), "cub.cubic"),
            (infinite, "cub.linear[0]"),
        ] {
            let refusal = ReducedForce::parse(&bytes).expect_err("wrong").to_string();
            assert!(refusal.starts_with(field), "{refusal} does not begin with {field}");
        }
    }

    /// The folder of real input data.
    pub(crate) fn data() -> std::path::PathBuf {
        let beside = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
        std::env::var_os("MODALCAST_DATA").map_or_else(|| beside.into(), Into::into)
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_forces_are_gradients_and_vanish_at_rest() {
        for name in ["simpleBridge", "A"] {
            let force = ReducedForce::read(&data().join(format!("vega/{name}/{name}.cub"))).expect("reads");
            assert_eq!((force.rank(), force.force(&DVector::zeros(20)).norm()), (20, 0.0));
            for seed in 0..6 {
                let (difference, skew) = wrongness(&force, &noise(seed, 20));
                assert!(difference <= 1e-7 && skew <= 1e-10, "{name}: {difference} {skew}");
            }
        }
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_bridge_has_a_lowest_frequency_of_one_hertz() {
        let force = ReducedForce::read(&data().join("vega/simpleBridge/simpleBridge.cub")).expect("reads");
        let lowest = force.linear().clone().symmetric_eigenvalues().min();
        let hertz = lowest.sqrt() / (2.0 * std::f64::consts::PI);
        assert!((hertz - 1.0).abs() <= 1e-3, "{hertz} Hz");
    }
}
