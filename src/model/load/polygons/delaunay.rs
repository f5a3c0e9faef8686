//! Triangulation of a polygon in the plane by a constrained Delaunay triangulation of its corners: the triangles with a
//! winding number other than 0. All corners are used, so that polygons that share the corners of an edge have no cracks
//! when they are deformed.
//!
//! The crate `earcut` (0.4.12) is not used, because it drops corners on straight edges, needs quadratic time for simple
//! polygons (a spiral of 100,000 corners: more than 50 s), and cubic time for polygons that intersect themselves.

use std::collections::HashMap;

use nalgebra::Vector2;
use spade::handles::{DirectedEdgeHandle, FixedVertexHandle};
use spade::{
    CdtEdge, ConstrainedDelaunayTriangulation, HierarchyHintGenerator, InsertionError, LineIntersectionIterator,
    Point2, Triangulation as _,
};

/// The largest number of edges of a polygon that cross other edges.
const MAX_CROSSING_EDGES: usize = 64;

/// The largest number of edges of the Delaunay triangulation that the polygon's edges may cross, per corner. Simple
/// polygons of 100,000 corners (spirals, combs, arcs, gears) cross less than 2.
const MAX_CROSSED_EDGES_PER_CORNER: usize = 64;

/// The smallest coordinate other than 0, relative to the size of the polygon. The crate `spade` rejects smaller ones.
const MIN_COORDINATE: f64 = 1e-40;

/// A prime number above all numbers of corners, whose multiples order the corners of a polygon irregularly.
const ORDER_STRIDE: u64 = 4_294_967_291;

type Delaunay = ConstrainedDelaunayTriangulation<Point2<f64>, (), (), (), HierarchyHintGenerator<f64>>;
type Edge<'a> = DirectedEdgeHandle<'a, Point2<f64>, (), CdtEdge<()>, ()>;

/// Splits a polygon whose area is positive into counterclockwise triangles, as indices into `points`. Takes
/// O(n log n) time for n points.
///
/// Returns `None` if the polygon has no area, or more self-intersections than the limits of this module allow.
pub(super) fn triangulate_plane(points: &[Vector2<f64>]) -> Option<Vec<[usize; 3]>> {
    let mut delaunay = Delaunay::new();
    let corners = Corners::insert(points, &mut delaunay).ok()?;
    let outline = Outline::insert(&corners, &mut delaunay)?;
    let winding_numbers = outline.winding_numbers(&delaunay);
    let corner_of_edge = outline.corners_of_edges(&corners, &delaunay);
    let faces = delaunay.inner_faces().filter(|face| winding_numbers[face.index()] != 0);
    let triangles: Vec<_> =
        faces.map(|face| face.adjacent_edges().map(|edge| corner_of_edge[edge.fix().index()] as usize)).collect();
    (!triangles.is_empty()).then_some(triangles)
}

/// The corners of a polygon as vertices of a triangulation. Several corners can have one position.
struct Corners {
    vertex_of_corner: Vec<FixedVertexHandle>,
    /// The first corner at each vertex.
    first_corner: Vec<u32>,
}

impl Corners {
    /// Inserts all corners, with positions relative to the size of the polygon. Neighboring corners are not inserted one
    /// after another, because the time of an irregular order does not depend on the shape of the polygon.
    fn insert(points: &[Vector2<f64>], delaunay: &mut Delaunay) -> Result<Self, InsertionError> {
        let origin = points.first().copied().unwrap_or_default();
        let extent = points.iter().map(|point| (point - origin).amax()).fold(f64::MIN_POSITIVE, f64::max);
        let normalize = |coordinate: f64| match coordinate / extent {
            small if small.abs() < MIN_COORDINATE => 0.0,
            other => other,
        };
        let corner_count = points.len() as u64;
        let vertex = FixedVertexHandle::from_index(0);
        let mut corners = Self { vertex_of_corner: vec![vertex; points.len()], first_corner: Vec::new() };
        for step in 0..corner_count {
            let corner = (step * ORDER_STRIDE % corner_count) as usize;
            let [x, y]: [f64; 2] = (points[corner] - origin).map(normalize).into();
            corners.vertex_of_corner[corner] = delaunay.insert(Point2::new(x, y))?;
        }
        corners.first_corner = vec![0; delaunay.num_vertices()];
        for (corner, vertex) in corners.vertex_of_corner.iter().enumerate().rev() {
            corners.first_corner[vertex.index()] = corner as u32;
        }
        Ok(corners)
    }
}

/// The edges of a polygon in its Delaunay triangulation.
struct Outline {
    /// How often the polygon passes each directed edge.
    passes: Vec<i32>,
    /// The corner at the start of a directed edge that the polygon passes, by the index of the edge.
    corner_at_start: HashMap<usize, u32>,
    /// Edges that cross others and are therefore not in the triangulation.
    crossing_edges: Vec<[Point2<f64>; 2]>,
}

impl Outline {
    /// Adds the edges of the polygon to the triangulation. `None` beyond the limits of this module.
    fn insert(corners: &Corners, delaunay: &mut Delaunay) -> Option<Self> {
        let vertices = &corners.vertex_of_corner;
        let mut remaining_crossed_edges = MAX_CROSSED_EDGES_PER_CORNER * vertices.len();
        let (mut pieces, mut crossing_edges) = (Vec::new(), Vec::new());
        for (corner, start) in vertices.iter().copied().enumerate() {
            let end = vertices[(corner + 1) % vertices.len()];
            if start == end {
                continue;
            }
            let crossed_edges = LineIntersectionIterator::new_from_handles(&*delaunay, start, end);
            let crossed_edges = crossed_edges.take(remaining_crossed_edges + 1).count();
            remaining_crossed_edges = remaining_crossed_edges.checked_sub(crossed_edges)?;
            // An edge on which other corners lie has several pieces.
            let edges = delaunay.try_add_constraint(start, end);
            if edges.is_empty() {
                crossing_edges.push([start, end].map(|vertex| delaunay.vertex(vertex).position()));
            }
            let new_pieces = edges.into_iter().enumerate();
            pieces.extend(new_pieces.map(|(piece, edge)| (edge.index(), (piece == 0).then_some(corner as u32))));
            if crossing_edges.len() > MAX_CROSSING_EDGES {
                return None;
            }
        }
        let mut outline =
            Self { passes: vec![0; delaunay.num_directed_edges()], corner_at_start: HashMap::new(), crossing_edges };
        for (edge, corner) in pieces {
            outline.passes[edge] += 1;
            if let Some(corner) = corner {
                outline.corner_at_start.entry(edge).or_insert(corner);
            }
        }
        Some(outline)
    }

    /// The winding number of the polygon around each face of the triangulation.
    fn winding_numbers(&self, delaunay: &Delaunay) -> Vec<i32> {
        let mut winding_numbers = vec![None; delaunay.num_all_faces()];
        winding_numbers[delaunay.outer_face().index()] = Some(0);
        let mut pending: Vec<_> = delaunay.convex_hull().map(|edge| edge.fix()).collect();
        while let Some(edge) = pending.pop() {
            let edge = delaunay.directed_edge(edge);
            // From the face on the left of the edge to the face on its right.
            let Some(face) = edge.rev().face().as_inner() else { continue };
            let Some(left) = winding_numbers[edge.face().index()] else { continue };
            if winding_numbers[face.index()].is_some() {
                continue;
            }
            let step = self.passes[edge.rev().fix().index()] - self.passes[edge.fix().index()];
            winding_numbers[face.index()] = Some(left + step + self.crossings_between_faces(edge));
            pending.extend(face.adjacent_edges().map(|edge| edge.fix()));
        }
        winding_numbers.into_iter().map(Option::unwrap_or_default).collect()
    }

    /// The change of the winding number by edges that are not in the triangulation, on the way from the center of the face
    /// on the left of `edge` to the middle of the edge, and to the center of the face on its right.
    fn crossings_between_faces(&self, edge: Edge<'_>) -> i32 {
        if self.crossing_edges.is_empty() {
            return 0;
        }
        let [start, end] = edge.positions();
        let middle = Point2::new(f64::midpoint(start.x, end.x), f64::midpoint(start.y, end.y));
        // The edges do not reach the outer face.
        let [left, right] = [edge, edge.rev()].map(|edge| edge.face().as_inner().map_or(middle, |face| face.center()));
        let crossings = |from, to| self.crossing_edges.iter().map(move |edge| signed_crossing([from, to], *edge));
        crossings(left, middle).sum::<i32>() + crossings(middle, right).sum::<i32>()
    }

    /// The corner at the start of each directed edge in the face on the left of the edge. It matters where several corners
    /// have one position: the corner whose edge to the next corner comes before the face, counterclockwise.
    fn corners_of_edges(&self, corners: &Corners, delaunay: &Delaunay) -> Vec<u32> {
        let mut corner_of_edge = vec![0; delaunay.num_directed_edges()];
        for vertex in delaunay.vertices() {
            let corner_at_start = |edge: Edge<'_>| self.corner_at_start.get(&edge.fix().index()).copied();
            let Some(any_edge) = vertex.out_edge() else { continue };
            let mut edge = vertex.out_edges().find(|edge| corner_at_start(*edge).is_some()).unwrap_or(any_edge);
            let first_edge = edge;
            let mut corner = corners.first_corner[vertex.index()];
            loop {
                corner = corner_at_start(edge).unwrap_or(corner);
                corner_of_edge[edge.fix().index()] = corner;
                edge = edge.ccw();
                if edge == first_edge {
                    break;
                }
            }
        }
        corner_of_edge
    }
}

/// The change of the winding number on the way along a line: 1 if it crosses the edge from its right to its left, -1 from
/// left to right, 0 if it does not cross the edge.
fn signed_crossing([from, to]: [Point2<f64>; 2], [start, end]: [Point2<f64>; 2]) -> i32 {
    let is_left = |a: Point2<f64>, b: Point2<f64>, point: Point2<f64>| {
        (b.x - a.x) * (point.y - a.y) - (b.y - a.y) * (point.x - a.x) > 0.0
    };
    let [from_is_left, to_is_left] = [from, to].map(|point| is_left(start, end, point));
    match from_is_left != to_is_left && is_left(from, to, start) != is_left(from, to, end) {
        true => i32::from(to_is_left) - i32::from(from_is_left),
        false => 0,
    }
}
