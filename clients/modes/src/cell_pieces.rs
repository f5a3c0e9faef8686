//! Connected pieces of material in each cell, and parts: connected sets of pieces.
//!
//! Two walls that pass through the same cell without touching must not share the nodes of that cell. Each of them is a
//! piece with nodes of its own, and the nodes of neighboring pieces are merged only where the pieces are connected.
//!
//! Connections are found on sub-cells. Two sub-cells with material that share a face are connected unless rays leave the
//! material in one and enter it in the other, and no ray passes through the face inside of material. Sub-cells that share
//! only an edge or a corner are connected if all sub-cells between them are empty. Walls are therefore told apart if no
//! sub-cell contains both.

use std::collections::HashMap;

use crate::disjoint_sets::DisjointSets;
use crate::grid::{CELL_NODES, FORWARD_NEIGHBORS, Grid, NODES_PER_SIDE, SUBDIVISIONS, all_offsets, cross_axes};
use crate::material_rays::RaySegment;

/// Sub-cells of a cell, one bit each. Bit `(x * 4 + y) * 4 + z` is the sub-cell (x, y, z).
pub type SubCells = u64;

/// Sub-cells of a cell.
const SUB_CELLS: usize = 64;

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
    /// Connected pieces of neighboring cells, and the offset from the first cell to the second.
    links: Vec<(u32, u32, [i8; 3])>,
}

impl CellPieces {
    /// Divides the material that rays of the three axes found.
    pub fn new(grid: &Grid, segments: &[Vec<RaySegment>; 3]) -> Self {
        let contacts = SubCellContacts::new(grid, segments);
        let mut sets = DisjointSets::new(SUB_CELLS * contacts.cells.len());
        let mut links = Vec::new();
        contacts.for_each_connection(grid, |own, other, offset| {
            let [own_cell, other_cell] = [own / SUB_CELLS, other / SUB_CELLS];
            match own_cell == other_cell {
                true => sets.merge(own, other),
                false => links.push((own, other, offset)),
            }
        });
        let mut pieces = Self::default();
        let mut piece_of_set = HashMap::new();
        for (slot, cell) in contacts.cells.iter().enumerate() {
            let start = pieces.pieces.len();
            for bit in (0..SUB_CELLS).filter(|bit| cell.occupied >> bit & 1 == 1) {
                let piece = *piece_of_set.entry(sets.find(SUB_CELLS * slot + bit)).or_insert_with(|| {
                    pieces.pieces.push(CellPiece { cell: cell.index, sub_cells: 0 });
                    pieces.pieces.len() - 1
                });
                pieces.pieces[piece].sub_cells |= 1 << bit;
            }
            pieces.of_cell.insert(cell.index, start..pieces.pieces.len());
        }
        let mut piece_of = |sub_cell: usize| piece_of_set[&sets.find(sub_cell)] as u32;
        pieces.links = links.into_iter().map(|(own, other, offset)| (piece_of(own), piece_of(other), offset)).collect();
        pieces.links.sort_unstable();
        pieces.links.dedup();
        pieces.connect();
        pieces
    }

    /// The sub-cells of a cell and the piece that each belongs to.
    pub fn in_cell(&self, cell: usize) -> impl Iterator<Item = (usize, CellPiece)> + '_ {
        let range = self.of_cell.get(&cell).cloned().unwrap_or_default();
        range.map(|index| (index, self.pieces[index]))
    }

    /// Keeps the pieces with a flag. The remaining parts and nodes are numbered anew.
    #[must_use]
    pub fn retain(&self, keep: &[bool]) -> Self {
        let mut pieces = Self::default();
        let mut new_indices = vec![None; self.pieces.len()];
        for (old, piece) in self.pieces.iter().enumerate().filter(|(old, _)| keep[*old]) {
            let index = pieces.pieces.len();
            new_indices[old] = Some(index as u32);
            pieces.of_cell.entry(piece.cell).or_insert(index..index).end = index + 1;
            pieces.pieces.push(*piece);
        }
        let renumbered = |(own, other, offset): &(u32, u32, [i8; 3])| {
            Some((new_indices[*own as usize]?, new_indices[*other as usize]?, *offset))
        };
        pieces.links = self.links.iter().filter_map(renumbered).collect();
        pieces.connect();
        pieces
    }

    /// Merges the nodes of connected pieces, and numbers nodes and parts.
    fn connect(&mut self) {
        let mut part_sets = DisjointSets::new(self.pieces.len());
        let mut node_sets = DisjointSets::new(CELL_NODES * self.pieces.len());
        let shared_nodes: HashMap<[i8; 3], Vec<[usize; 2]>> =
            all_offsets().map(|offset| (offset, shared_nodes(offset))).collect();
        for (own, other, offset) in &self.links {
            let [own, other] = [*own as usize, *other as usize];
            part_sets.merge(own, other);
            for [own_node, other_node] in &shared_nodes[offset] {
                node_sets.merge(CELL_NODES * own + own_node, CELL_NODES * other + other_node);
            }
        }
        let (node_numbers, node_count) = node_sets.into_numbers();
        self.nodes = node_numbers.as_chunks::<CELL_NODES>().0.to_vec();
        self.node_count = node_count;
        (self.parts, self.part_count) = part_sets.into_numbers();
    }
}

/// The sub-cells of one cell with material, and what rays see at the faces between them.
#[derive(Debug, Clone, Copy, Default)]
struct CellContacts {
    /// The index of the cell.
    index: usize,
    occupied: SubCells,
    /// For each axis, the sub-cells that a ray leaves through their upper face inside of material.
    passed: [SubCells; 3],
    /// For each axis, the sub-cells in which a ray leaves the material, and enters it again in the next sub-cell.
    separated: [SubCells; 3],
}

/// The contacts of all cells with material.
struct SubCellContacts {
    cells: Vec<CellContacts>,
    /// For each cell of the grid, its index in `cells`, or [`NO_SLOT`].
    slot_of_cell: Vec<u32>,
}

const NO_SLOT: u32 = u32::MAX;

impl SubCellContacts {
    fn new(grid: &Grid, segments: &[Vec<RaySegment>; 3]) -> Self {
        /// Material shorter than this, in sub-cells, is ignored: rounding at a face between two sub-cells.
        const TOLERANCE: f64 = 1e-6;
        let mut contacts = Self { cells: Vec::new(), slot_of_cell: vec![NO_SLOT; grid.cell_count()] };
        for (axis, segments) in segments.iter().enumerate() {
            let [u, v] = cross_axes(axis);
            // The previous segment, and its last sub-cell.
            let mut previous: Option<(RaySegment, usize)> = None;
            for segment in segments {
                let [start, end] = [segment.start, segment.end].map(|position| position * SUBDIVISIONS as f64);
                let first = (start + TOLERANCE).floor().max(0.0) as usize;
                let stop = ((end - TOLERANCE).ceil().max(0.0) as usize).min(grid.cells[axis] * SUBDIVISIONS);
                let mut sub_cell = [0; 3];
                [sub_cell[u], sub_cell[v]] = grid.lines_of(axis, segment.ray).map(|line| line.sub_cell);
                for position in first..stop {
                    sub_cell[axis] = position;
                    let cell = contacts.cell_mut(grid, sub_cell);
                    cell.occupied |= sub_cell_bit(sub_cell);
                    if position + 1 < stop {
                        cell.passed[axis] |= sub_cell_bit(sub_cell);
                    }
                }
                if let Some((before, last)) = previous
                    && before.ray == segment.ray
                    && last + 1 == first
                {
                    sub_cell[axis] = last;
                    let cell = contacts.cell_mut(grid, sub_cell);
                    let touches = start - before.end * SUBDIVISIONS as f64 <= TOLERANCE;
                    let faces = if touches { &mut cell.passed } else { &mut cell.separated };
                    faces[axis] |= sub_cell_bit(sub_cell);
                }
                if stop > first {
                    previous = Some((*segment, stop - 1));
                }
            }
        }
        contacts
    }

    fn cell_mut(&mut self, grid: &Grid, sub_cell: [usize; 3]) -> &mut CellContacts {
        let index = grid.cell_index(sub_cell.map(|coordinate| coordinate / SUBDIVISIONS));
        if self.slot_of_cell[index] == NO_SLOT {
            self.slot_of_cell[index] = self.cells.len() as u32;
            self.cells.push(CellContacts { index, ..CellContacts::default() });
        }
        &mut self.cells[self.slot_of_cell[index] as usize]
    }

    /// The number of an occupied sub-cell: 64 per cell with material.
    fn number_of(&self, grid: &Grid, sub_cell: [usize; 3]) -> Option<usize> {
        let slot = self.slot_of_cell[grid.cell_index(sub_cell.map(|coordinate| coordinate / SUBDIVISIONS))];
        let bit = sub_cell_bit(sub_cell);
        let is_occupied = slot != NO_SLOT && self.cells[slot as usize].occupied & bit != 0;
        is_occupied.then(|| slot as usize * SUB_CELLS + bit.trailing_zeros() as usize)
    }

    /// Calls `connect` with the numbers of all pairs of connected sub-cells, and the offset between their cells.
    fn for_each_connection(&self, grid: &Grid, mut connect: impl FnMut(usize, usize, [i8; 3])) {
        let limits = grid.cells.map(|cells| cells * SUBDIVISIONS);
        let neighbor_of = |sub_cell: [usize; 3], offset: [i8; 3]| {
            let mut neighbor = [0; 3];
            for axis in 0..3 {
                neighbor[axis] = sub_cell[axis].checked_add_signed(isize::from(offset[axis]))?;
            }
            (0..3).all(|axis| neighbor[axis] < limits[axis]).then_some(neighbor)
        };
        for (slot, cell) in self.cells.iter().enumerate() {
            let base = grid.cell_at(cell.index).map(|coordinate| coordinate * SUBDIVISIONS);
            for bit in (0..SUB_CELLS).filter(|bit| cell.occupied >> bit & 1 == 1) {
                let local = [bit / 16, bit / SUBDIVISIONS % SUBDIVISIONS, bit % SUBDIVISIONS];
                let sub_cell = [0, 1, 2].map(|axis| base[axis] + local[axis]);
                for offset in FORWARD_NEIGHBORS {
                    let Some(neighbor) = neighbor_of(sub_cell, offset) else { continue };
                    let Some(number) = self.number_of(grid, neighbor) else { continue };
                    let is_connected = match offset {
                        [1, 0, 0] => cell.is_connected(0, bit),
                        [0, 1, 0] => cell.is_connected(1, bit),
                        [0, 0, 1] => cell.is_connected(2, bit),
                        _ => parts_of(offset).into_iter().all(|part| {
                            neighbor_of(sub_cell, part).is_none_or(|between| self.number_of(grid, between).is_none())
                        }),
                    };
                    if is_connected {
                        let cells =
                            [sub_cell, neighbor].map(|coordinates| coordinates.map(|index| index / SUBDIVISIONS));
                        let cell_offset =
                            [0, 1, 2].map(|axis| (cells[1][axis] as isize - cells[0][axis] as isize) as i8);
                        connect(slot * SUB_CELLS + bit, number, cell_offset);
                    }
                }
            }
        }
    }
}

impl CellContacts {
    /// Whether a sub-cell is connected to the next one along an axis, if both have material.
    fn is_connected(&self, axis: usize, bit: usize) -> bool {
        let has = |set: SubCells| set >> bit & 1 == 1;
        has(self.passed[axis]) || !has(self.separated[axis])
    }
}

/// The offsets between a sub-cell and a neighbor at an edge or corner: those with some of the offset's components.
fn parts_of(offset: [i8; 3]) -> Vec<[i8; 3]> {
    let masked = |mask: usize| [0, 1, 2].map(|axis| if mask >> axis & 1 == 1 { offset[axis] } else { 0 });
    (1..7).map(masked).filter(|part| *part != offset && *part != [0; 3]).collect()
}

/// The bit of a sub-cell in its cell. Coordinates are those in the whole grid.
pub fn sub_cell_bit(sub_cell: [usize; 3]) -> SubCells {
    let [x, y, z] = sub_cell.map(|index| index % SUBDIVISIONS);
    1 << ((x * SUBDIVISIONS + y) * SUBDIVISIONS + z)
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

    /// A gap between two neighboring sub-cells with material. Both plates have a sub-cell at the gap.
    #[test]
    fn plates_with_a_gap_of_a_sub_cell_are_separate() {
        let plates =
            |gap: f64| [([0.0; 3], [3.0, 3.0, 0.5 - gap / 2.0]), ([0.0, 0.0, 0.5 + gap / 2.0], [3.0, 3.0, 1.0])];
        assert_eq!(pieces_of(&plates(0.1), 1.0).part_count, 2);
        assert_eq!(pieces_of(&plates(0.0), 1.0).part_count, 1, "control: plates that touch");
    }

    /// A thin wall whose sub-cells touch at edges.
    #[test]
    fn slanted_wall_is_one_part() {
        for angle in [0.3, std::f64::consts::FRAC_PI_4, 1.1] {
            let (mut positions, triangles) = box_surface([-2.0, -1.0, -0.02], [2.0, 1.0, 0.02]);
            let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), angle);
            positions.iter_mut().for_each(|position| *position = rotation * *position);
            let surface = Surface::new(&positions, &triangles, &[0; 12]);
            let (low, high) = surface.bounds();
            let grid = Grid::covering(low, high, 0.4);
            let segments = [0, 1, 2].map(|axis| trace_rays(&surface, &grid, axis, None));
            assert_eq!(CellPieces::new(&grid, &segments).part_count, 1, "{angle}");
        }
    }
}
