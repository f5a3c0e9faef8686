//! The regular grid of cubic cells.

use nalgebra::Vector3;

/// Sub-cells per side of a cell. Sub-cells separate disconnected material in a cell.
pub const SUBDIVISIONS: usize = 4;
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
    /// For each axis, the coordinates of rays across it, ascending.
    pub lines: [Vec<RayLine>; 3],
    /// For each axis and layer of cells, the index of its first line; one more entry than layers.
    pub first_lines: [Vec<usize>; 3],
}

/// A coordinate of rays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RayLine {
    /// In units of cells.
    pub position: f64,
    /// The length that the line represents, in units of cells.
    pub weight: f64,
    /// The sub-cell with this coordinate.
    pub sub_cell: usize,
}

impl Grid {
    /// The smallest centered grid with cells of the given size that covers a box. Each sub-cell has two Gauss points per
    /// axis as coordinates of rays.
    pub fn covering(low: Vector3<f64>, high: Vector3<f64>, cell_size: f64) -> Self {
        // A body whose side is a multiple of the cell size gets no additional layer because of rounding.
        let count = |axis: usize| (((high[axis] - low[axis]) / cell_size - 1e-9).ceil() as usize).max(1);
        let cells = [count(0), count(1), count(2)];
        let extent = Vector3::from_fn(|axis, _| cells[axis] as f64 * cell_size);
        let origin = (low + high - extent) / 2.0;
        let grid = Self { origin, cell_size, cells, lines: Default::default(), first_lines: Default::default() };
        grid.with_breaks(&Default::default())
    }

    /// Divides the sub-cells at coordinates of each axis, in meters, and places two Gauss points in each part. Faces of
    /// the body at these coordinates are then integrated exactly, by rays that run parallel to them.
    #[must_use]
    pub fn with_breaks(mut self, breaks: &[Vec<f64>; 3]) -> Self {
        /// Half the distance of the two Gauss points on the interval from -1 to 1.
        const GAUSS: f64 = 0.577_350_269_189_625_8;
        /// Parts that are shorter, in sub-cells, are merged with their neighbor.
        const MIN_PART: f64 = 1e-6;
        /// Grids with fewer cells along an axis have more lines per sub-cell.
        const FEW_CELLS: usize = 8;
        /// Limit on the parts of a sub-cell, apart from breaks.
        const MAX_PARTS: usize = 4;
        for (axis, breaks) in breaks.iter().enumerate() {
            let scale = SUBDIVISIONS as f64 / self.cell_size;
            let mut inner: Vec<f64> = breaks.iter().map(|position| (position - self.origin[axis]) * scale).collect();
            // Bodies with few cells across have finer lines: their curved faces lie along the axes of the grid.
            let parts = (FEW_CELLS / self.cells[axis]).clamp(1, MAX_PARTS);
            let sub_cells = self.cells[axis] * SUBDIVISIONS;
            inner.extend((1..sub_cells * parts).map(|part| part as f64 / parts as f64));
            inner.sort_by(f64::total_cmp);
            let (mut lines, mut first_lines) = (Vec::new(), Vec::new());
            for sub_cell in 0..self.cells[axis] * SUBDIVISIONS {
                if sub_cell.is_multiple_of(SUBDIVISIONS) {
                    first_lines.push(lines.len());
                }
                let [mut start, end] = [sub_cell as f64, (sub_cell + 1) as f64];
                let first_inner = inner.partition_point(|position| *position <= start + MIN_PART);
                let own = inner[first_inner..].iter().copied().take_while(|position| *position < end - MIN_PART);
                for stop in own.chain([end]) {
                    if stop - start <= MIN_PART {
                        continue;
                    }
                    for point in [-GAUSS, GAUSS] {
                        let position =
                            (f64::midpoint(start, stop) + point * (stop - start) / 2.0) / SUBDIVISIONS as f64;
                        let weight = (stop - start) / 2.0 / SUBDIVISIONS as f64;
                        lines.push(RayLine { position, weight, sub_cell });
                    }
                    start = stop;
                }
            }
            first_lines.push(lines.len());
            (self.lines[axis], self.first_lines[axis]) = (lines, first_lines);
        }
        self
    }

    /// The lines of a ray parallel to an axis, across that axis.
    pub fn lines_of(&self, axis: usize, ray: [u32; 2]) -> [RayLine; 2] {
        let [u, v] = cross_axes(axis);
        [self.lines[u][ray[0] as usize], self.lines[v][ray[1] as usize]]
    }

    /// A point in units of cells on a ray.
    pub fn point_on_ray(&self, axis: usize, ray: [u32; 2], position: f64) -> Vector3<f64> {
        let [u, v] = cross_axes(axis);
        let lines = self.lines_of(axis, ray);
        let mut point = Vector3::zeros();
        point[axis] = position;
        (point[u], point[v]) = (lines[0].position, lines[1].position);
        point
    }

    /// The area that a ray represents, in units of cell faces.
    pub fn ray_area(&self, axis: usize, ray: [u32; 2]) -> f64 {
        self.lines_of(axis, ray).iter().map(|line| line.weight).product()
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

/// The two axes across the rays of an axis.
pub const fn cross_axes(axis: usize) -> [usize; 2] {
    [(axis + 1) % 3, (axis + 2) % 3]
}

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

/// The offsets of a cell and its 26 neighbors.
pub fn all_offsets() -> impl Iterator<Item = [i8; 3]> {
    (0..27_i8).map(|index| [index / 9 - 1, index / 3 % 3 - 1, index % 3 - 1])
}

/// The index of the neighbor of a cell; `None` outside of the grid.
pub fn offset_cell(grid: &Grid, cell: [usize; 3], offset: [i8; 3]) -> Option<usize> {
    let mut neighbor = [0; 3];
    for axis in 0..3 {
        neighbor[axis] = cell[axis].checked_add_signed(isize::from(offset[axis]))?;
        if neighbor[axis] >= grid.cells[axis] {
            return None;
        }
    }
    Some(grid.cell_index(neighbor))
}

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

    /// A step function is integrated exactly if its step is a break.
    #[test]
    fn lines_integrate_cubic_polynomials_between_breaks() {
        let grid = Grid::covering(Vector3::zeros(), Vector3::repeat(2.0), 1.0);
        let breaks = [vec![1.3, 1.3, 0.25], vec![], vec![]];
        let integral = |grid: &Grid, low: f64| -> f64 {
            let lines = grid.lines[0].iter().filter(|line| line.position > low);
            lines.map(|line| line.weight * line.position.powi(3)).sum()
        };
        let exact = |low: f64| (16.0 - low.powi(4)) / 4.0;
        assert!((integral(&grid, 0.0) - exact(0.0)).abs() < 1e-12);
        assert!((integral(&grid, 1.3) - exact(1.3)).abs() > 1e-2, "control: without the break");
        let grid = grid.with_breaks(&breaks);
        assert!((integral(&grid, 1.3) - exact(1.3)).abs() < 1e-12);
        assert_eq!((grid.first_lines[0][1], grid.lines[0].len()), (32, 66));
        assert!(grid.lines[0].iter().all(|line| line.sub_cell == (line.position * 4.0) as usize));
    }

    #[test]
    fn neighbors_outside_of_the_grid_do_not_exist() {
        let grid = Grid::covering(Vector3::zeros(), Vector3::repeat(2.0), 1.0);
        assert_eq!(offset_cell(&grid, [0, 0, 1], [0, 0, 1]), None);
        assert_eq!(offset_cell(&grid, [1, 0, 1], [0, 1, -1]), Some(grid.cell_index([1, 1, 0])));
    }
}
