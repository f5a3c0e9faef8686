//! Templates of leaf clusters: a green shoot with leaf blades. Sprays bend with two modes, rosettes are rigid. Lengths
//! are in meters, angles in radians. Numbers without a comment are free choices of the cluster's shape.

use modalcast_beam::ElasticConstants;
use nalgebra::{Rotation3, Unit, Vector3};

use super::centerline::{Centerline, GrowthParameters};
use super::leaf_image::{LEAF_SPAN, STEM_U};
use super::random::SplitMix64;
use super::skin::{Blade, SkinBuilder, UvMapping, sample_at};
use super::template::{PartKind, PartTemplate};

/// Green shoots are softer than wood.
const SHOOT: ElasticConstants = ElasticConstants { youngs_modulus: 3.0e9, shear_modulus: 2.0e8, density: 850.0 };

/// Fresh mass of a leaf in kg per m^2 of one side.
const LEAF_MASS_PER_AREA: f64 = 0.17;

/// The fraction of a blade (a textured rectangle) that the leaf in its image covers.
const LEAF_COVERAGE: f64 = 0.55;

/// Ratio of width to length of a blade.
const LEAF_ASPECT: f64 = 0.62;

/// Parameters of a leaf cluster. Lengths are in meters.
#[derive(Clone, Copy)]
struct ClusterParameters {
    /// Whether the shoot bends with two modes (a spray) or is rigid (a rosette).
    is_flexible: bool,
    shoot_length: f64,
    leaf_count: usize,
    leaf_length: f64,
}

const fn spray(shoot_length: f64, leaf_count: usize, leaf_length: f64) -> ClusterParameters {
    ClusterParameters { is_flexible: true, shoot_length, leaf_count, leaf_length }
}

const fn rosette(shoot_length: f64, leaf_count: usize, leaf_length: f64) -> ClusterParameters {
    ClusterParameters { is_flexible: false, shoot_length, leaf_count, leaf_length }
}

/// Parameters of all cluster templates.
const CLUSTERS: [ClusterParameters; 8] = [
    spray(0.50, 13, 0.235),
    spray(0.46, 12, 0.240),
    spray(0.42, 12, 0.225),
    spray(0.38, 11, 0.235),
    spray(0.34, 10, 0.225),
    rosette(0.28, 11, 0.230),
    rosette(0.24, 10, 0.220),
    rosette(0.26, 10, 0.225),
];

/// The templates of all clusters.
pub(super) fn leaf_clusters(random: &mut SplitMix64) -> Vec<PartTemplate> {
    CLUSTERS.iter().map(|parameters| grow_cluster(*parameters, &mut random.fork())).collect()
}

fn grow_cluster(parameters: ClusterParameters, random: &mut SplitMix64) -> PartTemplate {
    let ClusterParameters { is_flexible, shoot_length, leaf_count, leaf_length } = parameters;
    let growth = GrowthParameters {
        length: shoot_length,
        segments: 4,
        rings_per_segment: 1,
        grading: 1.0,
        start: Vector3::y(),
        up: Vector3::z(),
        sag: 0.30,
        rise: 0.10,
        wander: 0.12,
    };
    let centerline = Centerline::grow(&growth, random);
    // 3.6 mm at the base, 1.4 mm at the tip.
    let radii = (0..centerline.points.len()).map(|ring| 0.0036 - 0.0022 * centerline.fraction(ring)).collect();
    let mut template = PartTemplate {
        kind: PartKind::Leaf,
        level: None,
        centerline,
        radii,
        sides: 3,
        skin: SkinBuilder::default(),
        elastic: SHOOT,
        damping: 0.12,
        own_bodies: vec![],
        carried_bodies: vec![],
        up: growth.up,
        children: vec![],
        rank: if is_flexible { 2 } else { 0 },
        leaf_area: 0.0,
    };
    template.add_skin(UvMapping::Strip { u: STEM_U }, |_, _| 1.0);
    for leaf in 0..leaf_count {
        // The lowest leaf is at 16 % of the shoot or above, the last leaf at the tip.
        let fraction = if leaf + 1 == leaf_count {
            1.0
        } else {
            0.16 + 0.84 * (leaf as f64 + random.next_unit() * 0.6) / leaf_count as f64
        };
        // Azimuths: leaves of a spray alternate between two sides. Leaves of a rosette follow the golden angle of 2.4
        // radians.
        let azimuth = if is_flexible { std::f64::consts::PI * leaf as f64 } else { 2.4 * leaf as f64 };
        let azimuth = azimuth + random.uniform_symmetric(0.7);
        add_leaf(&mut template, fraction, azimuth, leaf_length * random.uniform(0.78, 1.12), random);
    }
    template
}

/// Adds a leaf at a fraction of the shoot. Azimuth 0 is to the right of the shoot. Light comes from +Z.
fn add_leaf(template: &mut PartTemplate, fraction: f64, azimuth: f64, length: f64, random: &mut SplitMix64) {
    let (station, base, tangent) = sample_at(&template.centerline, fraction);
    let right = tangent.cross(&Vector3::z()).normalize();
    let upward = right.cross(&tangent);
    // Leaves point sideways rather than up or down. The last leaf continues the shoot.
    let side = right * azimuth.cos() + upward * (0.60 * azimuth.sin() + 0.15);
    let angle = if fraction >= 1.0 { random.uniform(0.05, 0.25) } else { random.uniform(0.70, 1.20) };
    let droop = random.uniform(0.05, 0.50);
    let forward = (tangent * angle.cos() + side * angle.sin() - Vector3::z() * droop).normalize();
    // The blade turns its face towards the light, but not completely.
    let face = (upward + Vector3::z() + forward.cross(&Vector3::z()) * random.uniform_symmetric(0.55)).normalize();
    let normal = (face - forward * forward.dot(&face)).normalize();
    let twist = Rotation3::from_axis_angle(&Unit::new_unchecked(forward), random.uniform_symmetric(0.35));
    let blade = Blade {
        base,
        forward,
        normal: twist * normal,
        length,
        width: length * LEAF_ASPECT * random.uniform(0.92, 1.08),
        curl: random.uniform(0.25, 0.95),
        fold: random.uniform(0.12, 0.42),
        u_range: LEAF_SPAN,
    };
    let area = LEAF_COVERAGE * blade.length * blade.width;
    template.skin.add_blade(&blade, station);
    template.own_bodies.push((station, blade.inertia(LEAF_MASS_PER_AREA * area, &base)));
    template.leaf_area += area;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clusters_have_zero_or_two_modes() {
        let templates = leaf_clusters(&mut SplitMix64::new(2));
        let ranks: Vec<usize> =
            templates.iter().map(|template| template.build_shape().expect("a valid shape").0.modes.rank()).collect();
        assert!(ranks.contains(&2) && ranks.contains(&0), "{ranks:?}");
    }

    #[test]
    fn lowest_frequency_of_a_spray_is_a_few_hertz() {
        for template in leaf_clusters(&mut SplitMix64::new(2)).into_iter().filter(|template| template.rank > 0) {
            let (_, metadata) = template.build_shape().expect("a valid shape");
            let hertz = metadata.eigenvalues[0].sqrt() / std::f64::consts::TAU;
            let beam = template.beam().expect("a valid beam");
            let leaf_mass = beam.rigid_inertia().mass() - beam.element_mass();
            assert!((1.5..12.0).contains(&hertz), "{hertz} Hz");
            assert!(leaf_mass > beam.element_mass() * 0.2, "expected leaves over 20 % of the wood mass");
        }
    }

    #[test]
    fn mean_leaf_normal_points_to_the_light() {
        for template in leaf_clusters(&mut SplitMix64::new(9)) {
            let mesh = template.skin.build_mesh().expect("a valid mesh");
            // The shoot's corners come first: five rings of four (the seam repeats a corner), and three at the tip.
            let leaf_normals = &mesh.corners().normals[5 * 4 + 3..];
            let mean_z = leaf_normals.iter().map(|normal| normal[2]).sum::<f32>() / leaf_normals.len() as f32;
            assert!(mean_z > 0.5, "{mean_z}");
        }
    }
}
