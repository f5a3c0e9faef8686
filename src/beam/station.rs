//! Positions along a beam, and the motion of the section there.

use nalgebra::Vector3;

/// A position along a beam: the element, and the fraction of its length, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Station {
    pub element: usize,
    pub fraction: f64,
}

impl Station {
    /// The same position after every element is divided into `parts` (at least 1) equal elements.
    #[must_use]
    pub fn subdivide(self, parts: usize) -> Self {
        let scaled_fraction = self.fraction * parts as f64;
        let part = (scaled_fraction as usize).min(parts.saturating_sub(1));
        Self { element: self.element * parts + part, fraction: scaled_fraction - part as f64 }
    }
}

/// Rest position and small motion of a section.
#[derive(Debug, Clone, Copy)]
pub struct SectionMotion {
    /// Rest position of the center, meters.
    pub center: Vector3<f64>,
    /// Displacement of the center.
    pub translation: Vector3<f64>,
    /// Rotation vector, radians.
    pub rotation: Vector3<f64>,
}

impl SectionMotion {
    /// Displacement of a point that is fixed to the section.
    pub fn displacement_of(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.translation + self.rotation.cross(&(point - self.center))
    }
}
