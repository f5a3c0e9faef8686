//! Clamped regions. The material in a region is removed, and the new faces are held by stiff springs, spread by area. A
//! clamp therefore does not stiffen the cells at its border.

use nalgebra::Vector3;

use crate::cell_pieces::CellPieces;
use crate::embedding::{EmbeddedPoint, embed};
use crate::grid::Grid;
use crate::material_rays::{RaySegment, bisect};
use crate::region::Region;
use crate::surface::{Surface, divide_triangle};

/// A point of a held face, and the area that it represents.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldPoint {
    /// In units of cells.
    pub position: Vector3<f64>,
    /// In units of cell faces.
    pub area: f64,
}

/// The stiffness of the springs, as a multiple of Young's modulus divided by the size of a cell: as stiff as a layer of
/// 1/1000 of a cell.
pub const SPRING_FACTOR: f64 = 1e3;

/// Removes the material in regions along the rays of an axis. Returns the remaining segments and the points where the
/// rays enter or leave a region inside of the material. `borders` are known coordinates of the borders of regions along the
/// axis, in units of cells: regions between two tested positions are found only there. `to_file` converts a point in
/// units of cells to the coordinates of regions.
pub fn remove_regions(
    grid: &Grid,
    segments: &[RaySegment],
    axis: usize,
    regions: &[Region],
    borders: &[f64],
    to_file: impl Fn(Vector3<f64>) -> Vector3<f64>,
) -> (Vec<RaySegment>, Vec<HeldPoint>) {
    /// Distance of the positions that are tested, in cells.
    const SAMPLE_DISTANCE: f64 = 0.25;
    /// Accuracy of a border, in cells.
    const ACCURACY: f64 = 1e-7;
    let (mut remaining, mut held) = (Vec::new(), Vec::new());
    for segment in segments {
        let is_held = |position: f64| {
            let point = to_file(grid.point_on_ray(axis, segment.ray, position));
            regions.iter().any(|region| region.contains(point))
        };
        let length = segment.end - segment.start;
        let intervals = (length / SAMPLE_DISTANCE).ceil().max(1.0) as usize;
        let mut positions: Vec<f64> =
            (1..intervals).map(|sample| segment.start + sample as f64 / intervals as f64 * length).collect();
        let around_borders = borders.iter().flat_map(|border| [border - ACCURACY, border + ACCURACY]);
        positions.extend(around_borders.filter(|position| (segment.start..segment.end).contains(position)));
        // Positions at the very ends, and beyond by the rounding, detect regions that only touch the surface.
        positions.extend([segment.start - ACCURACY, segment.end + ACCURACY]);
        positions.sort_by(f64::total_cmp);
        let mut start = segment.start;
        let mut was_held = is_held(positions[0]);
        for pair in positions.windows(2) {
            let [previous, position] = [pair[0], pair[1]];
            if is_held(position) == was_held {
                continue;
            }
            let [low, high] = bisect([previous, position], ACCURACY / 4.0, is_held);
            if !was_held && low > start {
                remaining.push(RaySegment { start, end: low, ..*segment });
            }
            let border = if was_held { high } else { low }.clamp(segment.start, segment.end);
            held.push(HeldPoint {
                position: grid.point_on_ray(axis, segment.ray, border),
                area: grid.ray_area(axis, segment.ray),
            });
            (start, was_held) = (border, !was_held);
        }
        if !was_held && segment.end > start {
            remaining.push(RaySegment { start, ..*segment });
        }
    }
    (remaining, held)
}

/// Points on the triangles of held groups. Each triangle is divided until its edges are shorter than a quarter of a cell.
pub fn points_on_groups(surface: &Surface, grid: &Grid, regions: &[Region]) -> Vec<HeldPoint> {
    const MAX_EDGE: f64 = 0.25;
    let is_group = |group: u32| regions.iter().any(|region| matches!(region, Region::Group(index) if *index == group));
    let mut points = Vec::new();
    for triangle in (0..surface.triangles.len()).filter(|index| is_group(surface.triangle_groups[*index])) {
        let corners = surface.corners(triangle).map(|corner| grid.to_cell_units(corner));
        divide_triangle(corners, MAX_EDGE, |[a, b, c]| {
            points.push(HeldPoint { position: (a + b + c) / 3.0, area: (b - a).cross(&(c - a)).norm() / 2.0 });
        });
    }
    points
}

/// The pieces and weights of held points, with the area of each.
pub fn embed_held_points(grid: &Grid, pieces: &CellPieces, points: &[HeldPoint]) -> Vec<(EmbeddedPoint, f64)> {
    let embedded = points.iter().filter_map(|point| Some((embed(grid, pieces, point.position)?, point.area)));
    embedded.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> Grid {
        Grid::covering(Vector3::zeros(), Vector3::repeat(2.0), 1.0)
    }

    fn slab_region() -> Vec<Region> {
        vec![Region::parse("z < 0.3", &[]).expect("a region")]
    }

    #[test]
    fn material_in_a_region_is_removed_and_its_border_held() {
        let segment = RaySegment { ray: [3, 4], start: 0.1, end: 2.0, group: 0 };
        let (remaining, held) = remove_regions(&grid(), &[segment], 2, &slab_region(), &[], |point| point);
        assert_eq!((remaining.len(), held.len()), (1, 1));
        assert!((remaining[0].start - 0.3).abs() < 1e-6 && remaining[0].end == 2.0);
        assert!((held[0].position.z - 0.3).abs() < 1e-6);
        let above = RaySegment { start: 0.4, ..segment };
        assert_eq!(remove_regions(&grid(), &[above], 2, &slab_region(), &[], |point| point), (vec![above], vec![]));
        let below = RaySegment { end: 0.2, ..segment };
        assert_eq!(remove_regions(&grid(), &[below], 2, &slab_region(), &[], |point| point), (vec![], vec![]));
    }

    /// A region much thinner than the distance of the tested positions, at either end of the material.
    #[test]
    fn thin_regions_at_the_surface_are_found() {
        let segment = RaySegment { ray: [0, 0], start: 0.0, end: 2.0, group: 0 };
        for text in ["z < 0.00001", "z > 1.99999"] {
            let regions = [Region::parse(text, &[]).expect("a region")];
            let (remaining, held) = remove_regions(&grid(), &[segment], 2, &regions, &[], |point| point);
            assert_eq!((remaining.len(), held.len()), (1, 1), "{text}");
        }
    }

    /// A slab inside of the material, much thinner than the distance of the tested positions.
    #[test]
    fn thin_slab_inside_is_found_at_its_border() {
        let segment = RaySegment { ray: [0, 0], start: 0.0, end: 2.0, group: 0 };
        let regions = [Region::parse("z > 0.7 && z < 0.701", &[]).expect("a region")];
        let (remaining, held) = remove_regions(&grid(), &[segment], 2, &regions, &[0.7, 0.701], |point| point);
        assert_eq!((remaining.len(), held.len()), (2, 2));
        let (_, unheld) = remove_regions(&grid(), &[segment], 2, &regions, &[], |point| point);
        assert!(unheld.is_empty(), "control: the tested positions alone miss the slab");
    }

    /// A region that contains only the first point of the material.
    #[test]
    fn region_of_the_surface_alone_is_found() {
        for offset in [0.0, 1e-9, -1e-9] {
            let segment = RaySegment { ray: [0, 0], start: offset, end: 2.0, group: 0 };
            let regions = [Region::parse("z <= 0", &[]).expect("a region")];
            let (_, held) = remove_regions(&grid(), &[segment], 2, &regions, &[], |point| point);
            assert_eq!(held.len(), 1, "{offset}");
        }
    }

    #[test]
    fn points_on_a_group_have_its_area() {
        let (positions, triangles) = crate::surface::tests::box_surface([0.0; 3], [2.0, 1.0, 1.0]);
        let groups: Vec<u32> = (0..12).map(|triangle| u32::from(triangle < 2)).collect();
        let surface = Surface::new(&positions, &triangles, &groups);
        let grid = Grid::covering(Vector3::zeros(), Vector3::new(2.0, 1.0, 1.0), 0.5);
        let points = points_on_groups(&surface, &grid, &[Region::Group(1)]);
        let area: f64 = points.iter().map(|point| point.area).sum();
        assert!((area * 0.25 - 2.0).abs() < 1e-9, "{area}");
        assert!(points.iter().all(|point| point.position.z.abs() < 1e-12));
    }
}
