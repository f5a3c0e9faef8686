//! Triangulation of a polygon in space.

use nalgebra::{Vector2, Vector3};

/// The largest polygon that is triangulated by ear clipping, which takes cubic time. A larger polygon is split into a
/// fan.
const MAX_EAR_CLIPPING_CORNERS: usize = 256;

/// Splits a polygon into triangles with the polygon's winding, as indices into `points`. There are always two fewer
/// triangles than points.
///
/// If all triangles of the fan from the first corner have the polygon's orientation, the fan is used. Otherwise a
/// quadrilateral is split along its other diagonal, and a larger polygon by ear clipping in the plane of its normal
/// (Newell's method).
pub(super) fn triangulate(points: &[[f32; 3]]) -> Vec<[usize; 3]> {
    let fan = |count: usize| (2..count).map(|index| [0, index - 1, index]).collect::<Vec<_>>();
    if points.len() <= 3 {
        return fan(points.len());
    }
    let points: Vec<_> = points.iter().map(|point| Vector3::from(*point).cast::<f64>()).collect();
    let normal = newell_normal(&points);
    let has_polygon_orientation = |triangle: &[usize; 3]| {
        let [a, b, c] = triangle.map(|index| points[index]);
        (b - a).cross(&(c - a)).dot(&normal) > 0.0
    };
    let first_fan = fan(points.len());
    if first_fan.iter().all(has_polygon_orientation) || points.len() > MAX_EAR_CLIPPING_CORNERS {
        return first_fan;
    }
    if points.len() == 4 {
        let other_split = vec![[1, 2, 3], [1, 3, 0]];
        return if other_split.iter().all(has_polygon_orientation) { other_split } else { first_fan };
    }
    ear_clip(&project_to_plane(&points, normal))
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

fn ear_clip(points: &[Vector2<f64>]) -> Vec<[usize; 3]> {
    let mut remaining: Vec<usize> = (0..points.len()).collect();
    let mut triangles = Vec::with_capacity(points.len().saturating_sub(2));
    while remaining.len() > 3 {
        let count = remaining.len();
        let triangle_at = |position: usize| {
            [remaining[(position + count - 1) % count], remaining[position], remaining[(position + 1) % count]]
        };
        let is_ear = |position: &usize| {
            let ear = triangle_at(*position);
            let corners = ear.map(|index| points[index]);
            signed_area2(corners) > 0.0
                && !remaining.iter().any(|index| !ear.contains(index) && contains_point(points[*index], corners))
        };
        // A self-intersecting polygon may have no ear. In this case, cut any corner, so that no triangle is lost.
        let position = (0..count).find(is_ear).unwrap_or(1);
        triangles.push(triangle_at(position));
        remaining.remove(position);
    }
    triangles.push([remaining[0], remaining[1], remaining[2]]);
    triangles
}

/// Twice the signed area of a triangle, positive if counterclockwise.
fn signed_area2([a, b, c]: [Vector2<f64>; 3]) -> f64 {
    (b - a).perp(&(c - a))
}

fn contains_point(point: Vector2<f64>, [a, b, c]: [Vector2<f64>; 3]) -> bool {
    signed_area2([a, b, point]) >= 0.0 && signed_area2([b, c, point]) >= 0.0 && signed_area2([c, a, point]) >= 0.0
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
                let triangles = triangulate(&rotated);
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

    #[test]
    fn degenerate_and_huge_polygons_have_two_fewer_triangles() {
        for polygon in [
            vec![[1.0; 3]; 4],
            vec![[1.0; 3]; 7],
            vec![[0.0, 0.0, 0.0], [1e-40, 0.0, 0.0], [0.0, 1e38, 0.0], [0.0; 3], [1.0; 3]],
        ] {
            assert_eq!(triangulate(&polygon).len(), polygon.len() - 2);
        }
        let wave: Vec<_> = (0..5000).map(|index| [index as f32, (index % 7) as f32, 0.0]).collect();
        assert_eq!(triangulate(&wave).len(), 4998);
    }
}
