//! The regular grid of cubic cells.

use nalgebra::Vector3;

/// Sub-cells per side of a cell. Pieces of material in a cell are told apart by its sub-cells.
pub const SUBDIVISIONS: usize = 4;
/// Rays per side of a cell: two Gauss points in each sub-cell.
pub const RAYS_PER_CELL: usize = 2 * SUBDIVISIONS;
/// Nodes per side of a cell.
pub const NODES_PER_SIDE: usize = 3;
/// Nodes of a cell.
pub const CELL_NODES: usize = 27;

/// A grid of cubic cells.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// The corner with the smallest coordinates, meters.
    pub origin: Vector3<f64>,
    /// Side of a cell, meters.
    pub cell_size: f64,
    /// Cells per axis.
    pub cells: [usize; 3],
}

impl Grid {
    /// The smallest centered grid with cells of the given size that covers a box.
    pub fn covering(low: Vector3<f64>, high: Vector3<f64>, cell_size: f64) -> Self {
        // A body whose side is a multiple of the cell size gets no additional layer because of rounding.
        let count = |axis: usize| (((high[axis] - low[axis]) / cell_size - 1e-9).ceil() as usize).max(1);
        let cells = [count(0), count(1), count(2)];
        let extent = Vector3::from_fn(|axis, _| cells[axis] as f64 * cell_size);
        Self { origin: (low + high - extent) / 2.0, cell_size, cells }
    }

    /// The number of cells.
    pub fn cell_count(&self) -> usize {
        self.cells.iter().product()
    }

    /// The index of a cell in arrays over all cells. The last axis varies fastest.
    pub const fn cell_index(&self, cell: [usize; 3]) -> usize {
        (cell[0] * self.cells[1] + cell[1]) * self.cells[2] + cell[2]
    }

    /// The coordinates of the cell with an index.
    pub const fn cell_at(&self, index: usize) -> [usize; 3] {
        let row = index / self.cells[2];
        [row / self.cells[1], row % self.cells[1], index % self.cells[2]]
    }

    /// A position in units of cells, relative to the origin.
    pub fn to_cell_units(&self, position: Vector3<f64>) -> Vector3<f64> {
        (position - self.origin) / self.cell_size
    }

    /// The cell that contains a position in units of cells. Positions outside belong to the nearest cell.
    pub fn cell_containing(&self, position: Vector3<f64>) -> [usize; 3] {
        [0, 1, 2].map(|axis| (position[axis].floor().max(0.0) as usize).min(self.cells[axis] - 1))
    }
}

/// The position of ray `index` across a row of cells, in units of cells.
pub fn ray_position(index: usize) -> f64 {
    /// Half the distance of the two Gauss points on the interval from -1 to 1.
    const GAUSS: f64 = 0.577_350_269_189_625_8;
    let offset = if index.is_multiple_of(2) { -GAUSS } else { GAUSS };
    ((index / 2) as f64 + 0.5 + 0.5 * offset) / SUBDIVISIONS as f64
}

/// The weight of a ray: the area that it represents, in units of cell faces.
pub const RAY_WEIGHT: f64 = 1.0 / (RAYS_PER_CELL * RAYS_PER_CELL) as f64;

/// The neighbors of a cell whose index is larger, as offsets: half of the 26 neighbors.
pub const FORWARD_NEIGHBORS: [[i8; 3]; 13] = [
    [0, 0, 1],
    [0, 1, -1],
    [0, 1, 0],
    [0, 1, 1],
    [1, -1, -1],
    [1, -1, 0],
    [1, -1, 1],
    [1, 0, -1],
    [1, 0, 0],
    [1, 0, 1],
    [1, 1, -1],
    [1, 1, 0],
    [1, 1, 1],
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_covers_the_box_and_is_centered() {
        let grid = Grid::covering(Vector3::new(0.0, -1.0, 2.0), Vector3::new(1.0, 1.0, 2.3), 0.25);
        assert_eq!(grid.cells, [4, 8, 2]);
        assert!((grid.origin - Vector3::new(0.0, -1.0, 1.9)).norm() < 1e-12);
        for index in [0, 5, 63] {
            assert_eq!(grid.cell_index(grid.cell_at(index)), index);
        }
        assert_eq!(grid.cell_containing(Vector3::new(-1.0, 3.5, 9.0)), [0, 3, 1]);
    }

    #[test]
    fn rays_integrate_cubic_polynomials_across_a_cell() {
        let rays = (0..RAYS_PER_CELL).map(ray_position);
        let integral: f64 = rays.map(|x| x.powi(3)).sum::<f64>() / RAYS_PER_CELL as f64;
        assert!((integral - 0.25).abs() < 1e-14, "{integral}");
    }
}
