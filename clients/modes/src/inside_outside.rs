//! Decides whether points are inside of a surface with holes. The winding number is computed only near the surface and its
//! holes; other cells are inside or outside as a whole.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::grid::{Grid, all_offsets, offset_cell};
use crate::winding_number::WindingNumber;

/// Inside tests for one grid.
#[derive(Debug)]
pub struct InsideOutsideTest<'a> {
    grid: &'a Grid,
    winding: &'a WindingNumber,
    /// For each cell, whether all of it is inside or outside; `None` if that depends on the point.
    cells: Vec<Option<bool>>,
}

impl<'a> InsideOutsideTest<'a> {
    /// Classifies the cells. A cell is inside or outside as a whole if no triangle touches it, and the winding numbers at
    /// its center and at those of its neighbors are clearly on the same side of 1/2.
    pub fn new(grid: &'a Grid, winding: &'a WindingNumber) -> Self {
        /// The smallest distance from 1/2 that counts as clear.
        const MARGIN: f64 = 0.2;
        let mut is_touched = vec![false; grid.cell_count()];
        for corners in winding.triangle_corners() {
            let corners = corners.map(|corner| grid.to_cell_units(corner));
            let low = grid.cell_containing(corners[0].inf(&corners[1]).inf(&corners[2]));
            let high = grid.cell_containing(corners[0].sup(&corners[1]).sup(&corners[2]));
            for x in low[0]..=high[0] {
                for y in low[1]..=high[1] {
                    for z in low[2]..=high[2] {
                        is_touched[grid.cell_index([x, y, z])] = true;
                    }
                }
            }
        }
        let center = |cell: [usize; 3]| Vector3::from_fn(|axis, _| cell[axis] as f64 + 0.5);
        let at_center = |index: usize| {
            let winding_number = winding.at(grid.origin + center(grid.cell_at(index)) * grid.cell_size).abs();
            ((winding_number - 0.5).abs() > MARGIN).then_some(winding_number > 0.5)
        };
        let centers: Vec<Option<bool>> = (0..grid.cell_count()).into_par_iter().map(at_center).collect();
        let classify = |index: usize| {
            let own = centers[index].filter(|_| !is_touched[index])?;
            let neighbors = all_offsets().filter_map(|offset| offset_cell(grid, grid.cell_at(index), offset));
            neighbors.into_iter().all(|neighbor| centers[neighbor] == Some(own)).then_some(own)
        };
        let cells = (0..grid.cell_count()).map(classify).collect();
        Self { grid, winding, cells }
    }

    /// Whether a point, in units of cells, is inside.
    pub fn contains(&self, point: Vector3<f64>) -> bool {
        let cell = self.grid.cell_index(self.grid.cell_containing(point));
        let position = self.grid.origin + point * self.grid.cell_size;
        self.cells[cell].unwrap_or_else(|| self.winding.at(position).abs() > 0.5)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Surface;
    use crate::winding_number::tests::ellipsoid;

    /// The classification of cells changes no answer, also near a hole of many triangles.
    #[test]
    fn cells_agree_with_the_winding_number() {
        let (positions, mut triangles) = ellipsoid([0.5, 0.4, 0.3], 40);
        triangles.retain(|triangle| positions[triangle[0] as usize].x < 0.4);
        let surface = Surface::new(&positions, &triangles, &vec![0; triangles.len()]);
        let winding = WindingNumber::new(&surface);
        let grid = Grid::covering(Vector3::repeat(-0.6), Vector3::repeat(0.6), 0.05);
        let test = InsideOutsideTest::new(&grid, &winding);
        let decided = test.cells.iter().filter(|cell| cell.is_some()).count();
        assert!(decided * 3 > test.cells.len(), "control: {decided} of {} cells are decided", test.cells.len());
        let mut random = fastrand::Rng::with_seed(5);
        for _ in 0..5000 {
            let point = Vector3::from_fn(|_, _| 24.0 * random.f64());
            let expected = winding.at(grid.origin + point * grid.cell_size).abs() > 0.5;
            assert_eq!(test.contains(point), expected, "{point:?}");
        }
    }
}
