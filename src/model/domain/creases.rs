//! Normals of meshes without normals: smooth across shallow edges, and hard along creases.
//!
//! # Definition
//! An edge is a crease if the normals of its two triangles differ by more than the crease angle at rest. The normal of
//! a triangle follows its winding. Triangles around a vertex form a smooth fan if they are connected by edges other
//! than creases. All corners of a fan have one normal: the direction of the sum of the fan's area vectors
//! (b - a) x (c - a). Triangles are thus weighted by their areas. A vertex keeps its index and its rows of U: a crease
//! only adds corners to it.
//!
//! # Special cases
//! - 180 degrees: each vertex has one fan, even if its triangles have no common edge.
//! - 0 degrees: each flat region has its own normal. Triangles within [`SAME_PLANE_TOLERANCE`] are in one plane.
//! - Neighbors of opposite winding have opposite normals, so their common edge is a crease.
//! - An edge of three or more triangles connects those pairs of them that are within the crease angle. With more than
//!   [`MAX_EDGE_TRIANGLES`] triangles, it is a crease.
//! - A triangle without area (see [`MIN_AREA_RATIO`]) has no normal. It connects its neighbors as if its two edges at
//!   the vertex were one edge, and is part of their fan.
//! - Vertices with equal coordinates are different vertices, whose triangles are not connected: each has rows of U of
//!   its own and can move away from the others.

use nalgebra::Vector3;

use crate::error::{Result, invalid};

/// Tolerance for rounding, subtracted from the cosine of the crease angle. It enlarges an angle of 0 by 0.08 degrees,
/// and an angle of 40 degrees by 1e-4 degrees.
const SAME_PLANE_TOLERANCE: f64 = 1e-6;

/// The largest number of triangles of an edge for which all pairs are compared.
const MAX_EDGE_TRIANGLES: usize = 8;

/// A triangle counts as one without area if its area vector is not longer than this fraction of a scale. The scale is
/// the sum of `l (l + w)` over two edges of the triangle, where l is the largest component of the edge and w the
/// largest coordinate of the vertices. Rounding positions to f32 changes an area vector by about 2^-23 of the scale, so
/// the direction of a vector near this size is not reliable.
const MIN_AREA_RATIO: f64 = 1.0 / 1_048_576.0;

/// The largest angle in degrees between the normals of two adjacent triangles that are shaded as one smooth surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CreaseAngle(f64);

impl CreaseAngle {
    /// The angle of meshes whose source has no setting: round parts of a dozen facets per turn are smooth, and the
    /// edges of boxes and of eight-sided bars are hard.
    pub const DEFAULT: Self = Self(40.0);

    /// An angle in degrees: 0 is flat, 180 is smooth.
    ///
    /// # Errors
    /// `Invalid` for a number outside 0 to 180.
    pub fn from_degrees(degrees: f64) -> Result<Self> {
        match degrees {
            0.0..=180.0 => Ok(Self(degrees)),
            _ => Err(invalid("crease_angle", "0 to 180 degrees", degrees)),
        }
    }

    /// The angle in degrees, 0 to 180.
    pub const fn degrees(self) -> f64 {
        self.0
    }

    /// Whether no edge is a crease.
    fn is_smooth(self) -> bool {
        self.0 >= 180.0
    }

    /// The smallest cosine between the normals of triangles that are connected.
    fn min_cosine(self) -> f64 {
        self.0.to_radians().cos() - SAME_PLANE_TOLERANCE
    }
}

impl Default for CreaseAngle {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// The corners of a mesh after its creases have split them.
#[derive(Debug, Clone, PartialEq)]
pub struct CreasedCorners {
    /// Triangles as indices of the new corners.
    pub triangles: Vec<[u32; 3]>,
    /// For each new corner, the corner that it is a copy of. Copies of one corner are consecutive.
    pub source_corners: Vec<u32>,
    /// For each new corner, its normal at rest.
    pub normals: Vec<[f32; 3]>,
}

/// Computes the normals of a mesh and splits its corners along creases. Triangles index corners, whose vertices are
/// `corner_vertices`. A corner with a normal in `own_normals` (one entry per corner, or empty for none) keeps that
/// normal and is not split. Fans of a corner with equal normals share one copy of the corner. The normal of a corner
/// without triangles, or whose area vectors cancel, is +Z.
///
/// Needs O(c log c) time for c corners.
pub fn split_at_creases(
    rest_positions: &[[f32; 3]],
    corner_vertices: &[u32],
    triangles: &[[u32; 3]],
    own_normals: &[Option<[f32; 3]>],
    crease_angle: CreaseAngle,
) -> CreasedCorners {
    const Z: [f32; 3] = [0.0, 0.0, 1.0];
    let vertex_triangles: Vec<[u32; 3]> =
        triangles.iter().map(|triangle| triangle.map(|corner| corner_vertices[corner as usize])).collect();
    let fans = SmoothFans::new(rest_positions, &vertex_triangles, crease_angle);
    let own_normal = |corner: u32| own_normals.get(corner as usize).copied().flatten();
    // The copy of a corner that a triangle uses: the corner and the bits of its normal.
    let copy_of = |triangle: usize, slot: usize| {
        let corner = triangles[triangle][slot];
        let normal = own_normal(corner).unwrap_or_else(|| fans.normals[fans.fan_of_corner[triangle][slot] as usize]);
        (corner, normal.map(f32::to_bits))
    };
    let mut copies: Vec<(u32, [u32; 3])> = Vec::with_capacity(3 * triangles.len());
    let mut is_used = vec![false; corner_vertices.len()];
    for (index, triangle) in triangles.iter().enumerate() {
        copies.extend([0, 1, 2].map(|slot| copy_of(index, slot)));
        triangle.iter().for_each(|corner| is_used[*corner as usize] = true);
    }
    let unused_corners = (0..).zip(&is_used).filter(|(_, is_used)| !**is_used).map(|(corner, _)| corner);
    copies.extend(unused_corners.map(|corner| (corner, own_normal(corner).unwrap_or(Z).map(f32::to_bits))));
    copies.sort_unstable();
    copies.dedup();
    let index_of = |copy: (u32, [u32; 3])| copies.binary_search(&copy).unwrap_or(0) as u32;
    CreasedCorners {
        triangles: (0..triangles.len())
            .map(|triangle| [0, 1, 2].map(|slot| index_of(copy_of(triangle, slot))))
            .collect(),
        source_corners: copies.iter().map(|(corner, _)| *corner).collect(),
        normals: copies.iter().map(|(_, normal)| normal.map(f32::from_bits)).collect(),
    }
}

/// The area vector of a triangle, and its direction unless the triangle has no area.
struct TriangleArea {
    vector: Vector3<f64>,
    direction: Option<Vector3<f64>>,
}

impl TriangleArea {
    fn new(rest_positions: &[[f32; 3]], vertices: [u32; 3]) -> Self {
        let [a, b, c] = vertices.map(|vertex| Vector3::from(rest_positions[vertex as usize]).cast::<f64>());
        let edges = [b - a, c - a];
        let vector = edges[0].cross(&edges[1]);
        let coordinate = a.amax().max(b.amax()).max(c.amax());
        let rounding_scale: f64 = edges.iter().map(|edge| edge.amax() * (edge.amax() + coordinate)).sum();
        let direction = if vector.norm() > MIN_AREA_RATIO * rounding_scale { vector.try_normalize(0.0) } else { None };
        Self { vector, direction }
    }
}

/// The smooth fans of all vertices.
struct SmoothFans {
    /// For each corner of each triangle, its fan.
    fan_of_corner: Vec<[u32; 3]>,
    normals: Vec<[f32; 3]>,
}

impl SmoothFans {
    fn new(rest_positions: &[[f32; 3]], triangles: &[[u32; 3]], crease_angle: CreaseAngle) -> Self {
        let areas: Vec<TriangleArea> =
            triangles.iter().map(|vertices| TriangleArea::new(rest_positions, *vertices)).collect();
        let mut fans = Self { fan_of_corner: vec![[0; 3]; triangles.len()], normals: Vec::new() };
        let mut connector = FanConnector {
            triangles,
            areas: &areas,
            crease_angle,
            connections: DisjointSets::default(),
            edges: Vec::new(),
        };
        let (offsets, corners) = corners_by_vertex(rest_positions.len(), triangles);
        for range in offsets.windows(2) {
            let vertex_corners = &corners[range[0]..range[1]];
            connector.connect(vertex_corners);
            fans.add_fans(vertex_corners, &mut connector.connections, &areas);
        }
        fans
    }

    /// Adds the fans of one vertex, in the order of their first triangles.
    fn add_fans(&mut self, corners: &[TriangleCorner], connections: &mut DisjointSets, areas: &[TriangleArea]) {
        const UNASSIGNED: u32 = u32::MAX;
        let mut fan_of_root = vec![UNASSIGNED; corners.len()];
        let mut sums: Vec<Vector3<f64>> = Vec::new();
        let first_fan = self.normals.len() as u32;
        for (index, corner) in corners.iter().enumerate() {
            let fan = &mut fan_of_root[connections.root(index)];
            if *fan == UNASSIGNED {
                *fan = sums.len() as u32;
                sums.push(Vector3::zeros());
            }
            sums[*fan as usize] += areas[corner.triangle as usize].vector;
            self.fan_of_corner[corner.triangle as usize][corner.slot as usize] = first_fan + *fan;
        }
        let normal = |sum: Vector3<f64>| {
            sum.try_normalize(f64::MIN_POSITIVE).map_or([0.0, 0.0, 1.0], |normal| normal.cast::<f32>().into())
        };
        self.normals.extend(sums.into_iter().map(normal));
    }
}

/// One corner of a triangle.
#[derive(Debug, Clone, Copy, Default)]
struct TriangleCorner {
    triangle: u32,
    /// 0 to 2.
    slot: u8,
}

/// Returns the offset of each vertex's corners, and the corners of all triangles, sorted by vertex and then by
/// triangle.
fn corners_by_vertex(vertex_count: usize, triangles: &[[u32; 3]]) -> (Vec<usize>, Vec<TriangleCorner>) {
    let mut offsets = vec![0; vertex_count + 1];
    triangles.as_flattened().iter().for_each(|vertex| offsets[*vertex as usize + 1] += 1);
    for vertex in 0..vertex_count {
        offsets[vertex + 1] += offsets[vertex];
    }
    let mut next_offsets = offsets.clone();
    let mut corners = vec![TriangleCorner::default(); 3 * triangles.len()];
    for (triangle, vertices) in (0..).zip(triangles) {
        for (slot, vertex) in (0..).zip(vertices) {
            corners[next_offsets[*vertex as usize]] = TriangleCorner { triangle, slot };
            next_offsets[*vertex as usize] += 1;
        }
    }
    (offsets, corners)
}

/// Connects the corners of one vertex to fans. Reuses its buffers for all vertices.
struct FanConnector<'a> {
    triangles: &'a [[u32; 3]],
    areas: &'a [TriangleArea],
    crease_angle: CreaseAngle,
    /// The fans, as sets of indices into the corners of the vertex.
    connections: DisjointSets,
    /// The two edges of each corner at the vertex. An edge is the vertex at its other end and the index of the corner.
    edges: Vec<(u32, usize)>,
}

impl FanConnector<'_> {
    /// Connects the corners of a vertex in O(k log k) for k corners.
    fn connect(&mut self, corners: &[TriangleCorner]) {
        self.connections.reset(corners.len());
        if self.crease_angle.is_smooth() {
            (1..corners.len()).for_each(|index| self.connections.unite(0, index));
            return;
        }
        self.edges.clear();
        for (index, corner) in corners.iter().enumerate() {
            self.edges.extend(self.neighbors(*corner).into_iter().flatten().map(|neighbor| (neighbor, index)));
        }
        self.edges.sort_unstable();
        if corners.iter().any(|corner| self.direction(*corner).is_none()) {
            self.merge_edges_of_degenerate_triangles(corners);
        }
        let edges = std::mem::take(&mut self.edges);
        for edge in edges.chunk_by(|a, b| a.0 == b.0) {
            self.connect_edge(corners, edge);
        }
        self.edges = edges;
    }

    /// The other vertices of the triangle of a corner, without those that equal the vertex of the corner.
    fn neighbors(&self, corner: TriangleCorner) -> [Option<u32>; 2] {
        let vertices = self.triangles[corner.triangle as usize];
        let slot = usize::from(corner.slot);
        [1, 2].map(|offset| Some(vertices[(slot + offset) % 3]).filter(|neighbor| *neighbor != vertices[slot]))
    }

    fn direction(&self, corner: TriangleCorner) -> Option<Vector3<f64>> {
        self.areas[corner.triangle as usize].direction
    }

    /// Merges the two edges of each triangle without area into one.
    fn merge_edges_of_degenerate_triangles(&mut self, corners: &[TriangleCorner]) {
        let mut neighbors: Vec<u32> = self.edges.iter().map(|(neighbor, _)| *neighbor).collect();
        neighbors.dedup();
        let index_of = |neighbor: u32| neighbors.binary_search(&neighbor).unwrap_or(0);
        let mut merged = DisjointSets::default();
        merged.reset(neighbors.len());
        for corner in corners.iter().filter(|corner| self.direction(**corner).is_none()) {
            if let [Some(a), Some(b)] = self.neighbors(*corner) {
                merged.unite(index_of(a), index_of(b));
            }
        }
        self.edges.iter_mut().for_each(|(neighbor, _)| *neighbor = neighbors[merged.root(index_of(*neighbor))]);
        self.edges.sort_unstable();
        self.edges.dedup();
    }

    /// Connects corners at one edge if their triangles are within the crease angle. A corner of a triangle without area
    /// is connected in any case.
    fn connect_edge(&mut self, corners: &[TriangleCorner], edge: &[(u32, usize)]) {
        let direction_of = |index: usize| self.areas[corners[index].triangle as usize].direction;
        let mut directed =
            edge.iter().filter_map(|(_, index)| direction_of(*index).map(|direction| (*index, direction)));
        let anchor = directed.next().map_or(edge[0].1, |(index, _)| index);
        let is_connectable = directed.count() < MAX_EDGE_TRIANGLES;
        let min_cosine = self.crease_angle.min_cosine();
        for (position, (_, index)) in edge.iter().enumerate() {
            let Some(direction) = direction_of(*index) else {
                self.connections.unite(anchor, *index);
                continue;
            };
            let is_smooth =
                |other: &usize| direction_of(*other).is_some_and(|other| direction.dot(&other) >= min_cosine);
            let others = edge[..position].iter().map(|(_, other)| *other);
            for other in others.filter(|other| is_connectable && is_smooth(other)) {
                self.connections.unite(other, *index);
            }
        }
    }
}

/// Disjoint sets of the numbers below a limit (union-find with path halving). The root of a set is its smallest number.
#[derive(Debug, Default)]
struct DisjointSets {
    parents: Vec<usize>,
}

impl DisjointSets {
    /// Makes one set of each number below `count`.
    fn reset(&mut self, count: usize) {
        self.parents.clear();
        self.parents.extend(0..count);
    }

    fn root(&mut self, mut number: usize) -> usize {
        while self.parents[number] != number {
            self.parents[number] = self.parents[self.parents[number]];
            number = self.parents[number];
        }
        number
    }

    fn unite(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.parents[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests;
