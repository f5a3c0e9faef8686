//! The internal force of a Saint Venant-Kirchhoff solid in reduced coordinates, as a polynomial of degree three, and its
//! file in the format `.cub` of the FEM library Vega.
//!
//! With the displacements U q, the strain is a polynomial in q: sum over monomials m of degree one and two of E_m m(q),
//! where q_i has the symmetric part of the displacement gradient H_i, and q_i q_j the symmetric part of H_i^T H_j (half of
//! it for i = j). The energy is 1/2 sum over m and n of m(q) n(q) G_mn with G_mn the integral of E_m : C : E_n, so one
//! Gram matrix contains all coefficients.

use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::{Accum, Mat, MatMut, MatRef, Par};
use modalcast_model::error::{Result, invalid};
use nalgebra::{DMatrix, Matrix3};
use rayon::prelude::*;

use crate::stvk::{StvkSolid, displacement_gradient};
use crate::tet10::Nodes;

/// The largest number of coordinates. The size of the file grows with its fourth power.
pub const MAX_RANK: usize = 64;

/// Size of the header of a file: four i32.
const HEADER_BYTES: u128 = 16;

/// Entries of a strain that is scaled by the square root of the stiffness.
const STRAIN_ENTRIES: usize = 6;

/// Elements that are integrated with one product of matrices.
const BATCH_ELEMENTS: usize = 8;

/// Memory of the Gram matrices that are summed in parallel, bytes.
const GRAM_BYTES: usize = 1 << 28;

/// Limit on the Gram matrices that are summed in parallel.
const MAX_TASKS: usize = 64;

/// The gradient of a quartic potential: f(q), newtons per unit of q.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedForce {
    rank: usize,
    /// r x r, row-major: force component, coordinate.
    linear: Vec<f64>,
    /// r x r(r+1)/2: force component, monomial q_i q_j with i <= j in lexicographic order.
    quadratic: Vec<f64>,
    /// r x r(r+1)(r+2)/6: force component, monomial q_i q_j q_k with i <= j <= k in lexicographic order.
    cubic: Vec<f64>,
}

/// The size of a file of `rank` coordinates in bytes. For large ranks, it does not fit 64 bits.
pub const fn file_bytes(rank: usize) -> u128 {
    let rank = rank as u128;
    let coefficients = rank + rank * (rank + 1) / 2 + rank * (rank + 1) * (rank + 2) / 6;
    HEADER_BYTES + 8 * rank * coefficients
}

impl ReducedForce {
    /// Integrates the forces of the displacements U q. `modes` are the columns of U. The result does not depend on the
    /// number of threads.
    ///
    /// # Errors
    /// `Invalid` with more than [`MAX_RANK`] columns.
    pub fn integrate(solid: &StvkSolid<'_>, modes: &[Vec<f64>]) -> Result<Self> {
        if modes.len() > MAX_RANK {
            return Err(invalid("modes", format!("at most {MAX_RANK}"), modes.len()));
        }
        let gram = gram_matrix(solid, modes);
        Ok(Self::from_gram(modes.len(), gram.as_ref()))
    }

    /// Replaces the linear term by a diagonal stiffness, so that it is that of the linear modes without rounding, and with
    /// everything that holds the body.
    pub fn set_stiffness(&mut self, eigenvalues: &[f64]) {
        let rank = self.rank;
        self.linear = (0..rank * rank)
            .map(|index| if index / rank == index % rank { eigenvalues[index / rank] } else { 0.0 })
            .collect();
    }

    /// The stiffness at rest, r x r, row-major.
    pub fn stiffness(&self) -> &[f64] {
        &self.linear
    }

    /// Collects the coefficients of the energy by monomial, and differentiates. `gram` is a lower triangle.
    fn from_gram(rank: usize, gram: MatRef<'_, f64>) -> Self {
        let monomials = strain_monomials(rank);
        let order = MonomialOrder { rank };
        let mut energy: [Vec<f64>; 3] = [2, 3, 4].map(|degree| vec![0.0; order.count(degree)]);
        let mut product = [0; 4];
        for (row, first) in monomials.iter().enumerate() {
            for (column, second) in monomials[..=row].iter().enumerate() {
                let degree = first.len() + second.len();
                product[..first.len()].copy_from_slice(first);
                product[first.len()..degree].copy_from_slice(second);
                product[..degree].sort_unstable();
                let factor = if row == column { 0.5 } else { 1.0 };
                energy[degree - 2][order.index(&product[..degree])] += factor * gram[(row, column)];
            }
        }
        let [linear, quadratic, cubic] = [1, 2, 3].map(|degree| order.differentiate(&energy[degree - 1], degree));
        Self { rank, linear, quadratic, cubic }
    }

    /// The force at q.
    pub fn evaluate(&self, q: &[f64]) -> Vec<f64> {
        let rank = self.rank;
        let mut monomials = q.to_vec();
        monomials.extend((0..rank).flat_map(|i| (i..rank).map(move |j| q[i] * q[j])));
        let of_first = |i: usize| (i..rank).flat_map(move |j| (j..rank).map(move |k| q[i] * q[j] * q[k]));
        monomials.extend((0..rank).flat_map(of_first));
        let [quadratic, cubic] = [self.quadratic.len() / rank, self.cubic.len() / rank];
        let component = |index: usize| {
            let rows = [
                &self.linear[index * rank..][..rank],
                &self.quadratic[index * quadratic..][..quadratic],
                &self.cubic[index * cubic..][..cubic],
            ];
            rows.into_iter().flatten().zip(&monomials).map(|(coefficient, monomial)| coefficient * monomial).sum()
        };
        (0..rank).map(component).collect()
    }

    /// df/dq at q, r x r.
    pub fn jacobian(&self, q: &[f64]) -> DMatrix<f64> {
        let rank = self.rank;
        let order = MonomialOrder { rank };
        let mut jacobian = DMatrix::from_row_slice(rank, rank, &self.linear);
        for (degree, block) in [(2, &self.quadratic), (3, &self.cubic)] {
            let monomials = order.list(degree);
            for (position, monomial) in monomials.iter().enumerate() {
                for (place, coordinate) in monomial.iter().enumerate() {
                    // A repeated coordinate adds its derivative once per place.
                    let others = monomial.iter().enumerate().filter(|(other, _)| *other != place);
                    let derivative: f64 = others.map(|(_, other)| q[*other]).product();
                    for component in 0..rank {
                        jacobian[(component, *coordinate)] +=
                            derivative * block[component * monomials.len() + position];
                    }
                }
            }
        }
        jacobian
    }

    /// The bytes of a `.cub` file: the numbers of coordinates and of monomials of degree one, two and three as
    /// little-endian i32, then the coefficients as f64.
    pub fn encode(&self) -> Vec<u8> {
        let order = MonomialOrder { rank: self.rank };
        let header = [self.rank, order.count(1), order.count(2), order.count(3)];
        let mut bytes: Vec<u8> = header.iter().flat_map(|count| (*count as i32).to_le_bytes()).collect();
        let coefficients = self.linear.iter().chain(&self.quadratic).chain(&self.cubic);
        bytes.extend(coefficients.flat_map(|coefficient| coefficient.to_le_bytes()));
        bytes
    }
}

/// The monomials of the strain as ascending coordinates: q_i, then q_i q_j with i <= j.
fn strain_monomials(rank: usize) -> Vec<Vec<usize>> {
    let pairs = (0..rank).flat_map(|i| (i..rank).map(move |j| vec![i, j]));
    (0..rank).map(|i| vec![i]).chain(pairs).collect()
}

/// The Gram matrix of the strains of all monomials, of which the lower triangle is set.
fn gram_matrix(solid: &StvkSolid<'_>, modes: &[Vec<f64>]) -> Mat<f64> {
    let monomials = modes.len() + modes.len() * (modes.len() + 1) / 2;
    let elements = solid.element_nodes.len();
    // The division does not depend on the number of threads, and the sums are added in its order.
    let tasks = (GRAM_BYTES / (8 * monomials * monomials)).clamp(1, MAX_TASKS).min(elements.max(1));
    let partial_sum = |task: usize| {
        let (first, last) = (task * elements / tasks, (task + 1) * elements / tasks);
        let mut sum = Mat::zeros(monomials, monomials);
        let mut strains = Vec::new();
        for start in (first..last).step_by(BATCH_ELEMENTS) {
            strains.clear();
            for element in start..last.min(start + BATCH_ELEMENTS) {
                add_strains(solid, element, modes, &mut strains);
            }
            add_gram(sum.as_mut(), &strains);
        }
        sum
    };
    let sums: Vec<Mat<f64>> = (0..tasks).into_par_iter().map(partial_sum).collect();
    sums.into_iter().reduce(|a, b| a + b).unwrap_or_else(|| Mat::zeros(monomials, monomials))
}

/// Adds X X^T to the lower triangle of a matrix. The columns of X follow each other.
fn add_gram(sum: MatMut<'_, f64>, columns: &[f64]) {
    let rows = sum.nrows();
    let factor = MatRef::from_column_major_slice(columns, rows, columns.len() / rows);
    let (lower, full) = (BlockStructure::TriangularLower, BlockStructure::Rectangular);
    triangular::matmul(sum, lower, Accum::Add, factor, full, factor.transpose(), full, 1.0, Par::Seq);
}

/// Appends the strains of all monomials at all points of an element, one column per point and entry. They are scaled, so
/// that their dot product is the integral of E_m : C : E_n.
fn add_strains(solid: &StvkSolid<'_>, element: usize, modes: &[Vec<f64>], columns: &mut Vec<f64>) {
    let rank = modes.len();
    let lame_parameters = solid.lame_parameters[element];
    let monomials = rank + rank * (rank + 1) / 2;
    let fields: Vec<Nodes> = modes.iter().map(|mode| solid.element_displacements(element, mode)).collect();
    for point in solid.points(element) {
        let gradients: Vec<Matrix3<f64>> = fields.iter().map(|field| displacement_gradient(&point, field)).collect();
        let scale = point.volume.sqrt();
        let start = columns.len();
        columns.resize(start + STRAIN_ENTRIES * monomials, 0.0);
        let mut set = |monomial: usize, strain: &Matrix3<f64>| {
            for (entry, value) in scaled_strain(lame_parameters, strain).into_iter().enumerate() {
                columns[start + entry * monomials + monomial] = scale * value;
            }
        };
        gradients.iter().enumerate().for_each(|(index, gradient)| set(index, gradient));
        let mut monomial = rank;
        for (index, first) in gradients.iter().enumerate() {
            let transposed = first.transpose();
            for (offset, second) in gradients[index..].iter().enumerate() {
                let factor = if offset == 0 { 0.5 } else { 1.0 };
                set(monomial, &(transposed * second * factor));
                monomial += 1;
            }
        }
    }
}

/// Six numbers of the symmetric part of a strain, whose squares add up to E : C : E = (lambda + 2/3 mu) tr(E)^2 + 2 mu
/// |dev E|^2.
fn scaled_strain((lambda, mu): (f64, f64), strain: &Matrix3<f64>) -> [f64; STRAIN_ENTRIES] {
    let mean = strain.trace() / 3.0;
    let (shear, bulk) = ((2.0 * mu).sqrt(), (3.0 * lambda + 2.0 * mu).sqrt());
    let diagonal = |axis: usize| shear * (strain[(axis, axis)] - mean) + bulk * mean;
    let other = |i: usize, j: usize| mu.sqrt() * (strain[(i, j)] + strain[(j, i)]);
    [diagonal(0), diagonal(1), diagonal(2), other(0, 1), other(1, 2), other(2, 0)]
}

/// The lexicographic order of monomials, which are ascending coordinates.
#[derive(Debug, Clone, Copy)]
struct MonomialOrder {
    rank: usize,
}

impl MonomialOrder {
    /// The number of monomials of a degree: r (r + 1) ... (r + degree - 1) / degree!.
    fn count(self, degree: usize) -> usize {
        multisets(self.rank, degree)
    }

    /// The index of a monomial among those of its degree.
    fn index(self, monomial: &[usize]) -> usize {
        let mut smallest = 0;
        let before = monomial.iter().enumerate().map(|(position, coordinate)| {
            let others = monomial.len() - position;
            // Monomials with a smaller coordinate here: all from `smallest` on, without those from `coordinate` on.
            let count = multisets(self.rank - smallest, others) - multisets(self.rank - coordinate, others);
            smallest = *coordinate;
            count
        });
        before.sum()
    }

    /// The monomials of a degree in their order.
    fn list(self, degree: usize) -> Vec<Vec<usize>> {
        let mut monomials = vec![vec![]];
        for _ in 0..degree {
            let extend = |monomial: Vec<usize>| {
                let first = monomial.last().copied().unwrap_or(0);
                (first..self.rank).map(move |coordinate| [&monomial[..], &[coordinate]].concat())
            };
            monomials = monomials.into_iter().flat_map(extend).collect();
        }
        monomials
    }

    /// The derivative of an energy, whose monomials have the degree `degree + 1`: one row per coordinate, one column per
    /// monomial of the degree.
    fn differentiate(self, energy: &[f64], degree: usize) -> Vec<f64> {
        let monomials = self.list(degree);
        let derivative = |coordinate: usize| {
            let monomials = monomials.iter();
            monomials.map(move |monomial| {
                let mut product = [0; 4];
                product[..degree].copy_from_slice(monomial);
                product[degree] = coordinate;
                product[..=degree].sort_unstable();
                let exponent = product[..=degree].iter().filter(|factor| **factor == coordinate).count();
                exponent as f64 * energy[self.index(&product[..=degree])]
            })
        };
        (0..self.rank).flat_map(derivative).collect()
    }
}

/// The number of multisets of `size` elements of `choices`.
fn multisets(choices: usize, size: usize) -> usize {
    (0..size).fold(1, |count, index| count * (choices + index) / (index + 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn monomials_are_in_lexicographic_order() {
        let order = MonomialOrder { rank: 5 };
        for degree in 1..=4 {
            let monomials = order.list(degree);
            assert_eq!(monomials.len(), order.count(degree));
            assert!(monomials.is_sorted());
            for (index, monomial) in monomials.iter().enumerate() {
                assert_eq!(order.index(monomial), index, "{monomial:?}");
            }
        }
    }

    #[test]
    fn derivative_of_a_monomial_has_its_exponents() {
        let order = MonomialOrder { rank: 2 };
        let mut energy = vec![0.0; order.count(4)];
        energy[order.index(&[0, 0, 0, 1])] = 2.0;
        // d/dq0 of 2 q0^3 q1 is 6 q0^2 q1, and d/dq1 is 2 q0^3. Columns: 000, 001, 011, 111.
        assert_eq!(order.differentiate(&energy, 3), [0.0, 6.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn size_of_files_is_that_of_the_format() {
        assert_eq!((file_bytes(20), file_bytes(1)), (283_216, 16 + 24));
    }

    #[test]
    fn scaled_strain_has_the_energy_of_the_material() {
        let strain = Matrix3::new(0.1, 0.3, -0.2, 0.05, -0.4, 0.6, 0.0, 0.25, 0.7);
        let symmetric = (strain + strain.transpose()) * 0.5;
        for (lambda, mu) in [(2.0_f64, 3.0), (-1.5, 3.0)] {
            let energy = lambda * symmetric.trace() * symmetric.trace() + 2.0 * mu * symmetric.norm_squared();
            let squares: f64 = scaled_strain((lambda, mu), &strain).iter().map(|entry| entry * entry).sum();
            assert!((squares / energy - 1.0).abs() < 1e-14, "{squares} instead of {energy}");
        }
    }
}
