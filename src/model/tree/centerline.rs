//! The centerline of a branch: generated from a start direction and bends, sampled as points, tangents and arc lengths
//! in meters.

use nalgebra::{Rotation3, Vector3};

use super::random::SplitMix64;

/// Integration steps between two rings.
const STEPS: usize = 8;

/// Growth parameters of a branch. Angles are in radians, lengths in meters.
#[derive(Debug, Clone)]
pub(super) struct GrowthParameters {
    pub(super) length: f64,
    /// Number of beam elements along the branch.
    pub(super) elements: usize,
    /// Number of skin rings per beam element.
    pub(super) rings: usize,
    /// Node i of N is at arc length `length (i / N)^grading`: above 1, nodes are denser near the root.
    pub(super) grading: f64,
    /// Unit direction at the root.
    pub(super) start: Vector3<f64>,
    /// Unit direction of the light, opposite to gravity.
    pub(super) up: Vector3<f64>,
    /// Downward bend of the inner half by weight.
    pub(super) sag: f64,
    /// Upward bend of the outer half towards the light.
    pub(super) rise: f64,
    /// Amplitude of the random bends.
    pub(super) wander: f64,
}

/// A sampled curve: one sample per ring of the skin; every `rings`-th sample is a node of the beam.
#[derive(Debug, Clone)]
pub(super) struct Centerline {
    pub(super) points: Vec<Vector3<f64>>,
    /// Unit tangents.
    pub(super) tangents: Vec<Vector3<f64>>,
    /// Unit vectors perpendicular to the tangents, transported along the curve without twist.
    pub(super) sides: Vec<Vector3<f64>>,
    /// Arc length from the root.
    pub(super) arc_lengths: Vec<f64>,
    /// Samples per beam element.
    pub(super) rings: usize,
}

impl Centerline {
    /// Generates a curve from the origin.
    pub(super) fn grow(growth: &GrowthParameters, random: &mut SplitMix64) -> Self {
        let wander = RandomBends::new(growth, random);
        let arc_lengths = ring_arc_lengths(growth);
        let (mut point, mut tangent) = (Vector3::zeros(), growth.start);
        let mut line =
            Self { points: vec![point], tangents: vec![tangent], sides: vec![], arc_lengths, rings: growth.rings };
        for ring in 1..line.arc_lengths.len() {
            let step = (line.arc_lengths[ring] - line.arc_lengths[ring - 1]) / STEPS as f64;
            for sub in 0..STEPS {
                let along = (line.arc_lengths[ring - 1] + (sub as f64 + 0.5) * step) / growth.length;
                let bend = bend(growth, &tangent, along) + wander.at(along);
                let turned = (tangent + bend * (step / growth.length)).normalize();
                point += (tangent + turned).normalize() * step;
                tangent = turned;
            }
            line.points.push(point);
            line.tangents.push(tangent);
        }
        line.sides = parallel_transport(&line.tangents);
        line
    }

    pub(super) fn length(&self) -> f64 {
        self.arc_lengths.last().copied().unwrap_or(0.0)
    }

    /// The ring nearest to a fraction of the length.
    pub(super) fn ring_at(&self, fraction: f64) -> usize {
        let arc = fraction * self.length();
        let after = self.arc_lengths.partition_point(|at| *at < arc).clamp(1, self.arc_lengths.len() - 1);
        if arc - self.arc_lengths[after - 1] < self.arc_lengths[after] - arc { after - 1 } else { after }
    }

    /// The arc length of a ring as a fraction of the length.
    pub(super) fn fraction(&self, ring: usize) -> f64 {
        self.arc_lengths[ring] / self.length()
    }

    /// The beam's nodes.
    pub(super) fn nodes(&self) -> Vec<Vector3<f64>> {
        self.points.iter().copied().step_by(self.rings).collect()
    }

    /// A unit vector at ring `ring`, at `angle` from the tangent towards the direction `across`.
    pub(super) fn branch_direction(&self, ring: usize, angle: f64, across: &Vector3<f64>) -> Vector3<f64> {
        let tangent = self.tangents[ring];
        let flat = (across - tangent * tangent.dot(across)).try_normalize(1e-9).unwrap_or(self.sides[ring]);
        tangent * angle.cos() + flat * angle.sin()
    }
}

/// The frame of a part: +Y along `along`, +Z as close to `up` as possible.
pub(super) fn frame(along: &Vector3<f64>, up: &Vector3<f64>) -> Rotation3<f64> {
    let flat = up - along * along.dot(up);
    let z = flat.try_normalize(1e-6).unwrap_or_else(|| {
        let other = if along.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
        (other - along * along.dot(&other)).normalize()
    });
    Rotation3::from_basis_unchecked(&[along.cross(&z), *along, z])
}

fn ring_arc_lengths(growth: &GrowthParameters) -> Vec<f64> {
    let node = |index: usize| growth.length * (index as f64 / growth.elements as f64).powf(growth.grading);
    let within = |element: usize, ring: usize| {
        let fraction = ring as f64 / growth.rings as f64;
        node(element) * (1.0 - fraction) + node(element + 1) * fraction
    };
    let mut arc_lengths: Vec<f64> =
        (0..growth.elements).flat_map(|e| (0..growth.rings).map(move |r| (e, r))).map(|(e, r)| within(e, r)).collect();
    arc_lengths.push(growth.length);
    arc_lengths
}

/// Change of the tangent, per unit of relative length, by weight and light.
fn bend(growth: &GrowthParameters, tangent: &Vector3<f64>, along: f64) -> Vector3<f64> {
    let across = growth.up - tangent * tangent.dot(&growth.up);
    across * (2.0 * growth.rise * along - 2.0 * growth.sag * (1.0 - along))
}

/// Smooth random bends: three waves about each of two axes perpendicular to the start.
struct RandomBends {
    axes: [Vector3<f64>; 2],
    /// Amplitude, number of waves along the branch, and phase of each wave.
    waves: [[(f64, f64, f64); 3]; 2],
}

impl RandomBends {
    fn new(growth: &GrowthParameters, random: &mut SplitMix64) -> Self {
        let basis = frame(&growth.start, &growth.up);
        let mut wave = |number: usize| {
            let waves = number as f64 + random.between(0.6, 1.3);
            (
                growth.wander * std::f64::consts::TAU * waves * 0.5 / (1.0 + number as f64),
                waves,
                random.between(0.0, std::f64::consts::TAU),
            )
        };
        let waves = std::array::from_fn(|_| std::array::from_fn(&mut wave));
        Self { axes: [basis * Vector3::x(), basis * Vector3::z()], waves }
    }

    fn at(&self, along: f64) -> Vector3<f64> {
        let sum = |waves: &[(f64, f64, f64); 3]| -> f64 {
            waves.iter().map(|(size, waves, phase)| size * (std::f64::consts::TAU * waves * along + phase).cos()).sum()
        };
        self.axes[0] * sum(&self.waves[0]) + self.axes[1] * sum(&self.waves[1])
    }
}

fn parallel_transport(tangents: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let mut side = frame(&tangents[0], &Vector3::z()) * Vector3::x();
    let carry = |tangent: &Vector3<f64>| {
        side = (side - tangent * tangent.dot(&side)).normalize();
        side
    };
    tangents.iter().map(carry).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) fn straight_growth(length: f64, elements: usize, rings: usize) -> GrowthParameters {
        let (start, up) = (Vector3::y(), Vector3::z());
        GrowthParameters { length, elements, rings, grading: 1.0, start, up, sag: 0.0, rise: 0.0, wander: 0.0 }
    }

    #[test]
    fn a_branch_without_bends_is_straight_and_as_long_as_asked() {
        let line = Centerline::grow(&straight_growth(3.0, 6, 2), &mut SplitMix64::new(1));
        assert_eq!(line.points.len(), 13);
        assert!((line.points[12] - Vector3::new(0.0, 3.0, 0.0)).norm() < 1e-12);
        assert_eq!(line.nodes().len(), 7);
        assert_eq!(line.ring_at(0.5), 6);
        assert_eq!((line.ring_at(0.0), line.ring_at(1.0)), (0, 12));
    }

    #[test]
    fn light_bends_a_branch_up_and_weight_bends_it_down() {
        let tip = |sag, rise| {
            let growth = GrowthParameters { sag, rise, ..straight_growth(1.0, 8, 2) };
            Centerline::grow(&growth, &mut SplitMix64::new(1)).points[16].z
        };
        assert!(tip(0.0, 0.5) > 0.05);
        assert!(tip(0.5, 0.0) < -0.05);
    }

    #[test]
    fn frames_along_a_winding_branch_stay_orthonormal() {
        let growth = GrowthParameters { wander: 0.4, rise: 0.9, grading: 1.4, ..straight_growth(2.0, 10, 3) };
        let line = Centerline::grow(&growth, &mut SplitMix64::new(5));
        for (tangent, side) in line.tangents.iter().zip(&line.sides) {
            assert!((tangent.norm() - 1.0).abs() < 1e-12);
            assert!((side.norm() - 1.0).abs() < 1e-12);
            assert!(tangent.dot(side).abs() < 1e-12);
        }
        assert!(line.arc_lengths.windows(2).all(|pair| pair[1] > pair[0]));
    }

    #[test]
    fn a_frame_has_its_y_along_the_part_even_straight_up() {
        for along in [Vector3::y(), Vector3::new(1.0, 2.0, -0.5).normalize(), Vector3::z(), -Vector3::z()] {
            let turn = frame(&along, &Vector3::z());
            assert!((turn * Vector3::y() - along).norm() < 1e-12);
            assert!((turn.matrix().determinant() - 1.0).abs() < 1e-12);
        }
    }
}
