//! The species: the templates of all parts, generated from a seed; children before parents, the trunk last. Lengths are
//! in meters.

use std::f64::consts::TAU;

use nalgebra::{Rotation3, Unit, Vector3};

use super::centerline::{Centerline, GrowthParameters, frame};
use super::cluster::leaf_clusters;
use super::element::ElasticConstants;
use super::random::SplitMix64;
use super::skin::{SkinBuilder, UvMapping};
use super::template::{ChildJoint, PartKind, PartTemplate};

/// Green wood.
const WOOD: ElasticConstants = ElasticConstants { youngs_modulus: 4.5e9, shear_modulus: 3.5e8, density: 900.0 };

/// Angle in radians between successive boughs around the trunk.
const GOLDEN_ANGLE: f64 = 2.399_963;

/// Number of boughs on the trunk, and the fractions of the trunk where the crown begins and ends.
const BOUGHS: usize = 24;
const CROWN: [f64; 2] = [0.24, 0.96];

/// Lengths of the twigs, one template each.
const TWIGS: [f64; 12] = [0.45, 0.50, 0.56, 0.66, 0.72, 0.78, 0.90, 0.97, 1.04, 1.18, 1.26, 1.34];

/// The templates of a tree.
pub(super) fn plan(random: &mut SplitMix64) -> Vec<PartTemplate> {
    let mut molds = leaf_clusters(&mut random.fork());
    let leaves = 0..molds.len();
    for length in TWIGS {
        let twig = twig(length, &molds[leaves.clone()], &mut random.fork());
        molds.push(twig);
    }
    let twigs = leaves.end..molds.len();
    let mut trunk = trunk(&mut random.fork());
    for number in 0..BOUGHS {
        let mut random = random.fork();
        let (ring, direction, length) = place_bough(&trunk, number, &mut random);
        let thickest = 0.60 * trunk.radii[ring];
        let bough = bough(&direction, [length, thickest], &molds, &[leaves.clone(), twigs.clone()], &mut random);
        trunk.attach_child(ChildJoint { ring, direction, mold: molds.len() }, bough.mass());
        molds.push(bough);
    }
    let last = trunk.centerline.points.len() - 1;
    for (ring, lean) in [(last, 0.10), (last - 2, 0.55), (last - 4, 0.65), (last - 6, 0.7)] {
        let across = around(&trunk.centerline, ring, GOLDEN_ANGLE * (ring + BOUGHS) as f64);
        let direction = trunk.centerline.branch_direction(ring, lean, &across);
        let mold = twigs.start + 4 + ring % 5;
        trunk.attach_child(ChildJoint { ring, direction, mold }, molds[mold].mass());
    }
    molds.push(trunk);
    molds
}

fn trunk(random: &mut SplitMix64) -> PartTemplate {
    let growth = GrowthParameters {
        length: 6.8,
        elements: 16,
        rings: 3,
        grading: 1.25,
        start: Vector3::y(),
        up: Vector3::y(),
        sag: 0.0,
        rise: 0.5,
        wander: 0.11,
    };
    let centerline = Centerline::grow(&growth, random);
    let radius = |ring: usize| {
        let along = centerline.fraction(ring);
        0.010 + 0.086 * (1.0 - along).powf(0.92) + 0.075 * (-centerline.arc_lengths[ring] / 0.22).exp()
    };
    let radii = (0..centerline.points.len()).map(radius).collect();
    let mut mold = wooden(PartKind::Trunk, centerline, radii, [24, 10]);
    mold.damping = 0.05;
    let phases = [random.between(0.0, TAU), random.between(0.0, TAU), random.between(0.0, TAU)];
    mold.add_skin(UvMapping::Bark { repeats: 2 }, |arc, angle| {
        // Roots extend outwards at the ground; further up, the trunk is slightly uneven.
        let root = 0.20 * (5.0 * angle + phases[0]).cos() + 0.10 * (3.0 * angle + phases[1]).cos();
        let uneven = 0.025 * (2.0 * angle + phases[2] + 1.7 * arc).cos() + 0.018 * (4.0 * angle - 2.3 * arc).cos();
        1.0 + root * (-arc / 0.30).exp() + uneven
    });
    mold
}

/// Ring, direction and length of a bough: long and level at the bottom, short and steep at the top.
fn place_bough(trunk: &PartTemplate, number: usize, random: &mut SplitMix64) -> (usize, Vector3<f64>, f64) {
    let height = (number as f64 + random.spread(0.25)) / (BOUGHS - 1) as f64;
    let ring = trunk.centerline.ring_at(CROWN[0] + (CROWN[1] - CROWN[0]) * height.clamp(0.0, 1.0).powf(1.06));
    let across = around(&trunk.centerline, ring, GOLDEN_ANGLE * (number as f64 + 0.8) + random.spread(0.3));
    let angle = 1.22 - 0.74 * height + random.spread(0.12);
    let crown = (1.0 - ((height - 0.28) / 0.75).powi(2)).max(0.0).sqrt();
    (ring, trunk.centerline.branch_direction(ring, angle, &across), (0.40 + 2.32 * crown) * random.between(0.92, 1.08))
}

/// A bough that starts along `direction` (in the world), with its twigs and leaves. `size` is length and largest
/// radius.
fn bough(
    direction: &Vector3<f64>,
    size: [f64; 2],
    molds: &[PartTemplate],
    [leaves, twigs]: &[std::ops::Range<usize>; 2],
    random: &mut SplitMix64,
) -> PartTemplate {
    let [length, thickest] = size;
    let growth = GrowthParameters {
        length,
        elements: 12,
        rings: 2,
        grading: 1.1,
        start: Vector3::y(),
        up: frame(direction, &Vector3::y()).inverse() * Vector3::y(),
        sag: 0.10 + 0.06 * length,
        rise: 0.55,
        wander: 0.20,
    };
    let centerline = Centerline::grow(&growth, random);
    let base = (0.008 + 0.0105 * length).min(thickest);
    let radii = tapering(&centerline, base, 0.0045);
    let mut mold = wooden(PartKind::Branch, centerline, radii, [10, 6]);
    mold.level = Some(1);
    mold.damping = 0.07;
    mold.add_skin(UvMapping::Bark { repeats: 1 }, |_, _| 1.0);
    let count = (length / 0.42).round().max(3.0) as usize;
    for number in 0..count {
        let along = 0.26 + 0.68 * (number as f64 + random.spread(0.25)) / (count as f64 - 1.0);
        let ring = mold.centerline.ring_at(along.min(0.95));
        let wanted = (0.38 + 0.34 * length) * (1.12 - 0.62 * along) * random.between(0.85, 1.15);
        let across = beside(&mold.centerline, ring, &growth.up, number, random);
        let direction = mold.centerline.branch_direction(ring, random.between(0.70, 1.0) - 0.2 * along, &across);
        let child = nearest(wanted, twigs, random);
        mold.attach_child(ChildJoint { ring, direction, mold: child }, molds[child].mass());
    }
    hang_leaves(&mut mold, &[0.50, 0.66, 0.82, 1.0], &molds[leaves.clone()], &growth.up, random);
    mold
}

/// A twig with its leaf clusters.
fn twig(length: f64, leaves: &[PartTemplate], random: &mut SplitMix64) -> PartTemplate {
    let growth = GrowthParameters {
        length,
        elements: 10,
        rings: 1,
        grading: 1.0,
        start: Vector3::y(),
        up: Vector3::new(0.0, 0.35, 0.94).normalize(),
        sag: 0.16,
        rise: 0.30,
        wander: 0.24,
    };
    let centerline = Centerline::grow(&growth, random);
    let radii = tapering(&centerline, 0.0040 + 0.0055 * length, 0.0028);
    let mut mold = wooden(PartKind::Branch, centerline, radii, [5, 4]);
    mold.level = Some(2);
    mold.damping = 0.09;
    mold.add_skin(UvMapping::Bark { repeats: 1 }, |_, _| 1.0);
    let count = (0.6 + length / 0.33).round() as usize;
    let along: Vec<f64> = (0..=count).map(|number| 0.24 + 0.76 * number as f64 / count as f64).collect();
    hang_leaves(&mut mold, &along, leaves, &growth.up, random);
    mold
}

/// Attaches leaf clusters at fractions of the length. A cluster at the very end continues the branch.
fn hang_leaves(
    mold: &mut PartTemplate,
    along: &[f64],
    leaves: &[PartTemplate],
    up: &Vector3<f64>,
    random: &mut SplitMix64,
) {
    for (number, along) in along.iter().enumerate() {
        let ring = mold.centerline.ring_at(*along);
        let end = ring + 1 == mold.centerline.points.len();
        let across = beside(&mold.centerline, ring, up, number, random);
        let angle = if end { random.between(0.0, 0.2) } else { random.between(0.65, 1.05) };
        let direction = mold.centerline.branch_direction(ring, angle, &across);
        let child = (random.next_unit() * leaves.len() as f64) as usize;
        mold.attach_child(ChildJoint { ring, direction, mold: child }, leaves[child].mass());
    }
}

fn wooden(kind: PartKind, centerline: Centerline, radii: Vec<f64>, [sides, rank]: [usize; 2]) -> PartTemplate {
    PartTemplate {
        kind,
        level: Some(0),
        centerline,
        radii,
        sides,
        sheet: SkinBuilder::default(),
        elastic: WOOD,
        damping: 0.0,
        point_masses: vec![],
        children: vec![],
        rank,
        leaf_area: 0.0,
    }
}

/// Radii from the base to the tip, with a branch collar at the base.
fn tapering(centerline: &Centerline, base: f64, tip: f64) -> Vec<f64> {
    let radius = |ring: usize| {
        let along = centerline.fraction(ring);
        (tip + (base - tip) * (1.0 - along).powf(0.9))
            * (1.0 + 0.45 * (-centerline.arc_lengths[ring] / (2.6 * base)).exp())
    };
    (0..centerline.points.len()).map(radius).collect()
}

/// A unit vector perpendicular to the line, at `azimuth` around it.
fn around(centerline: &Centerline, ring: usize, azimuth: f64) -> Vector3<f64> {
    Rotation3::from_axis_angle(&Unit::new_unchecked(centerline.tangents[ring]), azimuth) * centerline.sides[ring]
}

/// A unit vector perpendicular to the line, alternately left and right, more often tilted up than down.
fn beside(
    centerline: &Centerline,
    ring: usize,
    up: &Vector3<f64>,
    number: usize,
    random: &mut SplitMix64,
) -> Vector3<f64> {
    let basis = frame(&centerline.tangents[ring], up);
    let tilt = random.between(-0.6, 0.8);
    let side = if number.is_multiple_of(2) { 1.0 } else { -1.0 };
    basis * Vector3::new(side * tilt.cos(), 0.0, tilt.sin())
}

/// The twig template nearest to the wanted length, which is varied randomly by up to 7 %.
fn nearest(wanted: f64, twigs: &std::ops::Range<usize>, random: &mut SplitMix64) -> usize {
    let wanted = wanted * random.between(0.93, 1.07);
    let gap = |twig: &usize| (TWIGS[twig - twigs.start] - wanted).abs();
    twigs.clone().min_by(|a, b| gap(a).total_cmp(&gap(b))).unwrap_or(twigs.start)
}
