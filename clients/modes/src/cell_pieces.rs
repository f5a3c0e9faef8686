//! Connected pieces of material in each cell, and parts: connected sets of pieces.
//!
//! Two walls that pass through the same cell without touching must not share the nodes of that cell. Each of them is a
//! piece with nodes of its own, and the nodes of neighboring pieces are merged only where the pieces are connected.
//!
//! Connections are found on sub-cells: two neighboring sub-cells with material are connected if a ray passes through their
//! common face inside of material, or if a triangle of the surface passes through both. Walls are therefore separate if no
//! sub-cell contains both.

use std::collections::{BTreeMap, HashMap};

use nalgebra::Vector3;

use crate::disjoint_sets::DisjointSets;
use crate::grid::{CELL_NODES, FORWARD_NEIGHBORS, Grid, NODES_PER_SIDE, SUBDIVISIONS, all_offsets, cross_axes};
use crate::material_rays::RaySegment;
use crate::surface::Surface;

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
    /// Divides the material of a surface that rays of the three axes found.
    pub fn new(grid: &Grid, surface: &Surface, segments: &[Vec<RaySegment>; 3]) -> Self {
        let contacts = SubCellContacts::new(grid, segments);
        let mut sets = DisjointSets::new(SUB_CELLS * contacts.cells.len());
        let mut links = Vec::new();
        let mut connect = |own: usize, other: usize, offset: [i8; 3]| {
            let [own_cell, other_cell] = [own / SUB_CELLS, other / SUB_CELLS];
            match own_cell == other_cell {
                true => sets.merge(own, other),
                false => links.push((own, other, offset)),
            }
        };
        contacts.for_each_passed_face(grid, &mut connect);
        for triangle in 0..surface.triangles.len() {
            contacts.connect_along(grid, surface.corners(triangle), &mut connect);
        }
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
        pieces.links = self.links_across_removed(keep).iter().filter_map(renumbered).collect();
        pieces.connect();
        pieces
    }

    /// The links, and links between neighbors of a piece that is not kept: it had no volume, but connected them.
    fn links_across_removed(&self, keep: &[bool]) -> Vec<(u32, u32, [i8; 3])> {
        let mut links = self.links.clone();
        let mut neighbors: HashMap<u32, Vec<(u32, [i8; 3])>> = HashMap::new();
        for (own, other, offset) in &self.links {
            if !keep[*own as usize] {
                neighbors.entry(*own).or_default().push((*other, *offset));
            }
            if !keep[*other as usize] {
                neighbors.entry(*other).or_default().push((*own, offset.map(|component| -component)));
            }
        }
        for around in neighbors.into_values() {
            for (index, (own, own_offset)) in around.iter().enumerate() {
                for (other, other_offset) in &around[index + 1..] {
                    let offset = [0, 1, 2].map(|axis| other_offset[axis] - own_offset[axis]);
                    if offset.iter().all(|component| component.abs() <= 1) {
                        links.push((*own, *other, offset));
                    }
                }
            }
        }
        links.sort_unstable();
        links.dedup();
        links
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
                    && start - before.end * SUBDIVISIONS as f64 <= TOLERANCE
                {
                    sub_cell[axis] = last;
                    contacts.cell_mut(grid, sub_cell).passed[axis] |= sub_cell_bit(sub_cell);
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

    /// Calls `connect` with the numbers of all pairs of sub-cells whose common face a ray passes inside of material, and
    /// with the offset between their cells.
    fn for_each_passed_face(&self, grid: &Grid, connect: &mut impl FnMut(usize, usize, [i8; 3])) {
        for (slot, cell) in self.cells.iter().enumerate() {
            let base = grid.cell_at(cell.index).map(|coordinate| coordinate * SUBDIVISIONS);
            for bit in 0..SUB_CELLS {
                let local = [bit / 16, bit / SUBDIVISIONS % SUBDIVISIONS, bit % SUBDIVISIONS];
                for axis in (0..3).filter(|axis| cell.passed[*axis] >> bit & 1 == 1) {
                    let mut neighbor = [0, 1, 2].map(|axis| base[axis] + local[axis]);
                    neighbor[axis] += 1;
                    let mut offset = [0; 3];
                    offset[axis] = i8::from(local[axis] + 1 == SUBDIVISIONS);
                    if neighbor[axis] < grid.cells[axis] * SUBDIVISIONS
                        && let Some(number) = self.number_of(grid, neighbor)
                    {
                        connect(slot * SUB_CELLS + bit, number, offset);
                    }
                }
            }
        }
    }

    /// Connects the neighboring sub-cells with material that a triangle passes through.
    fn connect_along(&self, grid: &Grid, corners: [Vector3<f64>; 3], connect: &mut impl FnMut(usize, usize, [i8; 3])) {
        /// Distance of the points on the triangle, in sub-cells.
        const DISTANCE: f64 = 0.5;
        let [a, b, c] = corners.map(|corner| grid.to_cell_units(corner) * SUBDIVISIONS as f64);
        let divisions = |edge: Vector3<f64>| (edge.norm() / DISTANCE).ceil().max(1.0) as usize;
        let along = divisions(b - a).max(divisions(c - b));
        let mut sub_cells = BTreeMap::new();
        for i in 0..=along {
            // Lines from a point on ab to the point on ac with the same share, parallel to bc.
            let share = i as f64 / along as f64;
            let (start, edge) = (a + (b - a) * share, (c - b) * share);
            let across = divisions(edge);
            for j in 0..=across {
                let point = start + edge * (j as f64 / across as f64);
                let sub_cell =
                    [0, 1, 2].map(|axis| (point[axis].max(0.0) as usize).min(grid.cells[axis] * SUBDIVISIONS - 1));
                if let Some(number) = self.number_of(grid, sub_cell) {
                    sub_cells.insert(sub_cell, number);
                }
            }
        }
        for (sub_cell, number) in &sub_cells {
            for offset in FORWARD_NEIGHBORS {
                let neighbor = [0, 1, 2].map(|axis| sub_cell[axis].wrapping_add_signed(isize::from(offset[axis])));
                if let Some(other) = sub_cells.get(&neighbor) {
                    let cell_offset = [0, 1, 2].map(|axis| {
                        (neighbor[axis] / SUBDIVISIONS) as isize - (sub_cell[axis] / SUBDIVISIONS) as isize
                    });
                    connect(*number, *other, cell_offset.map(|offset| offset as i8));
                }
            }
        }
    }
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
        CellPieces::new(&grid, &surface, &segments)
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

    /// Two slanted plates with a gap of 0.5 cells.
    #[test]
    fn slanted_plates_with_a_gap_are_separate() {
        let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), std::f64::consts::FRAC_PI_4);
        let parts_with_gap = |gap: f64| {
            let (mut positions, mut triangles) = box_surface([-2.0, -1.0, gap / 2.0], [2.0, 1.0, gap / 2.0 + 0.1]);
            let (below, faces) = box_surface([-2.0, -1.0, -gap / 2.0 - 0.1], [2.0, 1.0, -gap / 2.0]);
            positions.extend(below);
            triangles.extend(faces.iter().map(|face| face.map(|vertex| vertex + 8)));
            positions.iter_mut().for_each(|position| *position = rotation * *position);
            let surface = Surface::new(&positions, &triangles, &[0; 24]);
            let (low, high) = surface.bounds();
            let grid = Grid::covering(low, high, 0.4);
            let segments = [0, 1, 2].map(|axis| trace_rays(&surface, &grid, axis, None));
            CellPieces::new(&grid, &surface, &segments).part_count
        };
        assert_eq!(parts_with_gap(0.2), 2);
        assert_eq!(parts_with_gap(0.01), 1, "control: both walls in the same sub-cells");
    }

    /// Two flanges of a thin sheet. Both pass through the same sub-cells near the fold.
    #[test]
    fn folded_sheet_is_one_part() {
        for (thickness, degrees) in [(0.002, 25.0_f64), (0.002, 35.0), (0.001, 45.0), (0.001, 40.0), (0.001, 30.0)] {
            let angle = degrees.to_radians();
            let profile =
                [[0.0, 0.0], [1.0, 0.0], [1.0, thickness], [thickness, thickness], [thickness, 1.0], [0.0, 1.0]];
            let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), angle);
            let side = |y: f64| profile.map(|[x, z]| rotation * Vector3::new(x, y, z));
            let positions: Vec<_> = side(0.0).into_iter().chain(side(0.5)).collect();
            let mut triangles = vec![[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]];
            triangles.extend(triangles.clone().iter().map(|[a, b, c]| [a + 6, c + 6, b + 6]));
            for edge in 0..6 {
                let next = (edge + 1) % 6;
                triangles.extend([[next, edge, edge + 6], [next, edge + 6, next + 6]]);
            }
            let surface = Surface::new(&positions, &triangles, &[0; 20]);
            assert!(surface.is_closed);
            let (low, high) = surface.bounds();
            let grid = Grid::covering(low, high, 0.05);
            let segments = [0, 1, 2].map(|axis| trace_rays(&surface, &grid, axis, None));
            let pieces = CellPieces::new(&grid, &surface, &segments);
            assert_eq!(pieces.part_count, 1, "thickness {thickness}, {degrees} degrees");
        }
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
            assert_eq!(CellPieces::new(&grid, &surface, &segments).part_count, 1, "{angle}");
        }
    }
}
