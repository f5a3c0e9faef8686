//! The material along rays. Rays run parallel to each axis through all cells, with exact entry and exit points.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::grid::{Grid, RayLine, cross_axes};
use crate::inside_outside::InsideOutsideTest;
use crate::surface::Surface;

/// A part of a ray inside material. Positions are in units of cells, relative to the origin of the grid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RaySegment {
    /// The indices of the ray's lines across the two other axes (see [`cross_axes`]).
    pub ray: [u32; 2],
    pub start: f64,
    pub end: f64,
    /// The group of the surface that encloses the material.
    pub group: u32,
}

/// An intersection of a ray with a triangle.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    position: f64,
    /// 1 where the ray enters the surface, -1 where it leaves.
    sign: i32,
    group: u32,
}

/// Finds the material along all rays of an axis. Segments are sorted by ray and position.
///
/// A point inside a closed surface is one with a winding number other than 0, so that shells may overlap and may contain
/// cavities. `inside` is given for surfaces with holes.
pub fn trace_rays(
    surface: &Surface,
    grid: &Grid,
    axis: usize,
    inside: Option<&InsideOutsideTest<'_>>,
) -> Vec<RaySegment> {
    let [u, v] = cross_axes(axis);
    let positions: Vec<Vector3<f64>> = surface.positions.iter().map(|point| grid.to_cell_units(*point)).collect();
    // The triangles that touch each layer of cells across the first axis.
    let mut triangles_of_layer = vec![Vec::new(); grid.cells[u]];
    for (index, triangle) in surface.triangles.iter().enumerate() {
        let range = range_of(triangle.map(|vertex| positions[vertex as usize][u]));
        for layer in layers(range, grid.cells[u]) {
            triangles_of_layer[layer].push(index);
        }
    }
    let trace_layer = |(layer, triangles): (usize, &Vec<usize>)| {
        let first_line = grid.first_lines[u][layer];
        let lines = &grid.lines[u][first_line..grid.first_lines[u][layer + 1]];
        let lines_across = &grid.lines[v];
        let mut crossings = vec![Vec::new(); lines.len() * lines_across.len()];
        for triangle in triangles {
            let corners = surface.triangles[*triangle];
            let group = surface.triangle_groups[*triangle];
            let projected = ProjectedTriangle::new(corners, &positions, axis);
            let [u_range, v_range] = projected.ranges;
            for u_line in lines_in(lines, u_range) {
                for v_line in lines_in(lines_across, v_range) {
                    let point = [lines[u_line].position, lines_across[v_line].position];
                    if let Some((position, sign)) = projected.intersect(point) {
                        let crossing = Crossing { position, sign, group };
                        crossings[u_line * lines_across.len() + v_line].push(crossing);
                    }
                }
            }
        }
        let mut segments = Vec::new();
        for (index, crossings) in crossings.iter_mut().enumerate() {
            let ray = [(first_line + index / lines_across.len()) as u32, (index % lines_across.len()) as u32];
            crossings.sort_by(|a, b| a.position.total_cmp(&b.position).then(b.sign.cmp(&a.sign)));
            match inside {
                None => add_closed_segments(ray, crossings, &mut segments),
                Some(test) => {
                    let inside = |position: f64| test.contains(grid.point_on_ray(axis, ray, position));
                    add_open_segments(ray, crossings, grid.cells[axis], inside, &mut segments);
                }
            }
        }
        segments
    };
    triangles_of_layer.par_iter().enumerate().flat_map_iter(trace_layer).collect()
}

/// Adds the segments of a ray through a closed surface.
fn add_closed_segments(ray: [u32; 2], crossings: &[Crossing], segments: &mut Vec<RaySegment>) {
    let mut winding = 0;
    // The groups of the surfaces that enclose the current position, innermost last.
    let mut enclosing = Vec::new();
    // Groups of cavities that contain the current position, and the material around them.
    let mut cavities: Vec<(u32, u32)> = Vec::new();
    for pair in crossings.windows(2) {
        let [crossing, next] = pair else { continue };
        let previous_winding: i32 = winding;
        winding += crossing.sign;
        if winding.abs() > previous_winding.abs() {
            let cavity = cavities.iter().rposition(|(cavity, _)| *cavity == crossing.group);
            enclosing.push(cavity.map_or(crossing.group, |index| cavities.remove(index).1));
        } else if let Some(index) = enclosing.iter().rposition(|group| *group == crossing.group) {
            enclosing.remove(index);
        } else if let Some(group) = enclosing.pop() {
            cavities.push((crossing.group, group));
        }
        if winding != 0 {
            let group = enclosing.last().copied().unwrap_or(crossing.group);
            add_segment(RaySegment { ray, start: crossing.position, end: next.position, group }, segments);
        }
    }
}

/// Adds the segments of a ray through a surface with holes. `inside` decides at positions between crossings. Where the
/// ray passes a hole, the end of the material is found by bisection.
fn add_open_segments(
    ray: [u32; 2],
    crossings: &[Crossing],
    cells: usize,
    inside: impl Fn(f64) -> bool,
    segments: &mut Vec<RaySegment>,
) {
    /// Distance of the positions that are tested, in cells.
    const SAMPLE_DISTANCE: f64 = 0.25;
    /// Accuracy of an end in a hole, in cells.
    const HOLE_ACCURACY: f64 = 1e-3;
    let end_of_grid = Crossing { position: cells as f64, sign: 0, group: 0 };
    let mut start = 0.0;
    let mut group = crossings.first().map_or(0, |crossing| crossing.group);
    for crossing in crossings.iter().chain([&end_of_grid]) {
        let length = crossing.position - start;
        if length > 1e-9 {
            let samples = (length / SAMPLE_DISTANCE).ceil() as usize;
            let position = |sample: usize| start + (sample as f64 + 0.5) / samples as f64 * length;
            let mut segment_start = start;
            let mut is_inside = inside(position(0));
            for sample in 1..samples {
                if inside(position(sample)) == is_inside {
                    continue;
                }
                let [low, _] = bisect([position(sample - 1), position(sample)], HOLE_ACCURACY, &inside);
                if is_inside {
                    add_segment(RaySegment { ray, start: segment_start, end: low, group }, segments);
                }
                (segment_start, is_inside) = (low, !is_inside);
            }
            if is_inside {
                add_segment(RaySegment { ray, start: segment_start, end: crossing.position, group }, segments);
            }
        }
        (start, group) = (crossing.position, crossing.group);
    }
}

/// Narrows an interval at whose ends a condition differs, until it is not longer than `accuracy`.
pub fn bisect([mut low, mut high]: [f64; 2], accuracy: f64, condition: impl Fn(f64) -> bool) -> [f64; 2] {
    let at_low = condition(low);
    while high - low > accuracy {
        let middle = f64::midpoint(low, high);
        if condition(middle) == at_low { low = middle } else { high = middle }
    }
    [low, high]
}

/// Adds a segment, or extends the previous one if both touch.
fn add_segment(segment: RaySegment, segments: &mut Vec<RaySegment>) {
    match segments.last_mut() {
        _ if segment.end <= segment.start => {}
        Some(last) if last.ray == segment.ray && last.end == segment.start && last.group == segment.group => {
            last.end = segment.end;
        }
        _ => segments.push(segment),
    }
}

/// A triangle seen along an axis.
struct ProjectedTriangle {
    vertices: [u32; 3],
    /// Coordinates across the axis.
    points: [[f64; 2]; 3],
    /// Coordinates along the axis.
    depths: [f64; 3],
    ranges: [[f64; 2]; 2],
}

impl ProjectedTriangle {
    fn new(vertices: [u32; 3], positions: &[Vector3<f64>], axis: usize) -> Self {
        let [u, v] = cross_axes(axis);
        let corners = vertices.map(|vertex| positions[vertex as usize]);
        Self {
            vertices,
            points: corners.map(|corner| [corner[u], corner[v]]),
            depths: corners.map(|corner| corner[axis]),
            ranges: [u, v].map(|axis| range_of(corners.map(|corner| corner[axis]))),
        }
    }

    /// The position and the sign of the intersection with the ray at `point`.
    ///
    /// The side of an edge is computed in the same way for both of its triangles, so that a ray never passes between
    /// two neighbors and never hits both.
    fn intersect(&self, point: [f64; 2]) -> Option<(f64, i32)> {
        let edge = |start: usize, end: usize| {
            let is_ordered = self.vertices[start] < self.vertices[end];
            let [a, b] = if is_ordered { [start, end] } else { [end, start] }.map(|corner| self.points[corner]);
            let area = (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]);
            let is_left = area >= 0.0;
            if is_ordered { (is_left, area) } else { (!is_left, -area) }
        };
        let [(left_a, weight_a), (left_b, weight_b), (left_c, weight_c)] = [edge(1, 2), edge(2, 0), edge(0, 1)];
        let sum = weight_a + weight_b + weight_c;
        if left_a != left_b || left_b != left_c || sum == 0.0 {
            return None;
        }
        let depth = (weight_a * self.depths[0] + weight_b * self.depths[1] + weight_c * self.depths[2]) / sum;
        let [low, high] = range_of(self.depths);
        // A surface whose normal points against the ray is entered.
        Some((depth.clamp(low, high), if left_a { -1 } else { 1 }))
    }
}

fn range_of(coordinates: [f64; 3]) -> [f64; 2] {
    let [a, b, c] = coordinates;
    [a.min(b).min(c), a.max(b).max(c)]
}

/// The layers of cells that a range of coordinates touches.
fn layers([low, high]: [f64; 2], count: usize) -> std::ops::Range<usize> {
    let first = (low.max(0.0) as usize).min(count - 1);
    first..((high.max(0.0) as usize).min(count - 1) + 1)
}

/// The indices of the lines between two coordinates.
fn lines_in(lines: &[RayLine], [low, high]: [f64; 2]) -> std::ops::Range<usize> {
    lines.partition_point(|line| line.position < low)..lines.partition_point(|line| line.position <= high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::tests::box_surface;
    use crate::winding_number::WindingNumber;
    use crate::winding_number::tests::ellipsoid;

    fn volume(grid: &Grid, axis: usize, segments: &[RaySegment]) -> f64 {
        segments.iter().map(|segment| (segment.end - segment.start) * grid.ray_area(axis, segment.ray)).sum()
    }

    #[test]
    fn cavity_is_empty_and_overlapping_shells_count_once() {
        let (mut positions, mut triangles) = box_surface([0.0; 3], [4.0; 3]);
        let (inner_positions, inner) = box_surface([1.0; 3], [3.0; 3]);
        positions.extend(inner_positions);
        triangles.extend(inner.iter().map(|triangle| triangle.map(|vertex| vertex + 8)));
        let grid = Grid::covering(Vector3::zeros(), Vector3::repeat(4.0), 1.0);
        for (is_cavity, expected) in [(false, 64.0), (true, 56.0)] {
            if is_cavity {
                triangles[12..].iter_mut().for_each(|triangle| triangle.swap(0, 1));
            }
            let surface = Surface::new(&positions, &triangles, &[[0; 12], [1; 12]].concat());
            assert!(surface.is_closed);
            for axis in 0..3 {
                let segments = trace_rays(&surface, &grid, axis, None);
                assert!(
                    (volume(&grid, axis, &segments) - expected).abs() < 1e-9,
                    "axis {axis}: {}",
                    volume(&grid, axis, &segments)
                );
                let inner = segments.iter().filter(|segment| segment.group == 1).count();
                assert_eq!(inner > 0, !is_cavity, "the inner shell's material");
            }
        }
    }

    #[test]
    fn volume_of_a_surface_with_holes_is_that_of_the_closed_surface() {
        let (positions, triangles) = ellipsoid([0.5, 0.35, 0.2], 40);
        let closed = Surface::new(&positions, &triangles, &vec![0; triangles.len()]);
        let mut random = fastrand::Rng::with_seed(7);
        let damaged: Vec<[u32; 3]> = triangles.into_iter().filter(|_| random.f64() > 0.05).collect();
        let open = Surface::new(&positions, &damaged, &vec![0; damaged.len()]);
        let (low, high) = closed.bounds();
        let grid = Grid::covering(low, high, 0.1);
        for axis in 0..3 {
            let expected = volume(&grid, axis, &trace_rays(&closed, &grid, axis, None));
            let winding = WindingNumber::new(&open);
            let with_holes =
                volume(&grid, axis, &trace_rays(&open, &grid, axis, Some(&InsideOutsideTest::new(&grid, &winding))));
            assert!((with_holes / expected - 1.0).abs() < 0.01, "axis {axis}: {with_holes} instead of {expected}");
            let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.5 * 0.35 * 0.2 / 1e-3;
            assert!((expected / exact - 1.0).abs() < 0.01, "axis {axis}: {expected} instead of {exact}");
        }
    }
}
