//! Templates of leaf clusters: a green shoot with leaf blades. Sprays bend with two modes, rosettes are rigid.

use nalgebra::{Rotation3, Unit, Vector3};

use super::centerline::{Centerline, GrowthParameters};
use super::element::ElasticConstants;
use super::leaf_image::{LEAF_SPAN, STEM_U};
use super::random::SplitMix64;
use super::skin::{Blade, SkinBuilder, UvMapping, between};
use super::template::{PartKind, PartTemplate};

/// Green shoots are softer than wood.
const SHOOT: ElasticConstants = ElasticConstants { youngs_modulus: 3.0e9, shear_modulus: 2.0e8, density: 850.0 };

/// Fresh mass of a leaf in kg per m^2 of one side.
const LEAF_MASS: f64 = 0.17;

/// The fraction of a card's area that the leaf outline covers.
const LEAF_COVERAGE: f64 = 0.55;

/// Ratio of width to length of a leaf's card.
const LEAF_ASPECT: f64 = 0.62;

/// The clusters: whether it bends, length of the shoot (m), number of leaves, length of a leaf (m).
const CLUSTERS: [(bool, f64, usize, f64); 8] = [
    (true, 0.50, 13, 0.235),
    (true, 0.46, 12, 0.240),
    (true, 0.42, 12, 0.225),
    (true, 0.38, 11, 0.235),
    (true, 0.34, 10, 0.225),
    (false, 0.28, 11, 0.230),
    (false, 0.24, 10, 0.220),
    (false, 0.26, 10, 0.225),
];

/// The templates of all clusters.
pub(super) fn leaf_clusters(random: &mut SplitMix64) -> Vec<PartTemplate> {
    CLUSTERS.iter().map(|cluster| grow(*cluster, &mut random.fork())).collect()
}

fn grow((bends, length, leaves, size): (bool, f64, usize, f64), random: &mut SplitMix64) -> PartTemplate {
    let growth = GrowthParameters {
        length,
        elements: 4,
        rings: 1,
        grading: 1.0,
        start: Vector3::y(),
        up: Vector3::z(),
        sag: 0.30,
        rise: 0.10,
        wander: 0.12,
    };
    let centerline = Centerline::grow(&growth, random);
    let count = centerline.points.len();
    let radii = (0..count).map(|ring| 0.0036 - 0.0022 * centerline.fraction(ring)).collect();
    let mut mold = PartTemplate {
        kind: PartKind::Leaf,
        level: None,
        centerline,
        radii,
        sides: 3,
        sheet: SkinBuilder::default(),
        elastic: SHOOT,
        damping: 0.12,
        point_masses: vec![],
        children: vec![],
        rank: if bends { 2 } else { 0 },
        leaf_area: 0.0,
    };
    mold.add_skin(UvMapping::Strip { u: STEM_U }, |_, _| 1.0);
    for leaf in 0..leaves {
        let along = if leaf + 1 == leaves {
            1.0
        } else {
            0.16 + 0.84 * (leaf as f64 + random.next_unit() * 0.6) / leaves as f64
        };
        let azimuth = if bends { std::f64::consts::PI * leaf as f64 } else { 2.4 * leaf as f64 };
        add_leaf(&mut mold, along, azimuth + random.spread(0.7), size * random.between(0.78, 1.12), random);
    }
    mold
}

/// Adds a leaf at a fraction of the shoot. Azimuth 0 is to the right of the shoot; light comes from +Z.
fn add_leaf(mold: &mut PartTemplate, along: f64, azimuth: f64, length: f64, random: &mut SplitMix64) {
    let (station, base, tangent) = between(&mold.centerline, along);
    let right = tangent.cross(&Vector3::z()).normalize();
    let over = right.cross(&tangent);
    // Leaves point sideways rather than up or down; the last leaf continues the shoot.
    let across = right * azimuth.cos() + over * (0.60 * azimuth.sin() + 0.15);
    let angle = if along >= 1.0 { random.between(0.05, 0.25) } else { random.between(0.70, 1.20) };
    let droop = random.between(0.05, 0.50);
    let forward = (tangent * angle.cos() + across * angle.sin() - Vector3::z() * droop).normalize();
    // The blade turns its face towards the light, but not completely.
    let face = (over + Vector3::z() + forward.cross(&Vector3::z()) * random.spread(0.55)).normalize();
    let normal = (face - forward * forward.dot(&face)).normalize();
    let twist = Rotation3::from_axis_angle(&Unit::new_unchecked(forward), random.spread(0.35));
    let blade = Blade {
        base,
        forward,
        normal: twist * normal,
        length,
        width: length * LEAF_ASPECT * random.between(0.92, 1.08),
        curl: random.between(0.25, 0.95),
        fold: random.between(0.12, 0.42),
        span: LEAF_SPAN,
    };
    let area = LEAF_COVERAGE * blade.length * blade.width;
    mold.sheet.add_blade(&blade, station);
    mold.point_masses.push((station, LEAF_MASS * area));
    mold.leaf_area += area;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn some_clusters_bend_with_two_modes_and_some_are_rigid() {
        let molds = leaf_clusters(&mut SplitMix64::new(2));
        let ranks: Vec<usize> = molds.iter().map(|mold| mold.cast().expect("solved").0.modes.rank()).collect();
        assert!(ranks.contains(&2) && ranks.contains(&0), "{ranks:?}");
    }

    #[test]
    fn shoots_flutter_at_a_few_hertz_and_carry_their_leaves() {
        for mold in leaf_clusters(&mut SplitMix64::new(2)).into_iter().filter(|mold| mold.rank > 0) {
            let (_, metadata) = mold.cast().expect("solved");
            let hertz = metadata.eigenvalues[0].sqrt() / std::f64::consts::TAU;
            assert!((1.5..12.0).contains(&hertz), "{hertz} Hz");
            assert!(mold.mass() > mold.beam().own_mass() * 1.2);
        }
    }

    #[test]
    fn upper_faces_look_to_the_light_on_the_whole() {
        for mold in leaf_clusters(&mut SplitMix64::new(9)) {
            let mesh = mold.sheet.mesh().expect("finite");
            let blades = &mesh.corners().normals[5 * 4 + 3..];
            let mean = blades.iter().map(|normal| normal[2]).sum::<f32>() / blades.len() as f32;
            assert!(mean > 0.5, "{mean}");
        }
    }
}
