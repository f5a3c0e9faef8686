//! The beams of shoots and leaves, in the frames of their domains.

use modalcast_beam::{Beam, BeamElement, BeamError, RigidInertia};
use nalgebra::{Matrix3, Rotation3, Vector3};

use super::blade::BladeStrip;
use super::skin::RingCenter;
use crate::load::plant_materials::PlantMaterials;

/// Least number of elements of a shoot: enough for twelve modes.
const SHOOT_ELEMENTS: usize = 16;

/// Least number of elements of a petiole.
const PETIOLE_ELEMENTS: usize = 4;

/// Length of petiole and blade together, in radii of a petiole without a mesh. The leaves of almond and bean have 150 to
/// 350.
const LEAF_LENGTH_IN_RADII: f64 = 200.0;

/// A leaf base is at the end of the petiole if it is nearer than this fraction of the petiole's length.
const BASE_TOLERANCE: f64 = 1e-3;

/// A beam and the points of its polyline.
#[derive(Debug)]
pub(super) struct OrganBeam {
    pub(super) beam: Beam,
    pub(super) rings: Vec<RingCenter>,
}

/// The geometry of a leaf, in the frame of its domain.
#[derive(Debug)]
pub(super) struct LeafGeometry {
    /// Polyline of the petiole; empty without one.
    pub(super) petiole: Vec<Vector3<f64>>,
    /// Corners of the petiole's mesh.
    pub(super) petiole_points: Vec<Vector3<f64>>,
    /// Where the blade begins.
    pub(super) base: Vector3<f64>,
    pub(super) blade: Vec<[Vector3<f64>; 3]>,
}

impl OrganBeam {
    /// The beam of a shoot along its polyline.
    ///
    /// # Errors
    /// `Invalid` if the shoot has no length or a radius of 0.
    pub(super) fn of_shoot(
        points: &[Vector3<f64>],
        radii: &[f64],
        materials: &PlantMaterials,
    ) -> Result<Self, BeamError> {
        let beam = Beam::along(points, radii, materials.wood(), SHOOT_ELEMENTS)?;
        Ok(Self { beam, rings: ring_centers(points, radii) })
    }

    /// The beam of a leaf: the petiole, then the blade as a strip.
    ///
    /// # Errors
    /// `Invalid` if the leaf has neither a petiole nor a blade.
    pub(super) fn of_leaf(leaf: &LeafGeometry, materials: &PlantMaterials) -> Result<Self, BeamError> {
        let blade_length = leaf.blade.iter().flatten().map(|point| (point - leaf.base).norm()).fold(0.0, f64::max);
        let radii = petiole_radii(&leaf.petiole, &leaf.petiole_points, blade_length);
        let petiole = Beam::along(&leaf.petiole, &radii, materials.petiole(), PETIOLE_ELEMENTS).ok();
        let start = petiole.as_ref().map_or(leaf.base, |beam| beam.nodes()[beam.elements().len()]);
        let (mut nodes, mut elements) = match &petiole {
            Some(beam) => (beam.nodes().to_vec(), beam.elements().to_vec()),
            None => (vec![start], Vec::new()),
        };
        let strip = BladeStrip::fit(&leaf.base, &leaf.blade, materials.blade(), materials.blade_slenderness());
        if let Some(strip) = strip {
            // A blade whose base is beside the petiole's end is connected to it.
            let has_gap =
                petiole.as_ref().is_some_and(|beam| (leaf.base - start).norm() > BASE_TOLERANCE * beam.length());
            if let (true, Some(element)) = (has_gap, elements.last().copied()) {
                nodes.push(leaf.base);
                let BeamElement { profile, .. } = element;
                elements.push(BeamElement { profile: profile.part(1.0, 1.0), ..element });
            }
            nodes.extend(strip.nodes);
            elements.extend(strip.elements);
        }
        let rings = if petiole.is_some() { ring_centers(&leaf.petiole, &radii) } else { Vec::new() };
        Ok(Self { beam: Beam::new(nodes, elements)?, rings })
    }
}

/// The points of a polyline on its beam.
fn ring_centers(points: &[Vector3<f64>], radii: &[f64]) -> Vec<RingCenter> {
    let mut arc_length = 0.0;
    let mut centers = Vec::with_capacity(points.len());
    for (index, radius) in radii.iter().enumerate() {
        if index > 0 {
            arc_length += (points[index] - points[index - 1]).norm();
        }
        centers.push(RingCenter { arc_length, radius: *radius });
    }
    centers
}

/// The radius at each point of a petiole: the mean distance of the points of its mesh that are nearest to this point. A
/// point without any has the mean radius of the others. Without a mesh, the radius is a fraction of the length of the leaf.
fn petiole_radii(polyline: &[Vector3<f64>], mesh_points: &[Vector3<f64>], blade_length: f64) -> Vec<f64> {
    let length: f64 = polyline.windows(2).map(|ends| (ends[1] - ends[0]).norm()).sum();
    let mut sums = vec![(0.0, 0.0); polyline.len()];
    for point in mesh_points {
        let distance = |index: &usize| (polyline[*index] - point).norm();
        if let Some(nearest) = (0..polyline.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))) {
            sums[nearest].0 += distance_to_polyline(polyline, point);
            sums[nearest].1 += 1.0;
        }
    }
    let (sum, count) = sums.iter().fold((0.0, 0.0), |total, part| (total.0 + part.0, total.1 + part.1));
    let mean = if count > 0.0 && sum > 0.0 { sum / count } else { (length + blade_length) / LEAF_LENGTH_IN_RADII };
    let radius = |(sum, count): &(f64, f64)| if *sum > 0.0 { sum / count } else { mean };
    sums.iter().map(radius).collect()
}

fn distance_to_polyline(polyline: &[Vector3<f64>], point: &Vector3<f64>) -> f64 {
    let to_segment = |ends: &[Vector3<f64>]| {
        let direction = ends[1] - ends[0];
        let squared_length = direction.norm_squared();
        let fraction = if squared_length > 0.0 {
            ((point - ends[0]).dot(&direction) / squared_length).clamp(0.0, 1.0)
        } else {
            0.0
        };
        (ends[0] + direction * fraction - point).norm()
    };
    polyline.windows(2).map(to_segment).fold(f64::INFINITY, f64::min)
}

/// The inertia about `point` of a solid that is enclosed by triangles, which may all have the wrong orientation. A surface
/// that encloses no volume has no mass.
pub(super) fn solid_inertia(triangles: &[[Vector3<f64>; 3]], density: f64, point: &Vector3<f64>) -> RigidInertia {
    let (mut volume, mut moment, mut spread) = (0.0, Vector3::zeros(), Matrix3::zeros());
    for triangle in triangles {
        // A tetrahedron with its fourth corner at the point: the integrals of 1, x and x x^T.
        let [a, b, c] = triangle.map(|corner| corner - point);
        let part = a.dot(&b.cross(&c)) / 6.0;
        let sum = a + b + c;
        volume += part;
        moment += sum * (part / 4.0);
        spread += (a * a.transpose() + b * b.transpose() + c * c.transpose() + sum * sum.transpose()) * (part / 20.0);
    }
    if !(volume.is_finite() && volume != 0.0) {
        return RigidInertia::zero();
    }
    let mass = density * volume.abs();
    let center = moment / volume;
    // The second moments about the center, which are positive for a solid.
    let central = spread / volume - center * center.transpose();
    if !central.symmetric_eigenvalues().iter().all(|moment| *moment > 0.0) {
        return RigidInertia::zero();
    }
    let tensor = (Matrix3::identity() * central.trace() - central) * mass;
    RigidInertia::body(mass, Vector3::zeros(), tensor).seen_from(&Rotation3::identity(), &center)
}

#[cfg(test)]
mod tests {
    use modalcast_beam::Profile;

    use super::*;

    fn materials() -> PlantMaterials {
        PlantMaterials::default()
    }

    fn blade(start: f64) -> Vec<[Vector3<f64>; 3]> {
        let point = |x: f64, y: f64| Vector3::new(start + x, y, 0.0);
        let [a, b, c, d] = [point(0.0, -0.02), point(0.1, -0.02), point(0.1, 0.02), point(0.0, 0.02)];
        vec![[a, b, c], [a, c, d]]
    }

    #[test]
    fn leaf_is_a_petiole_with_a_strip() {
        let petiole = vec![Vector3::zeros(), Vector3::new(0.04, 0.0, 0.0)];
        let ring = |x: f64| {
            (0..3).map(move |side| {
                Vector3::new(x, 5e-4 * (2.1 * f64::from(side)).cos(), 5e-4 * (2.1 * f64::from(side)).sin())
            })
        };
        let leaf = LeafGeometry {
            petiole,
            petiole_points: ring(0.0).chain(ring(0.04)).collect(),
            base: Vector3::new(0.04, 0.0, 0.0),
            blade: blade(0.04),
        };
        let OrganBeam { beam, rings } = OrganBeam::of_leaf(&leaf, &materials()).expect("a valid beam");
        assert_eq!(beam.elements().len(), 4 + 6);
        assert!((beam.length() - 0.14).abs() < 5e-3, "{}", beam.length());
        let Profile::Cone { radii } = beam.elements()[0].profile else { panic!("expected a petiole") };
        assert!((radii[0] / 5e-4 - 1.0).abs() < 1e-9);
        assert_eq!(rings.len(), 2);
        let modes = beam.solve_modes(3).expect("a converged solution");
        let hertz = modes.eigenvalues.iter().map(|eigenvalue| eigenvalue.sqrt() / std::f64::consts::TAU);
        assert!(hertz.clone().all(|hertz| (0.5..200.0).contains(&hertz)), "{:?}", hertz.collect::<Vec<_>>());
        let blade_mass = 800.0 * 0.1 / 400.0 * 0.1 * 0.04;
        let petiole_mass = 900.0 * std::f64::consts::PI * 25e-8 * 0.04;
        assert!((beam.rigid_inertia().mass() / (blade_mass + petiole_mass) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn leaves_without_petiole_or_blade_have_beams_of_the_rest() {
        let petiole = vec![Vector3::zeros(), Vector3::new(0.04, 0.0, 0.0)];
        let base = Vector3::new(0.05, 0.01, 0.0);
        let elements = |petiole: &[Vector3<f64>], blade: Vec<_>| {
            let leaf = LeafGeometry { petiole: petiole.to_vec(), petiole_points: vec![], base, blade };
            OrganBeam::of_leaf(&leaf, &materials()).map(|organ| organ.beam.elements().len())
        };
        assert_eq!(elements(&petiole, vec![]), Ok(4));
        assert_eq!(elements(&[], blade(0.05)), Ok(6));
        assert_eq!(elements(&petiole, blade(0.05)), Ok(4 + 1 + 6), "expected a connection of the blade to the petiole");
        assert!(elements(&[], vec![]).is_err());
        assert!(elements(&[Vector3::zeros(); 3], vec![]).is_err());
        assert!(elements(&[Vector3::repeat(f64::NAN); 2], vec![]).is_err());
    }

    #[test]
    fn solid_has_the_inertia_of_a_box() {
        let size = Vector3::new(0.2, 0.3, 0.5);
        let corner = |bits: usize| Vector3::from_fn(|axis, _| size[axis] * ((bits >> axis & 1) as f64));
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let mut triangles: Vec<_> = quads
            .iter()
            .flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]])
            .map(|triangle| triangle.map(|bits| corner(*bits) + Vector3::repeat(1.0)))
            .collect();
        let point = Vector3::new(0.3, -0.4, 0.1);
        let mass = 1000.0 * 0.03;
        let squares = size.component_mul(&size);
        let tensor = Matrix3::from_diagonal(&(Vector3::repeat(squares.sum()) - squares)) * (mass / 12.0);
        let center = Vector3::repeat(1.0) + size * 0.5 - point;
        let expected = RigidInertia::body(mass, Vector3::zeros(), tensor).seen_from(&Rotation3::identity(), &center);
        for _ in 0..2 {
            let actual = solid_inertia(&triangles, 1000.0, &point);
            assert!((actual.matrix() - expected.matrix()).norm() < 1e-9 * expected.matrix().norm());
            // The same surface inside out.
            triangles.iter_mut().for_each(|triangle| triangle.reverse());
        }
        assert_eq!(solid_inertia(&triangles[..1], 1000.0, &triangles[0][0]), RigidInertia::zero());
        assert_eq!(solid_inertia(&[], 1000.0, &point), RigidInertia::zero());
    }
}
