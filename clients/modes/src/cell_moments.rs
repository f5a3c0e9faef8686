//! Moments of the material in each piece: integrals of products of Legendre polynomials up to degree 4 per axis. They
//! determine the matrices of a 27-node cell exactly, because products of its shape functions have this degree.

use crate::cell_pieces::{CellPieces, sub_cell_bit};
use crate::grid::{Grid, SUBDIVISIONS, cross_axes};
use crate::material_rays::RaySegment;

/// Polynomials per axis: degrees 0 to 4.
pub const DEGREES: usize = 5;
/// Moments of a piece.
pub const MOMENTS: usize = DEGREES * DEGREES * DEGREES;

/// The moments of the material of one group in one piece, on the cell from -1 to 1. Index `(i * 5 + j) * 5 + k` is the
/// integral of P_i(x) P_j(y) P_k(z).
#[derive(Debug, Clone, PartialEq)]
pub struct GroupMoments {
    pub group: u32,
    pub moments: [f64; MOMENTS],
}

impl GroupMoments {
    /// The material's share of the volume of the cell.
    pub const fn volume_fraction(&self) -> f64 {
        self.moments[0] / 8.0
    }
}

/// The moments of each piece, by group.
pub fn integrate(grid: &Grid, pieces: &CellPieces, segments: &[Vec<RaySegment>; 3]) -> Vec<Vec<GroupMoments>> {
    let axis_of_cell = choose_axes(grid, segments);
    let mut moments: Vec<Vec<GroupMoments>> = vec![Vec::new(); pieces.pieces.len()];
    for (axis, segments) in segments.iter().enumerate() {
        let [u, v] = cross_axes(axis);
        for segment in segments {
            let first = segment.start.floor().max(0.0) as usize;
            let stop = (segment.end.ceil().max(0.0) as usize).min(grid.cells[axis]);
            let mut cell = [0; 3];
            [cell[u], cell[v]] = grid.lines_of(axis, segment.ray).map(|line| line.sub_cell / SUBDIVISIONS);
            for position in first..stop {
                cell[axis] = position;
                let index = grid.cell_index(cell);
                if usize::from(axis_of_cell[index]) == axis {
                    add_ray(grid, pieces, index, position, axis, segment, &mut moments);
                }
            }
        }
    }
    moments
}

/// Adds the part of a segment in one cell. `position` is the cell's coordinate along the axis.
fn add_ray(
    grid: &Grid,
    pieces: &CellPieces,
    cell: usize,
    position: usize,
    axis: usize,
    segment: &RaySegment,
    moments: &mut [Vec<GroupMoments>],
) {
    let [u, v] = cross_axes(axis);
    let mut sub_cell = [0; 3];
    let lines = grid.lines_of(axis, segment.ray);
    [sub_cell[u], sub_cell[v]] = lines.map(|line| line.sub_cell);
    let across = lines.map(|line| legendre(2.0 * (line.position - (line.sub_cell / SUBDIVISIONS) as f64) - 1.0));
    // Areas from -1 to 1 are four times as large as those in units of cells.
    let area = 4.0 * lines[0].weight * lines[1].weight;
    for (piece, cell_piece) in pieces.in_cell(cell) {
        let mut along = [0.0; DEGREES];
        let mut is_hit = false;
        for division in 0..SUBDIVISIONS {
            sub_cell[axis] = position * SUBDIVISIONS + division;
            if cell_piece.sub_cells & sub_cell_bit(sub_cell) == 0 {
                continue;
            }
            let low = sub_cell[axis] as f64 / SUBDIVISIONS as f64;
            let start = segment.start.max(low);
            let end = segment.end.min(low + 1.0 / SUBDIVISIONS as f64);
            if end > start {
                is_hit = true;
                let [start, end] = [start, end].map(|coordinate| 2.0 * (coordinate - position as f64) - 1.0);
                let [at_start, at_end] = [start, end].map(legendre_antiderivatives);
                (0..DEGREES).for_each(|degree| along[degree] += at_end[degree] - at_start[degree]);
            }
        }
        if !is_hit {
            continue;
        }
        let groups = &mut moments[piece];
        let existing = groups.iter().position(|entry| entry.group == segment.group);
        let group = existing.unwrap_or_else(|| {
            groups.push(GroupMoments { group: segment.group, moments: [0.0; MOMENTS] });
            groups.len() - 1
        });
        let sums = &mut groups[group].moments;
        // The strides of the three axes in the array of moments.
        let strides = [DEGREES * DEGREES, DEGREES, 1];
        for (i, across_u) in across[0].iter().enumerate() {
            for (j, across_v) in across[1].iter().enumerate() {
                let weight = area * across_u * across_v;
                for (k, integral) in along.iter().enumerate() {
                    sums[i * strides[u] + j * strides[v] + k * strides[axis]] += weight * integral;
                }
            }
        }
    }
}

/// The axis whose rays are integrated in each cell: the one that sees the largest projected area of the surface. Thin walls parallel to the rays would otherwise be missed.
fn choose_axes(grid: &Grid, segments: &[Vec<RaySegment>; 3]) -> Vec<u8> {
    let mut crossings = vec![[0.0_f32; 3]; grid.cell_count()];
    for (axis, segments) in segments.iter().enumerate() {
        let [u, v] = cross_axes(axis);
        for segment in segments {
            let mut cell = [0; 3];
            [cell[u], cell[v]] = grid.lines_of(axis, segment.ray).map(|line| line.sub_cell / SUBDIVISIONS);
            // An end on the face between two cells belongs to the cell with the material.
            for position in [segment.start.floor(), segment.end.ceil() - 1.0] {
                cell[axis] = (position.max(0.0) as usize).min(grid.cells[axis] - 1);
                crossings[grid.cell_index(cell)][axis] += grid.ray_area(axis, segment.ray) as f32;
            }
        }
    }
    let best_axis = |areas: [f32; 3]| (0..3).rev().max_by(|a, b| areas[*a].total_cmp(&areas[*b])).unwrap_or(0) as u8;
    crossings.into_iter().map(best_axis).collect()
}

/// The Legendre polynomials of degree 0 to 4.
pub fn legendre(x: f64) -> [f64; DEGREES] {
    let [x2, x3, x4] = [2, 3, 4].map(|power| x.powi(power));
    [1.0, x, 1.5 * x2 - 0.5, 2.5 * x3 - 1.5 * x, 4.375 * x4 - 3.75 * x2 + 0.375]
}

/// Antiderivatives of the Legendre polynomials of degree 0 to 4.
fn legendre_antiderivatives(x: f64) -> [f64; DEGREES] {
    let [x2, x3, x4, x5] = [2, 3, 4, 5].map(|power| x.powi(power));
    [x, x2 / 2.0, (x3 - x) / 2.0, 0.625 * x4 - 0.75 * x2, 0.875 * x5 - 1.25 * x3 + 0.375 * x]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::material_rays::trace_rays;
    use crate::surface::Surface;
    use crate::surface::tests::box_surface;

    /// Boxes that cut all cells, thin along each axis in turn: the integrals are known.
    #[test]
    fn moments_of_boxes_are_exact() {
        for axis in 0..3 {
            let mut high = [2.0; 3];
            high[axis] = 0.1;
            let (positions, triangles) = box_surface([0.0; 3], high);
            let surface = Surface::new(&positions, &triangles, &[0; 12]);
            let (low, high) = surface.bounds();
            let grid = Grid::covering(low, high, 1.0);
            let segments = [0, 1, 2].map(|axis| trace_rays(&surface, &grid, axis, None));
            let pieces = CellPieces::new(&grid, &surface, &segments);
            let moments = integrate(&grid, &pieces, &segments);
            assert_eq!(moments.len(), 4);
            for groups in &moments {
                let [group] = &groups[..] else { panic!("one group") };
                assert!((group.volume_fraction() - 0.1).abs() < 1e-12, "axis {axis}: {}", group.volume_fraction());
                // The box is centered in its layer of cells, so that odd moments vanish.
                let stride = [25, 5, 1][axis];
                let second = 4.0 * 2.0 * (0.5 * 0.1_f64.powi(3) - 0.5 * 0.1);
                assert!(group.moments[stride].abs() < 1e-12 && (group.moments[2 * stride] - second).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn antiderivatives_belong_to_the_polynomials() {
        for x in [-0.9, -0.2, 0.4, 1.0] {
            let step = 1e-5;
            let [above, below] = [x + step, x - step].map(legendre_antiderivatives);
            for (degree, value) in legendre(x).into_iter().enumerate() {
                assert!(((above[degree] - below[degree]) / (2.0 * step) - value).abs() < 1e-8, "degree {degree}");
            }
        }
    }
}
