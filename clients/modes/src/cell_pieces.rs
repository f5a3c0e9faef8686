//! Connected pieces of material in each cell, and parts: connected sets of pieces.
//!
//! Two walls that pass through the same cell without touching must not share the nodes of that cell. Each of them is a
//! piece with nodes of its own, and the nodes of neighboring pieces are merged only where the pieces are connected.
//! Connections are found on sub-cells, so that walls closer than a sub-cell are joined.

use std::collections::HashMap;

use crate::grid::{CELL_NODES, FORWARD_NEIGHBORS, Grid, NODES_PER_SIDE, SUBDIVISIONS};
use crate::material_rays::{RaySegment, cross_axes};

/// Sub-cells of a cell, one bit each. Bit `(x * 4 + y) * 4 + z` is the sub-cell (x, y, z).
pub type SubCells = u64;

/// The connected material in one cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellPiece {
    /// The index of the cell.
    pub cell: usize,
    /// The sub-cells that the material touches.
    pub sub_cells: SubCells,
}

/// All pieces of a body. Pieces of one cell follow each other.
#[derive(Debug, Default)]
pub struct CellPieces {
    pub pieces: Vec<CellPiece>,
    /// For each cell with material, its range in `pieces`.
    pub of_cell: HashMap<usize, std::ops::Range<usize>>,
    /// Nodes of each piece. The last axis varies fastest.
    pub nodes: Vec<[u32; CELL_NODES]>,
    pub node_count: usize,
    /// The part of each piece.
    pub parts: Vec<u32>,
    pub part_count: usize,
}

impl CellPieces {
    /// Divides the material that rays of the three axes found.
    pub fn new(grid: &Grid, segments: &[Vec<RaySegment>; 3]) -> Self {
        let occupancy = occupied_sub_cells(grid, segments);
        let mut pieces = Self::default();
        for (cell, sub_cells) in occupancy.into_iter().enumerate().filter(|(_, sub_cells)| *sub_cells != 0) {
            let start = pieces.pieces.len();
            let connected = split_connected(sub_cells);
            pieces.pieces.extend(connected.into_iter().map(|sub_cells| CellPiece { cell, sub_cells }));
            pieces.of_cell.insert(cell, start..pieces.pieces.len());
        }
        pieces.connect(grid);
        pieces
    }

    /// The sub-cells of a cell and the piece that each belongs to.
    pub fn in_cell(&self, cell: usize) -> impl Iterator<Item = (usize, CellPiece)> + '_ {
        let range = self.of_cell.get(&cell).cloned().unwrap_or_default();
        range.map(|index| (index, self.pieces[index]))
    }

    /// Keeps the pieces with a flag. The remaining parts and nodes are numbered anew.
    #[must_use]
    pub fn retain(&self, grid: &Grid, keep: &[bool]) -> Self {
        let mut pieces = Self::default();
        for (piece, _) in self.pieces.iter().zip(keep).filter(|(_, keep)| **keep) {
            let index = pieces.pieces.len();
            pieces.of_cell.entry(piece.cell).or_insert(index..index).end = index + 1;
            pieces.pieces.push(*piece);
        }
        pieces.connect(grid);
        pieces
    }

    /// Merges the nodes of connected pieces, and numbers nodes and parts.
    fn connect(&mut self, grid: &Grid) {
        let mut part_sets = DisjointSets::new(self.pieces.len());
        let mut node_sets = DisjointSets::new(CELL_NODES * self.pieces.len());
        let neighbors = FORWARD_NEIGHBORS.map(|offset| (offset, contact_masks(offset), shared_nodes(offset)));
        for (index, piece) in self.pieces.iter().enumerate() {
            let cell = grid.cell_at(piece.cell);
            for (offset, contacts, shared) in &neighbors {
                let Some(neighbor_cell) = offset_cell(grid, cell, *offset) else { continue };
                for (neighbor, other) in self.in_cell(neighbor_cell) {
                    let touches = |(own, others): &(SubCells, SubCells)| {
                        piece.sub_cells & own != 0 && other.sub_cells & others != 0
                    };
                    if contacts.iter().any(touches) {
                        part_sets.merge(index, neighbor);
                        for [own_node, other_node] in shared {
                            node_sets.merge(CELL_NODES * index + own_node, CELL_NODES * neighbor + other_node);
                        }
                    }
                }
            }
        }
        let (node_numbers, node_count) = node_sets.into_numbers();
        self.nodes = node_numbers.as_chunks::<CELL_NODES>().0.to_vec();
        self.node_count = node_count;
        (self.parts, self.part_count) = part_sets.into_numbers();
    }
}

/// The sub-cells with material, for each cell of the grid.
fn occupied_sub_cells(grid: &Grid, segments: &[Vec<RaySegment>; 3]) -> Vec<SubCells> {
    /// Material shorter than this, in sub-cells, is ignored: rounding at a face between two sub-cells.
    const TOLERANCE: f64 = 1e-6;
    let mut occupancy = vec![0; grid.cell_count()];
    for (axis, segments) in segments.iter().enumerate() {
        let [u, v] = cross_axes(axis);
        for segment in segments {
            let [start, end] = [segment.start, segment.end].map(|position| position * SUBDIVISIONS as f64);
            let first = (start + TOLERANCE).floor().max(0.0) as usize;
            let stop = ((end - TOLERANCE).ceil().max(0.0) as usize).min(grid.cells[axis] * SUBDIVISIONS);
            let mut sub_cell = [0; 3];
            [sub_cell[u], sub_cell[v]] = segment.ray.map(|ray| ray as usize / 2);
            for position in first..stop {
                sub_cell[axis] = position;
                occupancy[grid.cell_index(sub_cell.map(|index| index / SUBDIVISIONS))] |= sub_cell_bit(sub_cell);
            }
        }
    }
    occupancy
}

/// The bit of a sub-cell in its cell. Coordinates are those in the whole grid.
pub fn sub_cell_bit(sub_cell: [usize; 3]) -> SubCells {
    let [x, y, z] = sub_cell.map(|index| index % SUBDIVISIONS);
    1 << ((x * SUBDIVISIONS + y) * SUBDIVISIONS + z)
}

/// Divides a set of sub-cells into sets that are connected by faces, edges or corners.
fn split_connected(mut sub_cells: SubCells) -> Vec<SubCells> {
    let mut connected = Vec::new();
    while sub_cells != 0 {
        let mut set = sub_cells & sub_cells.wrapping_neg();
        loop {
            let grown = dilate(set) & sub_cells;
            if grown == set {
                break;
            }
            set = grown;
        }
        connected.push(set);
        sub_cells &= !set;
    }
    connected
}

/// Adds all neighbors of the sub-cells, within the cell.
const fn dilate(sub_cells: SubCells) -> SubCells {
    /// The sub-cells with z = 0, and those with y = 0.
    const LOW_Z: SubCells = 0x1111_1111_1111_1111;
    const LOW_Y: SubCells = 0x000f_000f_000f_000f;
    let z = sub_cells | ((sub_cells << 1) & !LOW_Z) | ((sub_cells >> 1) & !(LOW_Z << 3));
    let y = z | ((z << 4) & !LOW_Y) | ((z >> 4) & !(LOW_Y << 12));
    y | (y << 16) | (y >> 16)
}

/// Pairs of neighboring sub-cells of a cell and of its neighbor. The first set has one sub-cell, the second set contains
/// its neighbors.
fn contact_masks(offset: [i8; 3]) -> Vec<(SubCells, SubCells)> {
    const SIDE: i32 = SUBDIVISIONS as i32;
    let all = (0..SIDE).flat_map(|x| (0..SIDE).flat_map(move |y| (0..SIDE).map(move |z| [x, y, z])));
    let bit = |sub_cell: [i32; 3]| sub_cell_bit(sub_cell.map(|index| index as usize));
    let neighbors_of = |own: [i32; 3]| {
        let is_neighbor =
            |other: &[i32; 3]| (0..3).all(|axis| (other[axis] + SIDE * i32::from(offset[axis]) - own[axis]).abs() <= 1);
        all.clone().filter(is_neighbor).fold(0, |mask, other| mask | bit(other))
    };
    all.clone().map(|own| (bit(own), neighbors_of(own))).filter(|(_, others)| *others != 0).collect()
}

/// Pairs of nodes of a cell and of its neighbor that have the same position.
fn shared_nodes(offset: [i8; 3]) -> Vec<[usize; 2]> {
    let local_node = |[x, y, z]: [usize; 3]| (x * NODES_PER_SIDE + y) * NODES_PER_SIDE + z;
    let coordinates = (0..CELL_NODES).map(|node| [node / 9, node / 3 % 3, node % 3]);
    let pair = |own: [usize; 3]| {
        let mut other = own;
        for axis in 0..3 {
            other[axis] = match (offset[axis], own[axis]) {
                (0, index) => index,
                (1, 2) => 0,
                (-1, 0) => 2,
                _ => return None,
            };
        }
        Some([local_node(own), local_node(other)])
    };
    coordinates.filter_map(pair).collect()
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

/// Disjoint sets of indices (union-find), represented by their smallest members.
struct DisjointSets(Vec<u32>);

impl DisjointSets {
    fn new(count: usize) -> Self {
        Self((0..count as u32).collect())
    }

    fn find(&mut self, mut index: usize) -> usize {
        while self.0[index] as usize != index {
            self.0[index] = self.0[self.0[index] as usize];
            index = self.0[index] as usize;
        }
        index
    }

    fn merge(&mut self, a: usize, b: usize) {
        let [a, b] = [self.find(a), self.find(b)];
        self.0[a.max(b)] = a.min(b) as u32;
    }

    /// The number of the set of each index, in the order of their first members, and the number of sets.
    fn into_numbers(mut self) -> (Vec<u32>, usize) {
        let mut count = 0;
        for index in 0..self.0.len() {
            // The smallest member of the set already has its number if it is not this index.
            let root = self.0[index] as usize;
            self.0[index] = if root == index {
                count += 1;
                count - 1
            } else {
                self.0[root]
            };
        }
        (self.0, count as usize)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::material_rays::trace_rays;
    use crate::surface::Surface;
    use crate::surface::tests::box_surface;

    fn pieces_of(boxes: &[([f64; 3], [f64; 3])], cell_size: f64) -> CellPieces {
        let (mut positions, mut triangles) = (vec![], vec![]);
        for (low, high) in boxes {
            let (corners, faces) = box_surface(*low, *high);
            let first = positions.len() as u32;
            positions.extend(corners);
            triangles.extend(faces.iter().map(|face| face.map(|vertex| vertex + first)));
        }
        let surface = Surface::new(&positions, &triangles, &vec![0; triangles.len()]);
        let (low, high) = surface.bounds();
        let grid = Grid::covering(low, high, cell_size);
        let segments = [0, 1, 2].map(|axis| trace_rays(&surface, &grid, axis, None));
        CellPieces::new(&grid, &segments)
    }

    #[test]
    fn box_of_whole_cells_has_the_nodes_of_its_grid() {
        let pieces = pieces_of(&[([0.0; 3], [3.0, 2.0, 1.0])], 1.0);
        assert_eq!((pieces.pieces.len(), pieces.part_count), (6, 1));
        assert_eq!(pieces.node_count, 7 * 5 * 3);
    }

    /// Two plates whose gap is half a cell, inside one layer of cells.
    #[test]
    fn plates_in_the_same_cells_are_parts_with_their_own_nodes() {
        let plates = [([0.0; 3], [3.0, 3.0, 0.25]), ([0.0, 0.0, 0.75], [3.0, 3.0, 1.0])];
        let pieces = pieces_of(&plates, 1.0);
        assert_eq!((pieces.pieces.len(), pieces.part_count), (18, 2));
        assert_eq!(pieces.node_count, 2 * 7 * 7 * 3);
        let with_bridge = [&plates[..], &[([0.0; 3], [0.5, 0.5, 1.0])]].concat();
        assert_eq!(pieces_of(&with_bridge, 1.0).part_count, 1, "control: a bridge connects both");
    }

    #[test]
    fn dilation_stays_within_the_cell() {
        let corner = sub_cell_bit([3, 3, 3]);
        assert_eq!(dilate(corner).count_ones(), 8);
        assert_eq!(dilate(sub_cell_bit([1, 2, 0])).count_ones(), 18);
        assert_eq!(split_connected(sub_cell_bit([0, 0, 0]) | sub_cell_bit([1, 1, 1]) | corner).len(), 2);
    }

    #[test]
    fn numbers_of_sets_ascend_with_their_first_members() {
        let mut sets = DisjointSets::new(6);
        sets.merge(4, 1);
        sets.merge(5, 4);
        sets.merge(2, 3);
        assert_eq!(sets.into_numbers(), (vec![0, 1, 2, 2, 1, 1], 4 - 1));
    }

    #[test]
    fn neighbors_outside_of_the_grid_do_not_exist() {
        let grid = Grid::covering(Vector3::zeros(), Vector3::repeat(2.0), 1.0);
        assert_eq!(offset_cell(&grid, [0, 0, 1], [0, 0, 1]), None);
        assert_eq!(offset_cell(&grid, [1, 0, 1], [0, 1, -1]), Some(grid.cell_index([1, 1, 0])));
    }
}
