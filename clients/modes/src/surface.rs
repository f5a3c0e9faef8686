//! The surface of a body: welded, consistently oriented triangles.

use std::collections::{HashMap, HashSet};

use nalgebra::Vector3;

/// The surface of a body as the method needs it. Positions are in meters, in the axes of the file.
#[derive(Debug, Clone, Default)]
pub struct Surface {
    /// Positions of the vertices. No two vertices have the same position.
    pub positions: Vec<Vector3<f64>>,
    /// Vertices of each triangle. Degenerate and repeated triangles are removed.
    pub triangles: Vec<[u32; 3]>,
    /// The index of the group of each triangle.
    pub triangle_groups: Vec<u32>,
    /// Whether every edge has as many triangles on one side as on the other, so that the winding number is an integer.
    pub is_closed: bool,
    /// Triangles that were turned over, so that neighbors agree.
    pub flipped_triangles: usize,
}

impl Surface {
    /// Welds vertices with equal positions, removes degenerate and repeated triangles, and orients neighbors consistently.
    pub fn new(positions: &[Vector3<f64>], triangles: &[[u32; 3]], triangle_groups: &[u32]) -> Self {
        let mut vertex_of_position = HashMap::new();
        let mut welded_positions = Vec::new();
        let welded_vertices: Vec<u32> = positions
            .iter()
            .map(|position| {
                // Adding 0 turns -0 into +0.
                let key = [0, 1, 2].map(|axis| (position[axis] + 0.0).to_bits());
                *vertex_of_position.entry(key).or_insert_with(|| {
                    welded_positions.push(*position);
                    welded_positions.len() as u32 - 1
                })
            })
            .collect();
        let mut surface = Self { positions: welded_positions, ..Self::default() };
        let mut known = HashSet::new();
        for (triangle, group) in triangles.iter().zip(triangle_groups) {
            let [a, b, c] = triangle.map(|vertex| welded_vertices[vertex as usize]);
            // The rotation that begins with the smallest vertex. A repeated triangle would count twice.
            let rotations = [[a, b, c], [b, c, a], [c, a, b]];
            let is_new = known.insert(rotations.into_iter().min());
            if a != b && b != c && c != a && is_new {
                surface.triangles.push([a, b, c]);
                surface.triangle_groups.push(*group);
            }
        }
        surface.is_closed = surface.has_balanced_edges();
        if !surface.is_closed {
            surface.orient_neighbors();
            surface.is_closed = surface.has_balanced_edges();
        }
        surface
    }

    /// The positions of the corners of a triangle.
    pub fn corners(&self, triangle: usize) -> [Vector3<f64>; 3] {
        self.triangles[triangle].map(|vertex| self.positions[vertex as usize])
    }

    /// The signed volume, cubic meters: that of the body if the surface is closed, faces outward and does not overlap.
    pub fn volume(&self) -> f64 {
        // Relative to a corner, so that rounding is small for a body far from the origin.
        let center = self.positions.first().copied().unwrap_or_default();
        (0..self.triangles.len())
            .map(|index| self.area_vector(index).dot(&(self.corners(index)[0] - center)) / 3.0)
            .sum()
    }

    /// Half the cross product of two edges: the normal of a triangle, with its area as the length.
    pub fn area_vector(&self, triangle: usize) -> Vector3<f64> {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(&(c - a)) / 2.0
    }

    /// The area, square meters.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|triangle| self.area_vector(triangle).norm()).sum()
    }

    /// The corners of the bounding box of the triangles.
    pub fn bounds(&self) -> (Vector3<f64>, Vector3<f64>) {
        let corners = self.triangles.iter().flatten().map(|vertex| self.positions[*vertex as usize]);
        corners.fold((Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)), |(low, high), corner| {
            (low.inf(&corner), high.sup(&corner))
        })
    }

    /// Whether every directed edge occurs as often as its reverse.
    fn has_balanced_edges(&self) -> bool {
        let mut balance: HashMap<[u32; 2], i32> = HashMap::new();
        for [start, end] in self.triangles.iter().flat_map(directed_edges) {
            let (edge, sign) = if start < end { ([start, end], 1) } else { ([end, start], -1) };
            *balance.entry(edge).or_default() += sign;
        }
        balance.values().all(|count| *count == 0)
    }

    /// Turns triangles over where two triangles at an edge disagree. In each connected set, the smaller number of
    /// triangles is turned over.
    fn orient_neighbors(&mut self) {
        let neighbors = self.edge_neighbors();
        let mut orientation: Vec<Option<bool>> = vec![None; self.triangles.len()];
        for seed in 0..self.triangles.len() {
            if orientation[seed].is_some() {
                continue;
            }
            orientation[seed] = Some(false);
            let mut members = vec![seed];
            let mut next = 0;
            while next < members.len() {
                let triangle = members[next];
                next += 1;
                let is_flipped = orientation[triangle] == Some(true);
                for (neighbor, agrees) in &neighbors[triangle] {
                    if orientation[*neighbor].is_none() {
                        // A neighbor that agrees has the same state as this triangle.
                        orientation[*neighbor] = Some(is_flipped == *agrees);
                        members.push(*neighbor);
                    }
                }
            }
            let flipped: Vec<usize> =
                members.iter().copied().filter(|index| orientation[*index] == Some(true)).collect();
            let to_flip = match 2 * flipped.len() > members.len() {
                true => members.into_iter().filter(|index| orientation[*index] == Some(false)).collect(),
                false => flipped,
            };
            self.flipped_triangles += to_flip.len();
            for triangle in to_flip {
                self.triangles[triangle].swap(1, 2);
            }
        }
    }

    /// For each triangle, its neighbors at edges with exactly two triangles, and whether both have the same orientation.
    fn edge_neighbors(&self) -> Vec<Vec<(usize, bool)>> {
        let mut triangles_of_edge: HashMap<[u32; 2], Vec<(usize, bool)>> = HashMap::new();
        for (index, triangle) in self.triangles.iter().enumerate() {
            for [start, end] in directed_edges(triangle) {
                let edge = [start.min(end), start.max(end)];
                triangles_of_edge.entry(edge).or_default().push((index, start < end));
            }
        }
        let neighbors_of = |(index, triangle): (usize, &[u32; 3])| {
            let pairs = directed_edges(triangle).into_iter().filter_map(|[start, end]| {
                match triangles_of_edge.get(&[start.min(end), start.max(end)])?[..] {
                    // Neighbors that agree traverse their common edge in opposite directions.
                    [(a, a_ascends), (b, b_ascends)] => Some((if a == index { b } else { a }, a_ascends != b_ascends)),
                    _ => None,
                }
            });
            pairs.collect()
        };
        self.triangles.iter().enumerate().map(neighbors_of).collect()
    }
}

/// Halves a triangle at its longest edge until no edge is longer than `max_edge`. Calls `add` with the corners of each part.
pub fn divide_triangle(corners: [Vector3<f64>; 3], max_edge: f64, mut add: impl FnMut([Vector3<f64>; 3])) {
    let mut remaining = vec![corners];
    while let Some([a, b, c]) = remaining.pop() {
        let [ab, bc, ca] = [(b - a).norm(), (c - b).norm(), (a - c).norm()];
        if ab.max(bc).max(ca) <= max_edge {
            add([a, b, c]);
        } else if bc >= ab && bc >= ca {
            let middle = (b + c) / 2.0;
            remaining.extend([[a, b, middle], [a, middle, c]]);
        } else {
            // The longest edge becomes the second one.
            remaining.push(if ab >= ca { [c, a, b] } else { [b, c, a] });
        }
    }
}

/// The three directed edges of a triangle.
pub fn directed_edges([a, b, c]: &[u32; 3]) -> [[u32; 2]; 3] {
    [[*a, *b], [*b, *c], [*c, *a]]
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The corners and triangles of a box.
    pub(crate) fn box_surface(low: [f64; 3], high: [f64; 3]) -> (Vec<Vector3<f64>>, Vec<[u32; 3]>) {
        let corner =
            |index: usize| Vector3::from_fn(|axis, _| if index >> axis & 1 == 1 { high[axis] } else { low[axis] });
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        ((0..8).map(corner).collect(), triangles)
    }

    #[test]
    fn separate_vertices_are_welded_and_turned_triangles_are_turned_back() {
        let (positions, mut triangles) = box_surface([0.0; 3], [1.0; 3]);
        triangles[3].swap(0, 1);
        // As in an STL file: every triangle has vertices of its own.
        let corners: Vec<_> = triangles.iter().flatten().map(|vertex| positions[*vertex as usize]).collect();
        let separate: Vec<[u32; 3]> = (0..12).map(|index| [3 * index, 3 * index + 1, 3 * index + 2]).collect();
        let surface = Surface::new(&corners, &separate, &[0; 12]);
        assert_eq!((surface.positions.len(), surface.flipped_triangles), (8, 1));
        assert!(surface.is_closed);
        let volume: f64 = (0..12).map(|index| surface.area_vector(index).dot(&surface.corners(index)[0]) / 3.0).sum();
        assert!((volume - 1.0).abs() < 1e-12, "{volume}");
    }

    #[test]
    fn repeated_triangles_count_once() {
        let (positions, mut triangles) = box_surface([0.0; 3], [1.0; 3]);
        triangles.extend([triangles[0], [triangles[5][1], triangles[5][2], triangles[5][0]]]);
        let surface = Surface::new(&positions, &triangles, &[0; 14]);
        assert!(surface.is_closed && (surface.volume() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn box_without_a_triangle_is_open() {
        let (positions, triangles) = box_surface([0.0; 3], [1.0; 3]);
        assert!(Surface::new(&positions, &triangles, &[0; 12]).is_closed);
        assert!(!Surface::new(&positions, &triangles[1..], &[0; 11]).is_closed);
    }
}
