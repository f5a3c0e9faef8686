//! Triangulation of a polygon in space.

use nalgebra::{Vector2, Vector3};

use super::delaunay::triangulate_plane;

/// The triangles of a polygon.
#[derive(Debug)]
pub(super) struct Triangulation {
    /// Indices of points, with the polygon's winding.
    pub(super) triangles: Vec<[usize; 3]>,
    /// Whether the triangles are a fan that covers more than the polygon, because it intersects itself too often.
    pub(super) is_inexact: bool,
}

/// Splits a polygon into triangles. Takes O(n log n) time for n points.
///
/// If all triangles of the fan from the first corner have the polygon's orientation, the fan is used. Otherwise a
/// quadrilateral is split along its other diagonal, and a larger polygon in the plane of its normal (Newell's method). The
/// triangles of a polygon with a hole, whose outline runs to the hole and back, do not cover the hole. Consecutive corners
/// at one place get triangles without area: their vertices are different and can move apart.
pub(super) fn triangulate(points: &[[f32; 3]]) -> Triangulation {
    let fan: Vec<_> = (2..points.len()).map(|index| [0, index - 1, index]).collect();
    let exact = |triangles| Triangulation { triangles, is_inexact: false };
    if points.len() <= 3 {
        return exact(fan);
    }
    let count = points.len();
    let is_repeated = |index: &usize| points[*index] == points[(*index + count - 1) % count];
    let distinct: Vec<usize> = (0..count).filter(|index| !is_repeated(index)).collect();
    if count > 4 && distinct.len() < count && distinct.len() > 2 {
        return triangulate_with_repetitions(points, &distinct);
    }
    let points: Vec<_> = points.iter().map(|point| Vector3::from(*point).cast::<f64>()).collect();
    let normal = newell_normal(&points);
    let has_polygon_orientation = |triangle: &[usize; 3]| {
        let [a, b, c] = triangle.map(|index| points[index]);
        (b - a).cross(&(c - a)).dot(&normal) > 0.0
    };
    if fan.iter().all(has_polygon_orientation) || normal == Vector3::zeros() {
        return exact(fan);
    }
    if points.len() == 4 {
        let other_split = vec![[1, 2, 3], [1, 3, 0]];
        return exact(if other_split.iter().all(has_polygon_orientation) { other_split } else { fan });
    }
    match triangulate_plane(&project_to_plane(&points, normal)) {
        Some(triangles) => exact(triangles),
        None => Triangulation { triangles: fan, is_inexact: true },
    }
}

/// Triangulates a polygon with repeated points. `distinct` are the corners that differ from the corner before them. Each
/// run of repetitions becomes a fan of triangles without area.
fn triangulate_with_repetitions(points: &[[f32; 3]], distinct: &[usize]) -> Triangulation {
    let distinct_points: Vec<_> = distinct.iter().map(|index| points[*index]).collect();
    let Triangulation { mut triangles, is_inexact } = triangulate(&distinct_points);
    triangles.iter_mut().flatten().for_each(|index| *index = distinct[*index]);
    for (place, corner) in distinct.iter().enumerate() {
        let next = distinct[(place + 1) % distinct.len()];
        let run = (next + points.len() - corner - 1) % points.len();
        let repeated = |index: usize| (corner + index) % points.len();
        triangles.extend((1..=run).map(|index| [*corner, repeated(index), repeated(index + 1)]));
    }
    Triangulation { triangles, is_inexact }
}

/// Twice the area vector; zero for a polygon without area.
fn newell_normal(points: &[Vector3<f64>]) -> Vector3<f64> {
    // Coordinates are relative to the first point, so that a small polygon far from the origin loses no precision.
    let offset = |index: usize| points[index % points.len()] - points[0];
    (0..points.len()).map(|index| offset(index).cross(&offset(index + 1))).sum()
}

/// Projects the polygon along the dominant axis of its normal, counterclockwise.
fn project_to_plane(points: &[Vector3<f64>], normal: Vector3<f64>) -> Vec<Vector2<f64>> {
    let dropped_axis = normal.iamax();
    let (first_axis, second_axis) = ((dropped_axis + 1) % 3, (dropped_axis + 2) % 3);
    let sign = if normal[dropped_axis] < 0.0 { -1.0 } else { 1.0 };
    points.iter().map(|point| Vector2::new(point[first_axis], sign * point[second_axis])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum of the signed areas of the triangles in the xy plane, and the sum of their absolute areas.
    fn signed_and_absolute_area(points: &[[f32; 3]], triangles: &[[usize; 3]]) -> [f64; 2] {
        let signed_area = |triangle: &[usize; 3]| {
            let [a, b, c] = triangle.map(|index| Vector3::from(points[index]).cast::<f64>());
            (b - a).cross(&(c - a)).z / 2.0
        };
        let absolute_areas = triangles.iter().map(|triangle| signed_area(triangle).abs());
        [triangles.iter().map(signed_area).sum(), absolute_areas.sum()]
    }

    #[test]
    fn concave_polygons_are_covered_once_from_any_first_corner() {
        let arrow = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 2.0, 0.0]];
        let letter_u = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [2.0, 3.0], [2.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]]
            .map(|[x, y]| [x, y, 1e3]);
        for (polygon, polygon_area) in [(&arrow[..], 1.0), (&letter_u[..], 7.0)] {
            for shift in 0..polygon.len() {
                let mut rotated = polygon.to_vec();
                rotated.rotate_left(shift);
                let triangles = triangulate(&rotated).triangles;
                assert_eq!(triangles.len(), polygon.len() - 2);
                for area in signed_and_absolute_area(&rotated, &triangles) {
                    assert!((area - polygon_area).abs() < 1e-9, "{shift}: expected {polygon_area}, got {area}");
                }
            }
        }
        // Control: a split along the wrong diagonal covers area outside of the arrow.
        let [_, absolute_area] = signed_and_absolute_area(&arrow, &[[1, 2, 3], [1, 3, 0]]);
        assert!(absolute_area > 1.5, "expected more than 1.5, got {absolute_area}");
    }

    /// A thin arc: almost every convex corner has a corner of the other side in its triangle.
    #[test]
    fn thin_arc_is_covered_once() {
        let angles = (0..128).map(|index| f64::from(index) / 32.0);
        let outer = angles.clone().map(|angle| (1.0, angle));
        let inner = angles.rev().map(|angle| (0.9999, angle));
        let point = |(radius, angle): (f64, f64)| [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32, 0.0];
        let arc: Vec<_> = outer.chain(inner).map(point).collect();
        let triangles = triangulate(&arc).triangles;
        assert_eq!(triangles.len(), 254);
        let [signed, absolute] = signed_and_absolute_area(&arc, &triangles);
        assert!((signed - absolute).abs() < 1e-9, "expected no overlap, got {signed} and {absolute}");
        // The area of the ring sector of 127 / 32 rad.
        let expected = 127.0 / 64.0 * (1.0 - 0.9999_f64.powi(2));
        assert!((signed - expected).abs() < 0.01 * expected, "expected about {expected}, got {signed}");
    }

    /// Polygons above 256 corners: simple, with a hole that the outline runs to and back, far from the origin, and in another
    /// plane.
    #[test]
    fn large_polygons_are_covered_once() {
        let gear = |corner_count: usize| {
            let point = move |index: usize| {
                let (angle, radius) =
                    (std::f64::consts::TAU * index as f64 / corner_count as f64, [1.0, 0.8][index / 2 % 2]);
                [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32, 0.0]
            };
            (0..corner_count).map(point).collect::<Vec<_>>()
        };
        let hole = gear(300).into_iter().map(|[x, y, z]| [0.5 * x, 0.5 * y, z]);
        let outer = gear(400);
        let mut inner: Vec<_> = hole.rev().collect();
        inner.push(inner[0]);
        let with_hole = [&outer[..], &[outer[0]], &inner].concat();
        let spiral =
            |offset: f64| (0..50_000).map(move |index| (f64::from(index) * 0.05, f64::from(index) * 0.05 + offset));
        let outline = spiral(4.0).chain(spiral(1.0).rev());
        let spiral: Vec<_> = outline
            .map(|(angle, radius)| [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32, 0.0])
            .collect();
        for polygon in
            [gear(260), with_hole, gear(1000).into_iter().map(|[x, y, _]| [x + 100.0, y, 7.0]).collect(), spiral]
        {
            let expected =
                newell_normal(&polygon.iter().map(|point| Vector3::from(*point).cast()).collect::<Vec<_>>()).z / 2.0;
            let Triangulation { triangles, is_inexact } = triangulate(&polygon);
            assert_eq!((triangles.len(), is_inexact), (polygon.len() - 2, false));
            for area in signed_and_absolute_area(&polygon, &triangles) {
                assert!((area - expected).abs() < 1e-6 * expected, "expected {expected}, got {area}");
            }
            let fan: Vec<_> = (2..polygon.len()).map(|index| [0, index - 1, index]).collect();
            let [_, absolute_area] = signed_and_absolute_area(&polygon, &fan);
            assert!(absolute_area > 1.01 * expected, "control: expected a fan above {expected}, got {absolute_area}");
        }
    }

    /// The corners where an outline runs to a hole and back have one position, but can have different texture coordinates.
    #[test]
    fn corners_with_one_position_keep_their_sides() {
        let hole = [[1.0, 1.0], [1.0, 2.0], [2.0, 2.0], [2.0, 1.0], [1.0, 1.0]];
        let outline = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [0.0, 0.0]];
        let polygon: Vec<_> = outline.iter().chain(&hole).map(|[x, y]| [*x, *y, 0.0]).collect();
        let triangles = triangulate(&polygon).triangles;
        let has_edge = |a: usize, b: usize| {
            triangles.iter().any(|triangle| (0..3).any(|side| [triangle[side], triangle[(side + 1) % 3]] == [a, b]))
        };
        for corner in 0..polygon.len() {
            let next = (corner + 1) % polygon.len();
            assert!(has_edge(corner, next), "expected a triangle at the edge from {corner} to {next}: {triangles:?}");
        }
        assert_eq!(signed_and_absolute_area(&polygon, &triangles), [15.0; 2]);
    }

    /// Different vertices at one place may move apart: each edge of the outline is an edge of a triangle.
    #[test]
    fn repeated_places_have_triangles_of_their_own() {
        let arrow = [[2.0, 0.0], [0.5, 0.5], [0.0, 2.0], [0.0, 0.0]].map(|[x, y]| [x, y, 0.0]);
        for runs in [[2, 1, 1, 1], [1, 3, 1, 1], [1, 1, 1, 2], [2, 1, 3, 2]] {
            let repeat = |(point, run): (&[f32; 3], &usize)| vec![*point; *run];
            let unrotated: Vec<[f32; 3]> = arrow.iter().zip(&runs).flat_map(repeat).collect();
            for shift in 0..unrotated.len() {
                let mut polygon = unrotated.clone();
                polygon.rotate_left(shift);
                let triangles = triangulate(&polygon).triangles;
                assert_eq!(triangles.len(), polygon.len() - 2, "{runs:?} {shift}");
                for corner in 0..polygon.len() {
                    let edge = [corner, (corner + 1) % polygon.len()];
                    let sides =
                        |triangle: &[usize; 3]| [0, 1, 2].map(|side| [triangle[side], triangle[(side + 1) % 3]]);
                    assert!(
                        triangles.iter().any(|triangle| sides(triangle).contains(&edge)),
                        "{edge:?}: {triangles:?}"
                    );
                }
                for area in signed_and_absolute_area(&polygon, &triangles) {
                    assert!((area - 1.0).abs() < 1e-9, "{runs:?} {shift}: got {area}");
                }
            }
        }
    }

    /// Corners on straight edges are corners of triangles, because the polygon beside the edge has them too.
    #[test]
    fn corners_on_straight_edges_are_kept() {
        let side = |start: [f32; 2], end: [f32; 2]| {
            (0..100).map(move |step| {
                let part = step as f32 / 100.0;
                [start[0] + part * (end[0] - start[0]), start[1] + part * (end[1] - start[1]), 0.0]
            })
        };
        let corners = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [1.5, 1.0], [0.0, 3.0]];
        let polygon: Vec<_> = (0..5).flat_map(|index| side(corners[index], corners[(index + 1) % 5])).collect();
        let triangles = triangulate(&polygon).triangles;
        let unused = (0..polygon.len()).find(|corner| !triangles.as_flattened().contains(corner));
        assert_eq!(unused, None);
    }

    #[test]
    fn few_self_intersections_are_resolved_and_many_are_a_fan() {
        let mut flag: Vec<_> = (0..1000).map(|index| [index as f32, (index % 2) as f32, 0.0]).collect();
        flag.extend([[1000.0, 500.0, 0.0], [-1.0, 500.0, 0.0]]);
        let area = signed_and_absolute_area(&flag, &triangulate(&flag).triangles)[1];
        // Two teeth cross.
        (flag[500][0], flag[501][0]) = (flag[501][0], flag[500][0]);
        let Triangulation { triangles, is_inexact } = triangulate(&flag);
        let crossed_area = signed_and_absolute_area(&flag, &triangles)[1];
        assert!(!is_inexact && (crossed_area - area).abs() < 5.0, "expected about {area}, got {crossed_area}");
        let random = |index: u64| (index.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as f32;
        let tangle: Vec<_> = (0..100_000).map(|index| [random(index), random(index * index + 7), 0.0]).collect();
        let Triangulation { triangles, is_inexact } = triangulate(&tangle);
        assert_eq!((triangles.len(), is_inexact), (tangle.len() - 2, true));
    }

    #[test]
    fn degenerate_polygons_have_two_fewer_triangles() {
        for polygon in [
            vec![[1.0; 3]; 4],
            vec![[1.0; 3]; 7],
            vec![[0.0, 0.0, 0.0], [1e-40, 0.0, 0.0], [0.0, 1e38, 0.0], [0.0; 3], [1.0; 3]],
        ] {
            assert_eq!(triangulate(&polygon).triangles.len(), polygon.len() - 2);
        }
    }
}
