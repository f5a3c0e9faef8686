//! The interpolation of displacements at points of the body.

use nalgebra::Vector3;

use crate::cell_matrices::shape_functions;
use crate::cell_pieces::{CellPiece, CellPieces};
use crate::grid::{CELL_NODES, Grid, SUBDIVISIONS, all_offsets, offset_cell};

/// Coordinates in a cell are limited to this magnitude. Beyond 1, a point lies outside of the cell, and its displacement
/// is extrapolated.
const MAX_LOCAL_COORDINATE: f64 = 1.5;

/// A point of the body: a piece and the weights of its nodes.
#[derive(Debug, Clone, PartialEq)]
pub struct EmbeddedPoint {
    pub piece: usize,
    pub weights: [f64; CELL_NODES],
}

/// Finds the piece at `point`, in units of cells: the one whose sub-cells are closest. `None` if the closest one is farther
/// than a cell.
pub fn embed(grid: &Grid, pieces: &CellPieces, point: Vector3<f64>) -> Option<EmbeddedPoint> {
    let cell = grid.cell_containing(point);
    let own = pieces.in_cell(grid.cell_index(cell));
    let (piece, _) = closest_piece(grid, own, point)
        .filter(|(_, distance)| *distance == 0.0)
        .or_else(|| closest_piece(grid, neighborhood(grid, cell).flat_map(|cell| pieces.in_cell(cell)), point))
        .filter(|(_, squared_distance)| *squared_distance <= 1.0)?;
    let base = grid.cell_at(pieces.pieces[piece].cell);
    let local = [0, 1, 2]
        .map(|axis| (2.0 * (point[axis] - base[axis] as f64) - 1.0).clamp(-MAX_LOCAL_COORDINATE, MAX_LOCAL_COORDINATE));
    Some(EmbeddedPoint { piece, weights: shape_functions(local) })
}

/// The piece with the smallest distance to the point, and the squared distance.
fn closest_piece(
    grid: &Grid,
    candidates: impl Iterator<Item = (usize, CellPiece)>,
    point: Vector3<f64>,
) -> Option<(usize, f64)> {
    let distances = candidates.map(|(index, piece)| (index, squared_distance(grid, piece, point)));
    distances.min_by(|(_, a), (_, b)| a.total_cmp(b))
}

/// A cell and its 26 neighbors.
fn neighborhood(grid: &Grid, cell: [usize; 3]) -> impl Iterator<Item = usize> {
    all_offsets().filter_map(move |offset| offset_cell(grid, cell, offset))
}

/// The squared distance of a point from the sub-cells of a piece, in cells.
fn squared_distance(grid: &Grid, piece: CellPiece, point: Vector3<f64>) -> f64 {
    let base = grid.cell_at(piece.cell);
    let side = 1.0 / SUBDIVISIONS as f64;
    let distances = (0..SUBDIVISIONS.pow(3)).filter(|bit| piece.sub_cells >> bit & 1 == 1).map(|bit| {
        let sub_cell = [bit / (SUBDIVISIONS * SUBDIVISIONS), bit / SUBDIVISIONS % SUBDIVISIONS, bit % SUBDIVISIONS];
        let gap = |axis: usize| {
            let low = base[axis] as f64 + sub_cell[axis] as f64 * side;
            (low - point[axis]).max(point[axis] - low - side).max(0.0)
        };
        (0..3).map(|axis| gap(axis).powi(2)).sum()
    });
    distances.fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell_matrices::node_coordinates;
    use crate::material_rays::trace_rays;
    use crate::surface::Surface;
    use crate::surface::tests::box_surface;

    /// The weights reproduce the position of the point, also outside of all pieces.
    #[test]
    fn weights_reproduce_the_point_also_outside() {
        let (positions, triangles) = box_surface([0.0; 3], [2.3, 1.1, 0.4]);
        let surface = Surface::new(&positions, &triangles, &[0; 12]);
        let (low, high) = surface.bounds();
        let grid = Grid::covering(low, high, 0.5);
        let segments = [0, 1, 2].map(|axis| trace_rays(&surface, &grid, axis, None));
        let pieces = CellPieces::new(&grid, &surface, &segments);
        for position in [[0.0, 0.0, 0.0], [2.3, 1.1, 0.4], [1.0, -0.05, 0.2], [2.31, 0.55, 0.39]] {
            let point = grid.to_cell_units(position.into());
            let embedded = embed(&grid, &pieces, point).expect("a piece");
            let base = grid.cell_at(pieces.pieces[embedded.piece].cell);
            let node = |index: usize| {
                let local = node_coordinates(index);
                Vector3::from_fn(|axis, _| base[axis] as f64 + local[axis] as f64 / 2.0)
            };
            let sum: Vector3<f64> = (0..CELL_NODES).map(|index| node(index) * embedded.weights[index]).sum();
            assert!((sum - point).norm() < 1e-12, "{position:?}: {sum:?} instead of {point:?}");
        }
        let far = grid.to_cell_units(Vector3::new(4.0, 0.5, 0.2));
        assert_eq!(embed(&grid, &pieces, far), None, "a point of no piece");
    }
}
