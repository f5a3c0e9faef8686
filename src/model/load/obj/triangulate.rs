//! Triangulation of a polygon in space.

use nalgebra::{Vector2, Vector3};

/// The largest polygon that is triangulated by ear clipping, which takes cubic time. Larger ones are split into a fan.
const MAX_EAR_CLIPPING_CORNERS: usize = 256;

/// Splits a polygon into triangles, as indices of `points`, with its winding; always two fewer than points.
///
/// If all triangles of the fan from the first corner have the polygon's orientation, the fan is used. Otherwise a quad
/// is split along its other diagonal, and a larger polygon by ear clipping in the plane of its normal (Newell's
/// method).
pub(super) fn triangulate(points: &[[f32; 3]]) -> Vec<[usize; 3]> {
    let fan = |count: usize| (2..count).map(|index| [0, index - 1, index]).collect::<Vec<_>>();
    if points.len() <= 3 {
        return fan(points.len());
    }
    let points: Vec<_> = points.iter().map(|point| Vector3::from(*point).cast::<f64>()).collect();
    let normal = newell_normal(&points);
    let turns_along = |triangle: &[usize; 3]| {
        let [a, b, c] = triangle.map(|index| points[index]);
        (b - a).cross(&(c - a)).dot(&normal) > 0.0
    };
    let first = fan(points.len());
    if first.iter().all(turns_along) || points.len() > MAX_EAR_CLIPPING_CORNERS {
        return first;
    }
    if points.len() == 4 {
        let other = vec![[1, 2, 3], [1, 3, 0]];
        return if other.iter().all(turns_along) { other } else { first };
    }
    ear_clip(&project_to_plane(&points, normal))
}

/// Twice the area vector; zero for a polygon without area.
fn newell_normal(points: &[Vector3<f64>]) -> Vector3<f64> {
    // Relative to the first point, so that a small polygon far from the origin loses no precision.
    let from_first = |index: usize| points[index % points.len()] - points[0];
    (0..points.len()).map(|index| from_first(index).cross(&from_first(index + 1))).sum()
}

/// Projects the polygon along the dominant axis of its normal, counterclockwise.
fn project_to_plane(points: &[Vector3<f64>], normal: Vector3<f64>) -> Vec<Vector2<f64>> {
    let drop = normal.iamax();
    let (first, second) = ((drop + 1) % 3, (drop + 2) % 3);
    let sign = if normal[drop] < 0.0 { -1.0 } else { 1.0 };
    points.iter().map(|point| Vector2::new(point[first], sign * point[second])).collect()
}

fn ear_clip(points: &[Vector2<f64>]) -> Vec<[usize; 3]> {
    let mut left: Vec<usize> = (0..points.len()).collect();
    let mut triangles = Vec::with_capacity(points.len().saturating_sub(2));
    while left.len() > 3 {
        let count = left.len();
        let around = |at: usize| [left[(at + count - 1) % count], left[at], left[(at + 1) % count]];
        let is_ear = |at: &usize| {
            let ear = around(*at);
            let corners = ear.map(|index| points[index]);
            signed_area2(corners) > 0.0
                && !left.iter().any(|index| !ear.contains(index) && contains_point(points[*index], corners))
        };
        // A self-intersecting polygon may have no ear; then any corner is cut, so that no face is lost.
        let at = (0..count).find(is_ear).unwrap_or(1);
        triangles.push(around(at));
        left.remove(at);
    }
    triangles.push([left[0], left[1], left[2]]);
    triangles
}

fn signed_area2([a, b, c]: [Vector2<f64>; 3]) -> f64 {
    (b - a).perp(&(c - a))
}

fn contains_point(point: Vector2<f64>, [a, b, c]: [Vector2<f64>; 3]) -> bool {
    signed_area2([a, b, point]) >= 0.0 && signed_area2([b, c, point]) >= 0.0 && signed_area2([c, a, point]) >= 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(points: &[[f32; 3]], triangles: &[[usize; 3]]) -> (f64, f64) {
        let signed = |triangle: &[usize; 3]| {
            let [a, b, c] = triangle.map(|index| Vector3::from(points[index]).cast::<f64>());
            (b - a).cross(&(c - a)).z / 2.0
        };
        (triangles.iter().map(signed).sum(), triangles.iter().map(|triangle| signed(triangle).abs()).sum())
    }

    #[test]
    fn concave_polygons_are_covered_once_whichever_corner_comes_first() {
        let arrow = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 2.0, 0.0]];
        let letter_u = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [2.0, 3.0], [2.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]]
            .map(|[x, y]| [x, y, 1e3]);
        for (polygon, whole) in [(&arrow[..], 1.0), (&letter_u[..], 7.0)] {
            for first in 0..polygon.len() {
                let mut turned = polygon.to_vec();
                turned.rotate_left(first);
                let triangles = triangulate(&turned);
                assert_eq!(triangles.len(), polygon.len() - 2);
                let (signed, covered) = area(&turned, &triangles);
                assert!((signed - whole).abs() < 1e-9 && (covered - whole).abs() < 1e-9, "{first}: {signed} {covered}");
            }
        }
        // Counterexample: a plain fan of the arrow from its second corner covers too much area.
        let mut turned = arrow.to_vec();
        turned.rotate_left(1);
        let (_, fan) = area(&turned, &[[0, 1, 2], [0, 2, 3]]);
        let (_, ours) = area(&turned, &triangulate(&turned));
        assert!(fan >= ours - 1e-9);
        let (_, from_first) = area(&arrow, &[[1, 2, 3], [1, 3, 0]]);
        assert!(from_first > 1.5, "the other diagonal is outside: {from_first}");
    }

    #[test]
    fn degenerate_and_huge_polygons_keep_their_count_of_triangles() {
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
