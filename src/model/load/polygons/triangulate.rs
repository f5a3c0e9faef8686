//! Triangulation of a polygon in space.

use nalgebra::{Vector2, Vector3};

/// The largest polygon that is triangulated by ear clipping, which takes quadratic time. A larger polygon is split into
/// a fan. So the time for a file is at most proportional to its number of corners.
const MAX_EAR_CLIPPING_CORNERS: usize = 256;

/// The largest number of repeated searches for the ears of all corners. A simple polygon needs none.
const MAX_EAR_SEARCHES: usize = 4;

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

/// Cuts the first ear until a triangle remains. Only reflex corners can lie in an ear, and a cut changes the angles and
/// ears of no corners but its two neighbors (Eberly, Triangulation by Ear Clipping).
fn ear_clip(points: &[Vector2<f64>]) -> Vec<[usize; 3]> {
    let mut outline = Outline { points, remaining: (0..points.len()).collect(), is_reflex: Vec::new() };
    outline.is_reflex = (0..points.len()).map(|position| outline.is_reflex_at(position)).collect();
    let mut is_ear: Vec<bool> = outline.find_ears();
    let mut remaining_searches = MAX_EAR_SEARCHES;
    let mut triangles = Vec::with_capacity(points.len().saturating_sub(2));
    while outline.remaining.len() > 3 {
        let mut position = is_ear.iter().position(|is_ear| *is_ear);
        if position.is_none() && remaining_searches > 0 {
            remaining_searches -= 1;
            is_ear = outline.find_ears();
            position = is_ear.iter().position(|is_ear| *is_ear);
        }
        // A self-intersecting polygon may have no ear. In this case, cut any corner, so that no triangle is lost.
        let position = position.unwrap_or(1);
        triangles.push(outline.triangle_at(position));
        outline.remaining.remove(position);
        is_ear.remove(position);
        let count = outline.remaining.len();
        let neighbors = [(position + count - 1) % count, position % count];
        for neighbor in neighbors {
            outline.is_reflex[outline.remaining[neighbor]] = outline.is_reflex_at(neighbor);
        }
        for neighbor in neighbors {
            is_ear[neighbor] = outline.is_ear_at(neighbor);
        }
    }
    triangles.push([outline.remaining[0], outline.remaining[1], outline.remaining[2]]);
    triangles
}

/// A polygon of which corners are cut off.
struct Outline<'a> {
    points: &'a [Vector2<f64>],
    /// Indices into `points` of the corners that are not cut off, in order.
    remaining: Vec<usize>,
    /// For each point, whether its corner is not convex.
    is_reflex: Vec<bool>,
}

impl Outline<'_> {
    /// The corner at a position of `remaining`, between its neighbors.
    fn triangle_at(&self, position: usize) -> [usize; 3] {
        let (corners, count) = (&self.remaining, self.remaining.len());
        [corners[(position + count - 1) % count], corners[position], corners[(position + 1) % count]]
    }

    fn is_reflex_at(&self, position: usize) -> bool {
        signed_area2(self.triangle_at(position).map(|index| self.points[index])) <= 0.0
    }

    fn is_ear_at(&self, position: usize) -> bool {
        let ear = self.triangle_at(position);
        let corners = ear.map(|index| self.points[index]);
        let is_inside = |index: &usize| {
            self.is_reflex[*index] && !ear.contains(index) && contains_point(self.points[*index], corners)
        };
        !self.is_reflex[ear[1]] && !self.remaining.iter().any(is_inside)
    }

    fn find_ears(&self) -> Vec<bool> {
        (0..self.remaining.len()).map(|position| self.is_ear_at(position)).collect()
    }
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

    /// A thin arc: almost every convex corner has a corner of the other side in its triangle.
    #[test]
    fn thin_arc_is_covered_once() {
        let angles = (0..128).map(|index| f64::from(index) / 32.0);
        let outer = angles.clone().map(|angle| (1.0, angle));
        let inner = angles.rev().map(|angle| (0.9999, angle));
        let point = |(radius, angle): (f64, f64)| [(radius * angle.cos()) as f32, (radius * angle.sin()) as f32, 0.0];
        let arc: Vec<_> = outer.chain(inner).map(point).collect();
        let triangles = triangulate(&arc);
        assert_eq!(triangles.len(), 254);
        let [signed, absolute] = signed_and_absolute_area(&arc, &triangles);
        assert!((signed - absolute).abs() < 1e-9, "expected no overlap, got {signed} and {absolute}");
        // The area of the ring sector of 127 / 32 rad.
        let expected = 127.0 / 64.0 * (1.0 - 0.9999_f64.powi(2));
        assert!((signed - expected).abs() < 0.01 * expected, "expected about {expected}, got {signed}");
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
