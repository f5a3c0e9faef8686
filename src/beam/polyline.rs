//! Beams along polylines with radii, and the station of a point near a beam.

use nalgebra::Vector3;

use crate::beam::{Beam, BeamElement, is_positive};
use crate::error::{Result, invalid};
use crate::profile::{ElasticConstants, Profile};
use crate::station::Station;

/// Largest ratio of the radii of an element. An element bends as a cubic. A strongly tapered section, such as a branch
/// collar, does not, so a beam with one element per collar is up to 0.6 % too stiff.
const MAX_RADIUS_RATIO: f64 = 1.15;

/// Points that are closer than this fraction of the length of the polyline are one point.
const EQUAL_POINTS: f64 = 1e-9;

/// Most elements that one segment is divided into because of its taper.
const MAX_TAPER_PARTS: usize = 8;

/// Most elements that a beam is divided into, in addition to its segments.
const MAX_MINIMUM: usize = 1024;

impl Beam {
    /// The beam along the polyline `points` (meters) with the radii at its points (meters). It has at least
    /// `min_elements` elements, at most 1,024 of which are additional. Repeated points are one point; the radius may
    /// jump there.
    ///
    /// # Errors
    /// `Invalid` unless there are as many radii as points, all numbers are finite, the radii are positive, and the
    /// polyline has a length.
    pub fn along(
        points: &[Vector3<f64>],
        radii: &[f64],
        material: ElasticConstants,
        min_elements: usize,
    ) -> Result<Self> {
        if points.len() != radii.len() {
            return Err(invalid("radii", "one per point", format!("{} for {} points", radii.len(), points.len())));
        }
        let length: f64 = points.windows(2).map(|ends| (ends[1] - ends[0]).norm()).sum();
        if !is_positive(length) {
            return Err(invalid("points", "a polyline of a positive finite length", length));
        }
        let max_length = length / min_elements.clamp(1, MAX_MINIMUM) as f64;
        let (mut nodes, mut elements) = (vec![points[0]], Vec::new());
        let mut start_radius = radii[0];
        for (point, radius) in points.iter().zip(radii).skip(1) {
            let start = nodes[nodes.len() - 1];
            let distance = (point - start).norm();
            if distance <= EQUAL_POINTS * length {
                start_radius = *radius;
                continue;
            }
            let profile = Profile::Cone { radii: [start_radius, *radius] };
            let ratio = (radius / start_radius).max(start_radius / radius);
            // The conversion of NaN is 0. The sections of such an element are rejected.
            let taper_parts = ((ratio.ln() / MAX_RADIUS_RATIO.ln()).ceil() as usize).clamp(1, MAX_TAPER_PARTS);
            let parts = taper_parts.max((distance / max_length - 1e-9).ceil() as usize);
            for part in 0..parts {
                let [from, to] = [part, part + 1].map(|part| part as f64 / parts as f64);
                nodes.push(start.lerp(point, to));
                elements.push(BeamElement { profile: profile.part(from, to), material });
            }
            start_radius = *radius;
        }
        Self::new(nodes, elements)
    }

    /// The distance of a station from the first node along the centerline, meters.
    pub fn arc_length(&self, station: Station) -> f64 {
        let lengths = self.nodes().windows(2).map(|ends| (ends[1] - ends[0]).norm());
        let weight = |element: usize| if element < station.element { 1.0 } else { station.fraction };
        lengths.take(station.element + 1).enumerate().map(|(element, length)| weight(element) * length).sum()
    }

    /// The station at a distance from the first node along the centerline, in meters. It is at a node if it is nearly
    /// one.
    pub fn station_at(&self, arc_length: f64) -> Station {
        let mut rest = arc_length.max(0.0);
        let tolerance = 1e-6 * self.length();
        for (element, ends) in self.nodes().windows(2).enumerate() {
            let length = (ends[1] - ends[0]).norm();
            if rest < length - tolerance {
                return Station { element, fraction: if rest <= tolerance { 0.0 } else { rest / length } };
            }
            rest -= length;
        }
        Station { element: self.elements().len() - 1, fraction: 1.0 }
    }

    /// The station whose center is nearest to `point`, and the distance in meters. Of several, the first one.
    pub fn nearest_station(&self, point: &Vector3<f64>) -> (Station, f64) {
        let mut nearest = (Station { element: 0, fraction: 0.0 }, f64::INFINITY);
        for (element, ends) in self.nodes().windows(2).enumerate() {
            let axis = ends[1] - ends[0];
            let fraction = ((point - ends[0]).dot(&axis) / axis.norm_squared()).clamp(0.0, 1.0);
            let distance = (ends[0] + axis * fraction - point).norm();
            if distance < nearest.1 {
                nearest = (Station { element, fraction }, distance);
            }
        }
        nearest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::WOOD;

    fn points(coordinates: &[f64]) -> Vec<Vector3<f64>> {
        coordinates.iter().map(|x| Vector3::new(*x, 0.0, 0.0)).collect()
    }

    #[test]
    fn repeated_points_are_one_node() {
        let beam = Beam::along(&points(&[0.0, 0.0, 0.5, 0.5, 0.5, 1.0]), &[9.0, 0.01, 0.01, 7.0, 0.02, 0.02], WOOD, 1)
            .expect("a valid beam");
        assert_eq!(beam.nodes(), points(&[0.0, 0.5, 1.0]));
        let radii: Vec<_> = beam.elements().iter().map(|element| element.profile).collect();
        assert_eq!(radii, [Profile::Cone { radii: [0.01; 2] }, Profile::Cone { radii: [0.02; 2] }]);
        assert!(beam.solve_modes(4).is_ok());
    }

    #[test]
    fn segments_are_divided_for_the_minimum_and_the_taper() {
        let uniform = Beam::along(&points(&[0.0, 1.0, 1.5]), &[0.01; 3], WOOD, 6).expect("a valid beam");
        assert_eq!(uniform.elements().len(), 6);
        let tapered = Beam::along(&points(&[0.0, 1.0]), &[0.02, 0.01], WOOD, 1).expect("a valid beam");
        assert_eq!(tapered.elements().len(), 5);
        let masses = [1, 40].map(|elements| {
            Beam::along(&points(&[0.0, 1.0]), &[0.02, 0.01], WOOD, elements).expect("a valid beam").element_mass()
        });
        assert!((masses[0] / masses[1] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn degenerate_polylines_are_errors() {
        let huge = f64::MAX;
        for (coordinates, radii, field) in [
            (&[][..], &[][..], "points"),
            (&[0.0], &[0.1], "points"),
            (&[1.0, 1.0], &[0.1, 0.1], "points"),
            (&[0.0, f64::NAN], &[0.1, 0.1], "points"),
            (&[-huge, huge], &[0.1, 0.1], "points"),
            (&[0.0, 1.0], &[0.1], "radii"),
            (&[0.0, 1.0], &[0.1, 0.0], "profile"),
            (&[0.0, 1.0], &[f64::NAN, 0.1], "profile"),
            (&[0.0, 1.0], &[-0.1, 0.1], "profile"),
            (&[0.0, 1.0], &[huge, huge], "profile"),
            (&[0.0, 1.0], &[0.1, f64::INFINITY], "profile"),
        ] {
            let error = Beam::along(&points(coordinates), radii, WOOD, 4).expect_err(field).to_string();
            assert!(error.starts_with(field), "{coordinates:?} {radii:?}: {error}");
        }
        // Counterexample: a valid polyline.
        assert!(Beam::along(&points(&[0.0, 1.0]), &[0.1, 0.1], WOOD, 4).is_ok());
        // The sections are finite, but their stiffness is not.
        let beam = Beam::along(&points(&[0.0, 1e-300]), &[1e70, 1e70], WOOD, 1);
        assert!(beam.and_then(|beam| beam.solve_modes(2)).is_err());
    }

    #[test]
    fn stations_and_arc_lengths_are_inverse() {
        let corner = [Vector3::zeros(), Vector3::new(1.0, 0.0, 0.0), Vector3::new(1.0, 2.0, 0.0)];
        let beam = Beam::along(&corner, &[0.1; 3], WOOD, 1).expect("a valid beam");
        for (arc_length, element, fraction) in
            [(0.0, 0, 0.0), (0.25, 0, 0.25), (1.0 - 1e-9, 1, 0.0), (1.0 + 1e-9, 1, 0.0), (2.5, 1, 0.75), (9.0, 1, 1.0)]
        {
            let station = beam.station_at(arc_length);
            assert_eq!(station.element, element, "{arc_length}");
            assert!((station.fraction - fraction).abs() < 1e-12, "{arc_length}");
            assert!((beam.arc_length(station) - arc_length.min(3.0)).abs() < 1e-8, "{arc_length}");
        }
    }

    #[test]
    fn nearest_station_is_on_the_nearest_element() {
        let corner = [Vector3::zeros(), Vector3::new(1.0, 0.0, 0.0), Vector3::new(1.0, 1.0, 0.0)];
        let beam = Beam::along(&corner, &[0.1; 3], WOOD, 1).expect("a valid beam");
        let (station, distance) = beam.nearest_station(&Vector3::new(1.2, 0.75, 0.0));
        assert!(station == Station { element: 1, fraction: 0.75 } && (distance - 0.2).abs() < 1e-12, "{station:?}");
        assert_eq!(beam.nearest_station(&Vector3::new(-5.0, 0.0, 0.0)).0, Station { element: 0, fraction: 0.0 });
        assert_eq!(beam.nearest_station(&Vector3::new(1.0, 9.0, 0.0)).0, Station { element: 1, fraction: 1.0 });
    }
}
