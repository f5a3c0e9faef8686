//! The blade of a leaf as a thin strip.
//!
//! A blade is long, thin and held at one end, and its lowest modes bend it across its plane and twist it. A strip along
//! the midrib has these modes: its sections keep their shape, and its bending and torsional stiffness are those of a thin
//! plate of the local width. It neglects that a wide blade also bends across the midrib.

use modalcast_beam::{BeamElement, ElasticConstants, Profile};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};

/// Number of sections along a blade. Each of them is an element.
const SECTIONS: usize = 6;

/// A triangle with longer edges than this fraction of the length of the blade is divided for the measurement.
const MAX_EDGE: f64 = 0.05;

/// Most divisions of an edge of a triangle for the measurement.
const MAX_DIVISIONS: usize = 24;

/// Smallest width of a section, as a fraction of the mean width.
const MIN_WIDTH: f64 = 0.05;

/// The midrib of a blade from its base to its tip, and its elements.
#[derive(Debug)]
pub(super) struct BladeStrip {
    /// Nodes after the base, meters.
    pub(super) nodes: Vec<Vector3<f64>>,
    /// One element per node.
    pub(super) elements: Vec<BeamElement>,
}

/// Areas of the blade between two planes across its axis.
#[derive(Debug, Clone, Copy)]
struct Slice {
    area: f64,
    /// Integral of the position over the area.
    moment: Vector3<f64>,
    /// Integral of n n^T over the area for the unit normal n. It does not depend on the winding of the triangles.
    normals: Matrix3<f64>,
}

impl BladeStrip {
    /// Fits a strip to the triangles of a blade that begins at `base`. The axis points from the base to the center of the
    /// blade. Each section has the area of its slice, so that the strip has the mass of the blade. `slenderness` is the
    /// ratio of the length to the thickness. `None` if the blade has no area or no length.
    pub(super) fn fit(
        base: &Vector3<f64>,
        triangles: &[[Vector3<f64>; 3]],
        material: ElasticConstants,
        slenderness: f64,
    ) -> Option<Self> {
        let area =
            |triangle: &[Vector3<f64>; 3]| 0.5 * (triangle[1] - triangle[0]).cross(&(triangle[2] - triangle[0])).norm();
        let total_area: f64 = triangles.iter().map(area).sum();
        let center = triangles.iter().map(|triangle| triangle.iter().sum::<Vector3<f64>>() * (area(triangle) / 3.0));
        let center = center.sum::<Vector3<f64>>() / total_area;
        let axis = (center - base).try_normalize(1e-12)?;
        let heights = triangles.iter().flatten().map(|point| (point - base).dot(&axis));
        let length = heights.fold(0.0, f64::max);
        let is_measurable = length.is_finite() && length > 0.0 && total_area.is_finite() && total_area > 0.0;
        if !is_measurable {
            return None;
        }
        let slices = slice(base, &axis, length, triangles);
        Some(Self::through(base, &slices, total_area, material, [length, length / slenderness]))
    }

    /// The strip through the centers of the slices.
    fn through(
        base: &Vector3<f64>,
        slices: &[Slice],
        total_area: f64,
        material: ElasticConstants,
        [length, thickness]: [f64; 2],
    ) -> Self {
        let filled: Vec<&Slice> =
            slices.iter().filter(|slice| slice.area > 1e-3 * total_area / SECTIONS as f64).collect();
        let centers: Vec<Vector3<f64>> = filled.iter().map(|slice| slice.moment / slice.area).collect();
        let (mut nodes, mut elements, mut start) = (Vec::new(), Vec::new(), *base);
        for (index, slice) in filled.iter().enumerate() {
            let end = match centers.get(index + 1) {
                Some(next) => 0.5 * (centers[index] + next),
                None => centers[index] + (centers[index] - start),
            };
            let section_length = (end - start).norm();
            if section_length <= 1e-6 * length {
                continue;
            }
            let width = (slice.area / section_length).max(MIN_WIDTH * total_area / length);
            let profile = Profile::Strip { widths: [width; 2], thickness, normal: dominant_direction(&slice.normals) };
            nodes.push(end);
            elements.push(BeamElement { profile, material });
            start = end;
        }
        Self { nodes, elements }
    }
}

/// Divides the area of the triangles among slices of equal height.
fn slice(base: &Vector3<f64>, axis: &Vector3<f64>, length: f64, triangles: &[[Vector3<f64>; 3]]) -> Vec<Slice> {
    let empty = Slice { area: 0.0, moment: Vector3::zeros(), normals: Matrix3::zeros() };
    let mut slices = vec![empty; SECTIONS];
    for [a, b, c] in triangles {
        let cross = (b - a).cross(&(c - a));
        let Some(normal) = cross.try_normalize(1e-30) else { continue };
        let longest_edge = (b - a).norm().max((c - a).norm()).max((c - b).norm());
        let divisions = ((longest_edge / (MAX_EDGE * length)).ceil() as usize).clamp(1, MAX_DIVISIONS);
        let part_area = 0.5 * cross.norm() / (divisions * divisions) as f64;
        for (row, column) in (0..divisions).flat_map(|row| (0..divisions - row).map(move |column| (row, column))) {
            // A cell of the grid in the triangle has one part or, except at the third edge, two.
            let is_inner = row + column + 1 < divisions;
            for third in [Some(1.0 / 3.0), is_inner.then_some(2.0 / 3.0)].into_iter().flatten() {
                let place = |index: usize| (index as f64 + third) / divisions as f64;
                let point = a + (b - a) * place(row) + (c - a) * place(column);
                let fraction = (point - base).dot(axis) / length;
                let slice = &mut slices[((fraction.max(0.0) * SECTIONS as f64) as usize).min(SECTIONS - 1)];
                slice.area += part_area;
                slice.moment += point * part_area;
                slice.normals += normal * normal.transpose() * part_area;
            }
        }
    }
    slices
}

/// The eigenvector of the largest eigenvalue.
fn dominant_direction(matrix: &Matrix3<f64>) -> Vector3<f64> {
    let eigen = SymmetricEigen::new(*matrix);
    eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MATERIAL: ElasticConstants = ElasticConstants { youngs_modulus: 5e8, shear_modulus: 2e8, density: 800.0 };

    /// A rectangle of the given length along x and width along y, as `rows` pairs of triangles. The last flag reverses
    /// every second pair.
    fn rectangle(length: f64, width: f64, rows: usize, is_mixed: bool) -> Vec<[Vector3<f64>; 3]> {
        let point = |row: usize, side: f64| Vector3::new(length * row as f64 / rows as f64, side * width, 0.0);
        let pair = |row: usize| {
            let [a, b, c, d] = [point(row, -0.5), point(row + 1, -0.5), point(row + 1, 0.5), point(row, 0.5)];
            if is_mixed && row % 2 == 1 { [[a, c, b], [a, d, c]] } else { [[a, b, c], [a, c, d]] }
        };
        (0..rows).flat_map(pair).collect()
    }

    #[test]
    fn strip_has_the_area_and_length_of_the_blade() {
        for (rows, is_mixed) in [(1, false), (2, false), (7, true)] {
            let triangles = rectangle(0.12, 0.04, rows, is_mixed);
            let strip = BladeStrip::fit(&Vector3::zeros(), &triangles, MATERIAL, 400.0).expect("a blade");
            assert_eq!((strip.nodes.len(), strip.elements.len()), (SECTIONS, SECTIONS));
            let mut start = Vector3::zeros();
            let mut mass = 0.0;
            for (node, element) in strip.nodes.iter().zip(&strip.elements) {
                mass += (node - start).norm() * element.profile.mean_area() * 800.0;
                start = *node;
                let Profile::Strip { normal, widths, .. } = element.profile else { panic!("expected a strip") };
                assert!(normal.z.abs() > 1.0 - 1e-9, "{normal}");
                assert!((widths[0] / 0.04 - 1.0).abs() < 0.1, "{widths:?}");
            }
            assert!((mass / (0.12 * 0.04 * 3e-4 * 800.0) - 1.0).abs() < 1e-6, "{mass}");
            assert!((start - Vector3::new(0.12, 0.0, 0.0)).norm() < 0.01, "{start}");
        }
    }

    #[test]
    fn midrib_follows_a_curled_blade() {
        // A strip along a quarter of a circle of radius 0.1.
        let place = |index: usize, side: f64| {
            let angle = std::f64::consts::FRAC_PI_2 * index as f64 / 40.0;
            Vector3::new(0.1 * angle.sin(), side, 0.1 * angle.cos() - 0.1)
        };
        let triangles: Vec<_> = (0..40)
            .flat_map(|index| {
                let [a, b, c, d] =
                    [place(index, -0.01), place(index + 1, -0.01), place(index + 1, 0.01), place(index, 0.01)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        let strip = BladeStrip::fit(&Vector3::zeros(), &triangles, MATERIAL, 400.0).expect("a blade");
        let center = Vector3::new(0.0, 0.0, -0.1);
        for node in &strip.nodes {
            assert!(((node - center).norm() - 0.1).abs() < 4e-3, "{node}");
        }
        let tip = strip.nodes[strip.nodes.len() - 1];
        assert!((tip - Vector3::new(0.1, 0.0, -0.1)).norm() < 0.01, "{tip}");
    }

    #[test]
    fn degenerate_blades_have_no_strip() {
        let base = Vector3::zeros();
        let flat = [Vector3::zeros(), Vector3::x(), Vector3::x() * 2.0];
        let centered =
            rectangle(0.1, 0.1, 1, false).iter().map(|triangle| triangle.map(|p| p - Vector3::x() * 0.05)).collect();
        for triangles in [vec![], vec![flat], vec![[base; 3]], centered, vec![[Vector3::repeat(f64::NAN); 3]]] {
            assert!(BladeStrip::fit(&base, &triangles, MATERIAL, 400.0).is_none(), "{triangles:?}");
        }
        assert!(BladeStrip::fit(&base, &rectangle(0.1, 0.1, 1, false), MATERIAL, 400.0).is_some());
    }
}
