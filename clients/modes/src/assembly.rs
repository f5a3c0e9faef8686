//! Stiffness and mass of the whole body as sparse block matrices.

use faer::sparse::{SparseColMat, SymbolicSparseColMat};
use rayon::prelude::*;

/// The number of a node that is held: it has no row and no column.
pub const HELD_NODE: u32 = u32::MAX;

/// A 3 x 3 block, row-major.
type Block = [f64; 9];

/// The matrices of the body. Rows and columns are nodes; each has three freedoms `3 node + axis`.
#[derive(Debug)]
pub struct SystemMatrices {
    /// For each node, the start of its neighbors; one more entry than nodes.
    offsets: Vec<usize>,
    /// Neighbors of the nodes, ascending, including the node itself.
    neighbors: Vec<u32>,
    /// Stiffness between a node and each neighbor, newtons per meter.
    stiffness: Vec<Block>,
    /// Mass between a node and each neighbor, kilograms; the same for all three axes.
    mass: Vec<f64>,
}

impl SystemMatrices {
    /// Adds the matrices of all elements. `nodes` are the nodes of each element; [`HELD_NODE`] has no freedoms.
    /// `matrices` gives the stiffness of an element (row-major, 3 `N` squared, freedom `3 node + axis`) and its mass
    /// (row-major, `N` squared). The result does not depend on the number of threads, because each row adds its
    /// elements in their order.
    pub fn assemble<'a, const N: usize>(
        nodes: &[[u32; N]],
        node_count: usize,
        matrices: impl Fn(usize) -> (&'a [f64], &'a [f64]) + Sync,
    ) -> Self {
        let mut elements_of_node: Vec<Vec<(u32, u8)>> = vec![Vec::new(); node_count];
        for (element, element_nodes) in nodes.iter().enumerate() {
            for (local, node) in element_nodes.iter().enumerate().filter(|(_, node)| **node != HELD_NODE) {
                elements_of_node[*node as usize].push((element as u32, local as u8));
            }
        }
        let rows: Vec<(Vec<u32>, Vec<Block>, Vec<f64>)> = elements_of_node
            .par_iter()
            .map(|elements| {
                let mut neighbors: Vec<u32> =
                    elements.iter().flat_map(|(element, _)| nodes[*element as usize]).collect();
                neighbors.retain(|node| *node != HELD_NODE);
                neighbors.sort_unstable();
                neighbors.dedup();
                let mut stiffness = vec![[0.0; 9]; neighbors.len()];
                let mut mass = vec![0.0; neighbors.len()];
                for (element, row) in elements {
                    let row = usize::from(*row);
                    let (element_stiffness, element_mass) = matrices(*element as usize);
                    for (column, neighbor) in nodes[*element as usize].iter().enumerate() {
                        let Ok(index) = neighbors.binary_search(neighbor) else { continue };
                        mass[index] += element_mass[row * N + column];
                        for (entry, sum) in stiffness[index].iter_mut().enumerate() {
                            *sum += element_stiffness[(3 * row + entry / 3) * 3 * N + 3 * column + entry % 3];
                        }
                    }
                }
                (neighbors, stiffness, mass)
            })
            .collect();
        let mut system = Self { offsets: vec![0], neighbors: Vec::new(), stiffness: Vec::new(), mass: Vec::new() };
        for (neighbors, stiffness, mass) in rows {
            system.neighbors.extend(neighbors);
            system.stiffness.extend(stiffness);
            system.mass.extend(mass);
            system.offsets.push(system.neighbors.len());
        }
        system
    }

    /// The number of freedoms.
    pub fn freedoms(&self) -> usize {
        3 * (self.offsets.len() - 1)
    }

    /// K u.
    pub fn apply_stiffness(&self, u: &[f64]) -> Vec<f64> {
        let rows = (0..self.offsets.len() - 1).into_par_iter().flat_map_iter(|node| {
            let mut sums = [0.0; 3];
            for index in self.offsets[node]..self.offsets[node + 1] {
                let block = &self.stiffness[index];
                let neighbor = 3 * self.neighbors[index] as usize;
                for (axis, sum) in sums.iter_mut().enumerate() {
                    *sum += (0..3).map(|column| block[3 * axis + column] * u[neighbor + column]).sum::<f64>();
                }
            }
            sums
        });
        rows.collect()
    }

    /// M u.
    pub fn apply_mass(&self, u: &[f64]) -> Vec<f64> {
        let rows = (0..self.offsets.len() - 1).into_par_iter().flat_map_iter(|node| {
            let mut sums = [0.0; 3];
            for index in self.offsets[node]..self.offsets[node + 1] {
                let neighbor = 3 * self.neighbors[index] as usize;
                for (axis, sum) in sums.iter_mut().enumerate() {
                    *sum += self.mass[index] * u[neighbor + axis];
                }
            }
            sums
        });
        rows.collect()
    }

    /// The lower triangle of K + shift M.
    pub fn shifted_stiffness(&self, shift: f64) -> SparseColMat<usize, f64> {
        let freedoms = self.freedoms();
        let mut column_starts = vec![0];
        let (mut rows, mut values) = (Vec::new(), Vec::new());
        for column in 0..freedoms {
            let (node, axis) = (column / 3, column % 3);
            for index in self.offsets[node]..self.offsets[node + 1] {
                let neighbor = 3 * self.neighbors[index] as usize;
                for row_axis in (0..3).filter(|row_axis| neighbor + row_axis >= column) {
                    rows.push(neighbor + row_axis);
                    // The block of the pair in the row of this node is the transpose of the column's block.
                    let mass = if row_axis == axis { shift * self.mass[index] } else { 0.0 };
                    values.push(self.stiffness[index][3 * axis + row_axis] + mass);
                }
            }
            column_starts.push(rows.len());
        }
        let symbolic = SymbolicSparseColMat::new_checked(freedoms, freedoms, column_starts, None, rows);
        SparseColMat::new(symbolic, values)
    }
}

/// The dot product of two vectors.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
