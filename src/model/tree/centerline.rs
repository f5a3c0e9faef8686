//! The centerline of a branch: a curve that is generated from a start direction and bends. It has one sample per ring
//! of the skin (the circle of vertices around a point of the centerline).

use nalgebra::{Rotation3, Vector3};

use super::random::SplitMix64;

/// Integration steps between two rings.
const STEPS_PER_RING: usize = 8;

/// Growth parameters of a branch. Angles are in radians, lengths in meters.
#[derive(Debug, Clone)]
pub(super) struct GrowthParameters {
    pub(super) length: f64,
    /// Number of segments along the branch. Rings are equidistant within a segment.
    pub(super) segments: usize,
    pub(super) rings_per_segment: usize,
    /// Exponent of the segments' spacing: segment i of N begins at arc length `length (i / N)^grading`. Above 1,
    /// segments are denser near the root.
    pub(super) grading: f64,
    /// Unit direction at the root.
    pub(super) start: Vector3<f64>,
    /// Unit direction of the light, opposite to gravity.
    pub(super) up: Vector3<f64>,
    /// The angle by which weight bends a horizontal branch downwards in total. The bend is strongest at the root.
    pub(super) sag: f64,
    /// The angle by which a horizontal branch bends upwards to the light in total. The bend is strongest at the tip.
    pub(super) rise: f64,
    /// Amplitude of the random bends: the first of the three waves per axis swings the direction by wander / 2.
    pub(super) wander: f64,
}

/// A sampled curve with one sample per ring of the skin. The samples are also the nodes of the beam. Points and arc
/// lengths are in meters.
#[derive(Debug, Clone)]
pub(super) struct Centerline {
    pub(super) points: Vec<Vector3<f64>>,
    /// Unit tangents.
    pub(super) tangents: Vec<Vector3<f64>>,
    /// Unit vectors perpendicular to the tangents, transported along the curve without twist.
    pub(super) side_vectors: Vec<Vector3<f64>>,
    /// Arc length from the root.
    pub(super) arc_lengths: Vec<f64>,
}

impl Centerline {
    /// Generates a curve from the origin.
    pub(super) fn grow(growth: &GrowthParameters, random: &mut SplitMix64) -> Self {
        let random_bends = RandomBends::new(growth, random);
        let arc_lengths = ring_arc_lengths(growth);
        let (mut point, mut tangent) = (Vector3::zeros(), growth.start);
        let mut centerline = Self { points: vec![point], tangents: vec![tangent], side_vectors: vec![], arc_lengths };
        for ring in 1..centerline.arc_lengths.len() {
            let step = (centerline.arc_lengths[ring] - centerline.arc_lengths[ring - 1]) / STEPS_PER_RING as f64;
            for substep in 0..STEPS_PER_RING {
                let fraction = (centerline.arc_lengths[ring - 1] + (substep as f64 + 0.5) * step) / growth.length;
                // Change of the tangent per unit of relative length.
                let relative_bend = gravity_and_light_bend(growth, &tangent, fraction) + random_bends.sample(fraction);
                let next_tangent = (tangent + relative_bend * (step / growth.length)).normalize();
                point += (tangent + next_tangent).normalize() * step;
                tangent = next_tangent;
            }
            centerline.points.push(point);
            centerline.tangents.push(tangent);
        }
        centerline.side_vectors = parallel_transport(&centerline.tangents);
        centerline
    }

    /// The length in meters.
    pub(super) fn length(&self) -> f64 {
        self.arc_lengths.last().copied().unwrap_or(0.0)
    }

    /// The ring nearest to a fraction of the length.
    pub(super) fn ring_at(&self, fraction: f64) -> usize {
        let arc_length = fraction * self.length();
        let next_ring = self
            .arc_lengths
            .partition_point(|ring_arc_length| *ring_arc_length < arc_length)
            .clamp(1, self.arc_lengths.len() - 1);
        if arc_length - self.arc_lengths[next_ring - 1] < self.arc_lengths[next_ring] - arc_length {
            next_ring - 1
        } else {
            next_ring
        }
    }

    /// The arc length of a ring as a fraction of the length.
    pub(super) fn fraction(&self, ring: usize) -> f64 {
        self.arc_lengths[ring] / self.length()
    }

    /// The unit direction of a branch at ring `ring`: the tangent, rotated by `angle` towards the direction `side`.
    pub(super) fn branch_direction(&self, ring: usize, angle: f64, side: &Vector3<f64>) -> Vector3<f64> {
        let tangent = self.tangents[ring];
        let perpendicular = (side - tangent * tangent.dot(side)).try_normalize(1e-9).unwrap_or(self.side_vectors[ring]);
        tangent * angle.cos() + perpendicular * angle.sin()
    }
}

/// The orientation of a part: +Y along the unit vector `y`, +Z as close to `up` as possible.
pub(super) fn part_orientation(y: &Vector3<f64>, up: &Vector3<f64>) -> Rotation3<f64> {
    let projected_up = up - y * y.dot(up);
    let z = projected_up.try_normalize(1e-6).unwrap_or_else(|| {
        let fallback_axis = if y.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
        (fallback_axis - y * y.dot(&fallback_axis)).normalize()
    });
    Rotation3::from_basis_unchecked(&[y.cross(&z), *y, z])
}

/// The arc length of each ring.
fn ring_arc_lengths(growth: &GrowthParameters) -> Vec<f64> {
    let segment_arc_length =
        |index: usize| growth.length * (index as f64 / growth.segments as f64).powf(growth.grading);
    let ring_arc_length = |segment: usize, ring: usize| {
        let fraction = ring as f64 / growth.rings_per_segment as f64;
        segment_arc_length(segment) * (1.0 - fraction) + segment_arc_length(segment + 1) * fraction
    };
    let mut arc_lengths: Vec<f64> = (0..growth.segments)
        .flat_map(|segment| (0..growth.rings_per_segment).map(move |ring| (segment, ring)))
        .map(|(segment, ring)| ring_arc_length(segment, ring))
        .collect();
    arc_lengths.push(growth.length);
    arc_lengths
}

/// Change of the tangent by weight and light, per unit of relative length, at a fraction of the length.
fn gravity_and_light_bend(growth: &GrowthParameters, tangent: &Vector3<f64>, fraction: f64) -> Vector3<f64> {
    let perpendicular_up = growth.up - tangent * tangent.dot(&growth.up);
    // The factors 2 f and 2 (1 - f) have the integral 1 over the branch.
    perpendicular_up * (2.0 * growth.rise * fraction - 2.0 * growth.sag * (1.0 - fraction))
}

/// Smooth random bends: three waves about each of two axes perpendicular to the start.
struct RandomBends {
    axes: [Vector3<f64>; 2],
    /// Three waves per axis.
    waves: [[BendWave; 3]; 2],
}

/// One cosine wave of the bend along a branch.
struct BendWave {
    amplitude: f64,
    /// Number of periods along the branch.
    periods: f64,
    /// Phase at the root in radians.
    phase: f64,
}

impl RandomBends {
    fn new(growth: &GrowthParameters, random: &mut SplitMix64) -> Self {
        let basis = part_orientation(&growth.start, &growth.up);
        let mut wave = |index: usize| {
            let periods = index as f64 + random.uniform(0.6, 1.3);
            // Integrated along the branch, the wave swings the direction by wander / (2 (1 + index)) radians.
            BendWave {
                amplitude: growth.wander * std::f64::consts::TAU * periods * 0.5 / (1.0 + index as f64),
                periods,
                phase: random.uniform(0.0, std::f64::consts::TAU),
            }
        };
        let waves = std::array::from_fn(|_| std::array::from_fn(&mut wave));
        Self { axes: [basis * Vector3::x(), basis * Vector3::z()], waves }
    }

    /// The random bend at a fraction of the length.
    fn sample(&self, fraction: f64) -> Vector3<f64> {
        let value =
            |wave: &BendWave| wave.amplitude * (std::f64::consts::TAU * wave.periods * fraction + wave.phase).cos();
        let sum = |waves: &[BendWave; 3]| -> f64 { waves.iter().map(value).sum() };
        self.axes[0] * sum(&self.waves[0]) + self.axes[1] * sum(&self.waves[1])
    }
}

/// Unit vectors perpendicular to the tangents, transported without twist.
fn parallel_transport(tangents: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let mut side = part_orientation(&tangents[0], &Vector3::z()) * Vector3::x();
    let transport = |tangent: &Vector3<f64>| {
        side = (side - tangent * tangent.dot(&side)).normalize();
        side
    };
    tangents.iter().map(transport).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) fn straight_growth(
        length: f64,
        segments: usize,
        rings_per_segment: usize,
    ) -> GrowthParameters {
        let (start, up) = (Vector3::y(), Vector3::z());
        GrowthParameters {
            length,
            segments,
            rings_per_segment,
            grading: 1.0,
            start,
            up,
            sag: 0.0,
            rise: 0.0,
            wander: 0.0,
        }
    }

    #[test]
    fn branch_without_bends_is_straight() {
        let centerline = Centerline::grow(&straight_growth(3.0, 6, 2), &mut SplitMix64::new(1));
        // 6 segments x 2 rings, and the ring at the tip.
        assert_eq!(centerline.points.len(), 13);
        assert!((centerline.points[12] - Vector3::new(0.0, 3.0, 0.0)).norm() < 1e-12);
        assert_eq!(centerline.ring_at(0.5), 6);
        assert_eq!((centerline.ring_at(0.0), centerline.ring_at(1.0)), (0, 12));
    }

    #[test]
    fn rise_bends_a_branch_up_and_sag_bends_it_down() {
        let tip_height = |sag, rise| {
            let growth = GrowthParameters { sag, rise, ..straight_growth(1.0, 8, 2) };
            Centerline::grow(&growth, &mut SplitMix64::new(1)).points[16].z
        };
        assert!(tip_height(0.0, 0.5) > 0.05);
        assert!(tip_height(0.5, 0.0) < -0.05);
    }

    #[test]
    fn tangents_and_side_vectors_are_orthonormal() {
        let growth = GrowthParameters { wander: 0.4, rise: 0.9, grading: 1.4, ..straight_growth(2.0, 10, 3) };
        let centerline = Centerline::grow(&growth, &mut SplitMix64::new(5));
        for (tangent, side) in centerline.tangents.iter().zip(&centerline.side_vectors) {
            assert!((tangent.norm() - 1.0).abs() < 1e-12);
            assert!((side.norm() - 1.0).abs() < 1e-12);
            assert!(tangent.dot(side).abs() < 1e-12);
        }
        assert!(centerline.arc_lengths.windows(2).all(|pair| pair[1] > pair[0]));
    }

    #[test]
    fn part_orientation_is_a_rotation_even_straight_up() {
        for y in [Vector3::y(), Vector3::new(1.0, 2.0, -0.5).normalize(), Vector3::z(), -Vector3::z()] {
            let orientation = part_orientation(&y, &Vector3::z());
            assert!((orientation * Vector3::y() - y).norm() < 1e-12);
            assert!((orientation.matrix().determinant() - 1.0).abs() < 1e-12);
        }
    }
}
