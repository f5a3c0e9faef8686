//! Stiffness and mass of a 27-node cell from the moments of its material.
//!
//! The moments are turned into weights of a fixed rule with 5 x 5 x 5 Gauss points, which integrates every product of two
//! shape functions over the material exactly. Single weights may be negative; the matrices are positive semidefinite
//! up to rounding, because the rays that gave the moments have positive weights.

use std::sync::LazyLock;

use crate::cell_moments::{DEGREES, MOMENTS, legendre};
use crate::grid::{CELL_NODES, NODES_PER_SIDE};
use crate::materials::Material;

/// Rows of the stiffness matrix of a cell.
pub const CELL_FREEDOMS: usize = 3 * CELL_NODES;

/// The matrices of one cell.
#[derive(Debug, Clone)]
pub struct CellMatrices {
    /// Row-major, [`CELL_FREEDOMS`] squared; freedom `3 node + axis`. Newtons per meter.
    pub stiffness: Vec<f64>,
    /// Row-major, [`CELL_NODES`] squared; the same for all three axes. Kilograms.
    pub mass: Vec<f64>,
}

impl CellMatrices {
    /// Matrices of zeros.
    pub fn zeros() -> Self {
        Self { stiffness: vec![0.0; CELL_FREEDOMS * CELL_FREEDOMS], mass: vec![0.0; CELL_NODES * CELL_NODES] }
    }

    /// Adds the material with the given moments, of a cell with sides of `cell_size` meters.
    pub fn add_material(&mut self, moments: &[f64; MOMENTS], material: &Material, cell_size: f64) {
        let weights = rule_weights(moments);
        self.add_mass(&weights, material.density * (cell_size / 2.0).powi(3));
        // Derivatives by the coordinates from -1 to 1 are divided by half the side.
        self.add_stiffness(&weights, material, cell_size / 2.0);
    }

    /// Adds a fraction of the stiffness of a full cell: material that fills the rest of a cut cell and that has no mass.
    pub fn add_fill(&mut self, full: &Self, fraction: f64) {
        for (sum, entry) in self.stiffness.iter_mut().zip(&full.stiffness) {
            *sum += fraction * entry;
        }
    }

    fn add_mass(&mut self, weights: &[f64; MOMENTS], scale: f64) {
        let products = weighted_products(&RULE.values, &RULE.values, weights);
        self.mass.iter_mut().zip(products).for_each(|(sum, product)| *sum += scale * product);
    }

    /// Isotropic linear elasticity: K_ia,jb = lambda G_ab + mu G_ba + delta_ab mu sum_c G_cc, where G_ab is the integral
    /// of dN_i/da dN_j/db.
    fn add_stiffness(&mut self, weights: &[f64; MOMENTS], material: &Material, scale: f64) {
        let (lambda, mu) = material.lame_parameters();
        let derivatives = &RULE.derivatives;
        let product = |a: usize, b: usize| weighted_products(&derivatives[a], &derivatives[b], weights);
        let diagonal = [product(0, 0), product(1, 1), product(2, 2)];
        for (a, b) in [(0, 1), (0, 2), (1, 2)] {
            let mixed = product(a, b);
            for i in 0..CELL_NODES {
                for j in 0..CELL_NODES {
                    let (entry, transposed) = (mixed[i * CELL_NODES + j], mixed[j * CELL_NODES + i]);
                    let stiffness = scale * (lambda * entry + mu * transposed);
                    self.stiffness[(3 * i + a) * CELL_FREEDOMS + 3 * j + b] += stiffness;
                    self.stiffness[(3 * j + b) * CELL_FREEDOMS + 3 * i + a] += stiffness;
                }
            }
        }
        for i in 0..CELL_NODES {
            for j in 0..CELL_NODES {
                let entries = diagonal.each_ref().map(|matrix| matrix[i * CELL_NODES + j]);
                let laplacian: f64 = entries.iter().sum();
                for (axis, entry) in entries.into_iter().enumerate() {
                    self.stiffness[(3 * i + axis) * CELL_FREEDOMS + 3 * j + axis] +=
                        scale * ((lambda + mu) * entry + mu * laplacian);
                }
            }
        }
    }
}

/// Values of the shape functions at a point with coordinates from -1 to 1.
pub fn shape_functions(point: [f64; 3]) -> [f64; CELL_NODES] {
    let along = point.map(|x| [x * (x - 1.0) / 2.0, 1.0 - x * x, x * (x + 1.0) / 2.0]);
    std::array::from_fn(|node| {
        let [i, j, k] = node_coordinates(node);
        along[0][i] * along[1][j] * along[2][k]
    })
}

/// The position of a node in its cell, 0 to 2 per axis.
pub const fn node_coordinates(node: usize) -> [usize; 3] {
    [node / (NODES_PER_SIDE * NODES_PER_SIDE), node / NODES_PER_SIDE % NODES_PER_SIDE, node % NODES_PER_SIDE]
}

/// Moments of a cell that is full of material.
pub fn full_moments() -> [f64; MOMENTS] {
    let mut moments = [0.0; MOMENTS];
    moments[0] = 8.0;
    moments
}

/// Shape functions and their derivatives at the points of the rule. One row of [`MOMENTS`] points per node.
struct Rule {
    values: Vec<f64>,
    derivatives: [Vec<f64>; 3],
    /// `transform[degree][point]` per axis: the weight at a point for a moment of 1.
    transform: [[f64; DEGREES]; DEGREES],
}

static RULE: LazyLock<Rule> = LazyLock::new(|| {
    /// Points and weights of the Gauss rule with five points, which is exact up to degree 9.
    const POINTS: [f64; DEGREES] =
        [-0.906_179_845_938_664, -0.538_469_310_105_683_1, 0.0, 0.538_469_310_105_683_1, 0.906_179_845_938_664];
    const WEIGHTS: [f64; DEGREES] = [
        0.236_926_885_056_189_1,
        0.478_628_670_499_366_5,
        0.568_888_888_888_888_9,
        0.478_628_670_499_366_5,
        0.236_926_885_056_189_1,
    ];
    let polynomials = POINTS.map(legendre);
    let transform = std::array::from_fn(|degree| {
        std::array::from_fn(|point| (2 * degree + 1) as f64 / 2.0 * polynomials[point][degree] * WEIGHTS[point])
    });
    let mut rule = Rule {
        values: vec![0.0; CELL_NODES * MOMENTS],
        derivatives: [(); 3].map(|()| vec![0.0; CELL_NODES * MOMENTS]),
        transform,
    };
    for point in 0..MOMENTS {
        let x = [POINTS[point / 25], POINTS[point / 5 % 5], POINTS[point % 5]];
        let along = x.map(|x| [x * (x - 1.0) / 2.0, 1.0 - x * x, x * (x + 1.0) / 2.0]);
        let slopes = x.map(|x| [x - 0.5, -2.0 * x, x + 0.5]);
        for node in 0..CELL_NODES {
            let index = node_coordinates(node);
            let factor = |axis: usize, derivative: Option<usize>| {
                if derivative == Some(axis) { slopes[axis][index[axis]] } else { along[axis][index[axis]] }
            };
            let product = |derivative| (0..3).map(|axis| factor(axis, derivative)).product();
            rule.values[node * MOMENTS + point] = product(None);
            for axis in 0..3 {
                rule.derivatives[axis][node * MOMENTS + point] = product(Some(axis));
            }
        }
    }
    rule
});

/// The weights of the rule's points for the given moments.
fn rule_weights(moments: &[f64; MOMENTS]) -> [f64; MOMENTS] {
    let mut values = *moments;
    // One axis after the other: degrees are replaced by points.
    for stride in [25, 5, 1] {
        let mut transformed = [0.0; MOMENTS];
        for (index, sum) in transformed.iter_mut().enumerate() {
            let point = index / stride % DEGREES;
            let base = index - point * stride;
            *sum = (0..DEGREES).map(|degree| values[base + degree * stride] * RULE.transform[degree][point]).sum();
        }
        values = transformed;
    }
    values
}

/// `sum_q w_q a_i(q) b_j(q)` for all pairs of nodes, row-major.
fn weighted_products(a: &[f64], b: &[f64], weights: &[f64; MOMENTS]) -> Vec<f64> {
    let mut products = vec![0.0; CELL_NODES * CELL_NODES];
    for (i, row) in a.as_chunks::<MOMENTS>().0.iter().enumerate() {
        let weighted: [f64; MOMENTS] = std::array::from_fn(|point| row[point] * weights[point]);
        for (j, column) in b.as_chunks::<MOMENTS>().0.iter().enumerate() {
            products[i * CELL_NODES + j] = dot(&weighted, column);
        }
    }
    products
}

/// A dot product in five independent sums, which the compiler vectorizes.
fn dot(a: &[f64; MOMENTS], b: &[f64; MOMENTS]) -> f64 {
    const LANES: usize = 25;
    let mut sums = [0.0; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell_moments::GroupMoments;

    fn matrices(moments: &[f64; MOMENTS]) -> CellMatrices {
        let mut matrices = CellMatrices::zeros();
        matrices.add_material(moments, &Material::new(1e6, 0.3, 1000.0).expect("a material"), 0.5);
        matrices
    }

    /// The displacement of each freedom under a linear field u = A x.
    fn linear_field(gradient: [[f64; 3]; 3]) -> Vec<f64> {
        let position = |node: usize| node_coordinates(node).map(|index| 0.25 * (index as f64 - 1.0));
        let displacement = |node: usize| gradient.map(|row| (0..3).map(|axis| row[axis] * position(node)[axis]).sum());
        (0..CELL_NODES).flat_map(|node| -> [f64; 3] { displacement(node) }).collect()
    }

    fn energy(matrices: &CellMatrices, u: &[f64]) -> f64 {
        let rows = matrices.stiffness.chunks_exact(CELL_FREEDOMS);
        let forces = rows.map(|row| row.iter().zip(u).map(|(a, b)| a * b).sum::<f64>());
        forces.zip(u).map(|(force, u)| force * u).sum()
    }

    #[test]
    fn full_cell_has_its_mass_and_the_energy_of_homogeneous_strain() {
        let matrices = matrices(&full_moments());
        assert!((matrices.mass.iter().sum::<f64>() - 125.0).abs() < 1e-10);
        let (lambda, mu) = Material::new(1e6, 0.3, 1000.0).expect("a material").lame_parameters();
        let stretch = energy(&matrices, &linear_field([[1e-3, 0.0, 0.0], [0.0; 3], [0.0; 3]]));
        assert!((stretch / ((lambda + 2.0 * mu) * 1e-6 * 0.125) - 1.0).abs() < 1e-10, "{stretch}");
        let shear = energy(&matrices, &linear_field([[0.0, 1e-3, 0.0], [0.0; 3], [0.0; 3]]));
        assert!((shear / (mu * 1e-6 * 0.125) - 1.0).abs() < 1e-10, "{shear}");
        let rotation = energy(&matrices, &linear_field([[0.0, -1e-3, 0.0], [1e-3, 0.0, 0.0], [0.0; 3]]));
        assert!(rotation.abs() < 1e-10 * stretch, "{rotation}");
    }

    /// A slab of 1/10 of the cell has a tenth of the energy of homogeneous strain.
    #[test]
    fn cut_cell_has_the_energy_of_its_material() {
        let mut group = GroupMoments { group: 0, moments: [0.0; MOMENTS] };
        let samples = 4000;
        for sample in 0..samples {
            let x = -1.0 + 0.2 * (sample as f64 + 0.5) / samples as f64;
            let values = legendre(x);
            (0..DEGREES).for_each(|degree| group.moments[25 * degree] += 4.0 * 0.2 / samples as f64 * values[degree]);
        }
        let (full, cut) = (matrices(&full_moments()), matrices(&group.moments));
        let field = linear_field([[1e-3, 2e-3, 0.0], [0.0, 0.0, 1e-3], [0.0, 1e-3, -1e-3]]);
        assert!((energy(&cut, &field) / energy(&full, &field) - 0.1).abs() < 1e-6);
        assert!((cut.mass.iter().sum::<f64>() - 12.5).abs() < 1e-6);
    }

    #[test]
    fn shape_functions_are_one_at_their_node_and_sum_to_one() {
        for node in 0..CELL_NODES {
            let point = node_coordinates(node).map(|index| index as f64 - 1.0);
            let values = shape_functions(point);
            assert!((0..CELL_NODES).all(|other| values[other] == f64::from(u8::from(other == node))), "{values:?}");
        }
        assert!((shape_functions([0.3, -0.8, 1.4]).iter().sum::<f64>() - 1.0).abs() < 1e-12);
    }
}
