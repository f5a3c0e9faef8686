//! Cross sections of beam elements, and the elastic constants of their material.

use nalgebra::{Matrix3, Vector3};

/// Shear correction factor of circular sections (Timoshenko).
const CIRCLE_SHEAR_FACTOR: f64 = 0.9;

/// Shear correction factor of rectangular sections (Reissner).
const RECTANGLE_SHEAR_FACTOR: f64 = 5.0 / 6.0;

/// Elastic constants (Pa) and density (kg/m^3).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ElasticConstants {
    pub youngs_modulus: f64,
    pub shear_modulus: f64,
    pub density: f64,
}

/// The cross sections along an element.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Profile {
    /// A truncated cone: circles whose radius is linear along the element. Radii at the start and at the end, meters.
    Cone { radii: [f64; 2] },
    /// A thin strip: rectangles whose width is linear along the element, meters. `normal` is the direction of the
    /// thickness. Its part along the element is ignored.
    Strip { widths: [f64; 2], thickness: f64, normal: Vector3<f64> },
}

/// Properties of one cross section in local axes. Local x is the normal of the section.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Section {
    /// m^2.
    pub(crate) area: f64,
    /// Second moments of area for bending in local y and in local z, m^4.
    pub(crate) moments: [f64; 2],
    /// Torsion constant, m^4.
    pub(crate) torsion: f64,
    /// Area that resists shear, m^2.
    pub(crate) shear_area: f64,
}

impl Section {
    /// Polar moment of area, m^4.
    pub(crate) fn polar_moment(&self) -> f64 {
        self.moments[0] + self.moments[1]
    }

    fn is_valid(&self) -> bool {
        let numbers = [self.area, self.moments[0], self.moments[1], self.torsion];
        numbers.iter().all(|number| number.is_finite() && *number > 0.0)
    }
}

impl Profile {
    /// The section at a fraction of the element.
    pub(crate) fn section(&self, fraction: f64) -> Section {
        let interpolate = |ends: &[f64; 2]| ends[0] + (ends[1] - ends[0]) * fraction;
        match self {
            Self::Cone { radii } => {
                let radius = interpolate(radii);
                let area = std::f64::consts::PI * radius.powi(2);
                let moment = std::f64::consts::FRAC_PI_4 * radius.powi(4);
                Section { area, moments: [moment; 2], torsion: 2.0 * moment, shear_area: CIRCLE_SHEAR_FACTOR * area }
            }
            // Local z is the direction of the thickness.
            Self::Strip { widths, thickness, .. } => {
                let (width, area) = (interpolate(widths), interpolate(widths) * thickness);
                Section {
                    area,
                    moments: [area * width * width / 12.0, area * thickness * thickness / 12.0],
                    torsion: area * thickness * thickness / 3.0,
                    shear_area: RECTANGLE_SHEAR_FACTOR * area,
                }
            }
        }
    }

    /// Whether all sections have finite positive areas and moments.
    pub(crate) fn is_valid(&self) -> bool {
        let has_direction = match self {
            Self::Cone { .. } => true,
            Self::Strip { normal, .. } => normal.iter().all(|entry| entry.is_finite()),
        };
        has_direction && [0.0, 1.0].iter().all(|fraction| self.section(*fraction).is_valid())
    }

    /// Mean area in m^2.
    pub fn mean_area(&self) -> f64 {
        match self {
            Self::Cone { radii: [a, b] } => std::f64::consts::PI * (a * a + a * b + b * b) / 3.0,
            Self::Strip { widths: [a, b], thickness, .. } => 0.5 * (a + b) * thickness,
        }
    }

    /// The local axes of an element along the unit vector `x`, as rows.
    pub(crate) fn axes(&self, x: &Vector3<f64>) -> Matrix3<f64> {
        let reference = if x.x.abs() < 0.7 { Vector3::x() } else { Vector3::z() };
        let side = |direction: Vector3<f64>| (direction - x * x.dot(&direction)).try_normalize(1e-9);
        let z = match self {
            Self::Strip { normal, .. } => normal.try_normalize(0.0).and_then(side),
            Self::Cone { .. } => None,
        };
        let z = z.unwrap_or_else(|| x.cross(&reference).normalize());
        Matrix3::from_rows(&[x.transpose(), z.cross(x).transpose(), z.transpose()])
    }

    /// The profile of the part of the element between two fractions of its length.
    #[must_use]
    pub fn part(&self, from: f64, to: f64) -> Self {
        let cut = |ends: [f64; 2]| [from, to].map(|fraction| ends[0] + (ends[1] - ends[0]) * fraction);
        match *self {
            Self::Cone { radii } => Self::Cone { radii: cut(radii) },
            Self::Strip { widths, thickness, normal } => Self::Strip { widths: cut(widths), thickness, normal },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_area_is_the_mean_over_the_length() {
        let strip = Profile::Strip { widths: [0.03, 0.01], thickness: 1e-3, normal: Vector3::z() };
        for profile in [Profile::Cone { radii: [2.0, 1.0] }, strip] {
            let count = 100_000;
            let sum: f64 =
                (0..count).map(|index| profile.section((f64::from(index) + 0.5) / f64::from(count)).area).sum();
            assert!((profile.mean_area() / (sum / f64::from(count)) - 1.0).abs() < 1e-9, "{profile:?}");
        }
    }

    #[test]
    fn moments_are_integrals_over_the_section() {
        // A rectangle of 0.4 in local y times 0.1 in local z, by the midpoint rule.
        let strip = Profile::Strip { widths: [0.4; 2], thickness: 0.1, normal: Vector3::z() };
        let (mut about_z, mut about_y, count) = (0.0, 0.0, 400);
        for (row, column) in (0..count).flat_map(|row| (0..count).map(move |column| (row, column))) {
            let coordinate = |index: i32, side: f64| side * ((f64::from(index) + 0.5) / f64::from(count) - 0.5);
            let cell = 0.04 / f64::from(count * count);
            about_z += coordinate(row, 0.4).powi(2) * cell;
            about_y += coordinate(column, 0.1).powi(2) * cell;
        }
        let section = strip.section(0.5);
        assert!((section.moments[0] / about_z - 1.0).abs() < 1e-4 && (section.moments[1] / about_y - 1.0).abs() < 1e-4);
        assert!(section.moments[0] > 10.0 * section.moments[1], "expected a strip that is stiff in its plane");
    }

    #[test]
    fn axes_of_a_strip_follow_its_normal() {
        let normal = Vector3::new(0.3, 0.2, 2.0);
        let axes = Profile::Strip { widths: [1.0; 2], thickness: 0.1, normal }.axes(&Vector3::x());
        assert!(
            (axes * axes.transpose() - Matrix3::identity()).norm() < 1e-12 && (axes.determinant() - 1.0).abs() < 1e-12
        );
        assert!((axes.row(2).transpose() - Vector3::new(0.0, 0.2, 2.0).normalize()).norm() < 1e-12);
        // A normal along the element has no direction within the section.
        let axes = Profile::Strip { widths: [1.0; 2], thickness: 0.1, normal: Vector3::x() }.axes(&Vector3::x());
        assert!((axes * axes.transpose() - Matrix3::identity()).norm() < 1e-12);
    }
}
