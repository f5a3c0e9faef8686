//! The species of the tree: parameters and growth of the templates of all parts. Lengths are in meters, angles in
//! radians. Numbers without a comment are free choices of the tree's shape.

use std::f64::consts::TAU;

use modalcast_beam::ElasticConstants;
use nalgebra::{Rotation3, Unit, Vector3};

use super::centerline::{Centerline, GrowthParameters, part_orientation};
use super::cluster::leaf_clusters;
use super::random::SplitMix64;
use super::skin::{SkinBuilder, UvMapping};
use super::template::{ChildJoint, PartKind, PartTemplate};
use crate::error::Result;

/// Green wood.
const WOOD: ElasticConstants = ElasticConstants { youngs_modulus: 4.5e9, shear_modulus: 3.5e8, density: 900.0 };

/// Angle in radians between successive boughs around the trunk.
const GOLDEN_ANGLE: f64 = 2.399_963;

/// Number of boughs on the trunk.
const BOUGH_COUNT: usize = 24;

/// The fractions of the trunk's length where the crown begins and ends.
const CROWN_RANGE: [f64; 2] = [0.24, 0.96];

/// Lengths of the twigs, one template each.
const TWIG_LENGTHS: [f64; 12] = [0.45, 0.50, 0.56, 0.66, 0.72, 0.78, 0.90, 0.97, 1.04, 1.18, 1.26, 1.34];

/// Generates the templates of a tree: children before parents, the trunk last.
///
/// # Errors
/// `Fault` if a part has no valid beam.
pub(super) fn grow_templates(random: &mut SplitMix64) -> Result<Vec<PartTemplate>> {
    let mut templates = leaf_clusters(&mut random.fork());
    let leaf_range = 0..templates.len();
    for length in TWIG_LENGTHS {
        let twig = grow_twig(length, &templates[leaf_range.clone()], &mut random.fork())?;
        templates.push(twig);
    }
    let twig_range = leaf_range.end..templates.len();
    let mut trunk = grow_trunk(&mut random.fork());
    for index in 0..BOUGH_COUNT {
        let mut random = random.fork();
        let (ring, direction, length) = choose_bough_joint(&trunk, index, &mut random);
        let max_radius = 0.60 * trunk.radii[ring];
        let bough = grow_bough(
            &direction,
            [length, max_radius],
            &templates,
            &[leaf_range.clone(), twig_range.clone()],
            &mut random,
        )?;
        trunk.attach_child(ChildJoint { ring, direction, template_index: templates.len() }, &bough)?;
        templates.push(bough);
    }
    // Twigs of medium length (twig templates 4 to 8) form the top of the crown. Each pair is a ring and the angle
    // between trunk and twig.
    let last_ring = trunk.centerline.points.len() - 1;
    for (ring, angle) in [(last_ring, 0.10), (last_ring - 2, 0.55), (last_ring - 4, 0.65), (last_ring - 6, 0.7)] {
        let side = perpendicular_at(&trunk.centerline, ring, GOLDEN_ANGLE * (ring + BOUGH_COUNT) as f64);
        let direction = trunk.centerline.branch_direction(ring, angle, &side);
        let template_index = twig_range.start + 4 + ring % 5;
        trunk.attach_child(ChildJoint { ring, direction, template_index }, &templates[template_index])?;
    }
    templates.push(trunk);
    Ok(templates)
}

fn grow_trunk(random: &mut SplitMix64) -> PartTemplate {
    let growth = GrowthParameters {
        length: 6.8,
        segments: 16,
        rings_per_segment: 3,
        grading: 1.25,
        start: Vector3::y(),
        up: Vector3::y(),
        sag: 0.0,
        rise: 0.5,
        wander: 0.11,
    };
    let centerline = Centerline::grow(&growth, random);
    let radius = |ring: usize| {
        let fraction = centerline.fraction(ring);
        0.010 + 0.086 * (1.0 - fraction).powf(0.92) + 0.075 * (-centerline.arc_lengths[ring] / 0.22).exp()
    };
    let radii = (0..centerline.points.len()).map(radius).collect();
    let (sides, rank) = (24, 10);
    let mut template = wooden_part(PartKind::Trunk, centerline, radii, [sides, rank]);
    template.damping = 0.05;
    let phases = [random.uniform(0.0, TAU), random.uniform(0.0, TAU), random.uniform(0.0, TAU)];
    template.add_skin(UvMapping::Bark { repeats: 2 }, |arc_length, angle| {
        // Roots extend outwards at the ground. Above them, the trunk is slightly uneven.
        let root_swelling = 0.20 * (5.0 * angle + phases[0]).cos() + 0.10 * (3.0 * angle + phases[1]).cos();
        let unevenness =
            0.025 * (2.0 * angle + phases[2] + 1.7 * arc_length).cos() + 0.018 * (4.0 * angle - 2.3 * arc_length).cos();
        1.0 + root_swelling * (-arc_length / 0.30).exp() + unevenness
    });
    template
}

/// Ring, direction and length of a bough. Boughs are long and level at the bottom, short and steep at the top.
fn choose_bough_joint(trunk: &PartTemplate, index: usize, random: &mut SplitMix64) -> (usize, Vector3<f64>, f64) {
    let crown_fraction = (index as f64 + random.uniform_symmetric(0.25)) / (BOUGH_COUNT - 1) as f64;
    let ring = trunk
        .centerline
        .ring_at(CROWN_RANGE[0] + (CROWN_RANGE[1] - CROWN_RANGE[0]) * crown_fraction.clamp(0.0, 1.0).powf(1.06));
    let side =
        perpendicular_at(&trunk.centerline, ring, GOLDEN_ANGLE * (index as f64 + 0.8) + random.uniform_symmetric(0.3));
    let angle = 1.22 - 0.74 * crown_fraction + random.uniform_symmetric(0.12);
    let crown_profile = (1.0 - ((crown_fraction - 0.28) / 0.75).powi(2)).max(0.0).sqrt();
    (
        ring,
        trunk.centerline.branch_direction(ring, angle, &side),
        (0.40 + 2.32 * crown_profile) * random.uniform(0.92, 1.08),
    )
}

/// Grows a bough that starts along `direction` (in the world), with its twigs and leaves.
fn grow_bough(
    direction: &Vector3<f64>,
    [length, max_radius]: [f64; 2],
    templates: &[PartTemplate],
    [leaf_range, twig_range]: &[std::ops::Range<usize>; 2],
    random: &mut SplitMix64,
) -> Result<PartTemplate> {
    let growth = GrowthParameters {
        length,
        segments: 12,
        rings_per_segment: 2,
        grading: 1.1,
        start: Vector3::y(),
        up: part_orientation(direction, &Vector3::y()).inverse() * Vector3::y(),
        sag: 0.10 + 0.06 * length,
        rise: 0.55,
        wander: 0.20,
    };
    let centerline = Centerline::grow(&growth, random);
    let base_radius = (0.008 + 0.0105 * length).min(max_radius);
    let radii = tapered_radii(&centerline, base_radius, 0.0045);
    let (sides, rank) = (10, 6);
    let mut template = wooden_part(PartKind::Branch, centerline, radii, [sides, rank]);
    template.level = Some(1);
    template.damping = 0.07;
    template.up = growth.up;
    template.add_skin(UvMapping::Bark { repeats: 1 }, |_, _| 1.0);
    let twig_count = (length / 0.42).round().max(3.0) as usize;
    for index in 0..twig_count {
        let fraction = 0.26 + 0.68 * (index as f64 + random.uniform_symmetric(0.25)) / (twig_count as f64 - 1.0);
        let ring = template.centerline.ring_at(fraction.min(0.95));
        let twig_length = (0.38 + 0.34 * length) * (1.12 - 0.62 * fraction) * random.uniform(0.85, 1.15);
        let side = side_direction(&template.centerline, ring, &growth.up, index, random);
        let direction = template.centerline.branch_direction(ring, random.uniform(0.70, 1.0) - 0.2 * fraction, &side);
        let template_index = choose_twig(twig_length, twig_range, random);
        template.attach_child(ChildJoint { ring, direction, template_index }, &templates[template_index])?;
    }
    attach_leaf_clusters(&mut template, &[0.50, 0.66, 0.82, 1.0], &templates[leaf_range.clone()], &growth.up, random)?;
    Ok(template)
}

/// Grows a twig with its leaf clusters.
fn grow_twig(length: f64, leaves: &[PartTemplate], random: &mut SplitMix64) -> Result<PartTemplate> {
    let growth = GrowthParameters {
        length,
        segments: 10,
        rings_per_segment: 1,
        grading: 1.0,
        start: Vector3::y(),
        up: Vector3::new(0.0, 0.35, 0.94).normalize(),
        sag: 0.16,
        rise: 0.30,
        wander: 0.24,
    };
    let centerline = Centerline::grow(&growth, random);
    let radii = tapered_radii(&centerline, 0.0040 + 0.0055 * length, 0.0028);
    let (sides, rank) = (5, 4);
    let mut template = wooden_part(PartKind::Branch, centerline, radii, [sides, rank]);
    template.level = Some(2);
    template.damping = 0.09;
    template.up = growth.up;
    template.add_skin(UvMapping::Bark { repeats: 1 }, |_, _| 1.0);
    let interval_count = (0.6 + length / 0.33).round() as usize;
    let fractions: Vec<f64> =
        (0..=interval_count).map(|index| 0.24 + 0.76 * index as f64 / interval_count as f64).collect();
    attach_leaf_clusters(&mut template, &fractions, leaves, &growth.up, random)?;
    Ok(template)
}

/// Attaches leaf clusters at fractions of the length. A cluster at the tip continues the branch. `leaves` is the start
/// of the list of templates, so that its indices are template indices.
fn attach_leaf_clusters(
    template: &mut PartTemplate,
    fractions: &[f64],
    leaves: &[PartTemplate],
    up: &Vector3<f64>,
    random: &mut SplitMix64,
) -> Result<()> {
    for (index, fraction) in fractions.iter().enumerate() {
        let ring = template.centerline.ring_at(*fraction);
        let is_tip = ring + 1 == template.centerline.points.len();
        let side = side_direction(&template.centerline, ring, up, index, random);
        let angle = if is_tip { random.uniform(0.0, 0.2) } else { random.uniform(0.65, 1.05) };
        let direction = template.centerline.branch_direction(ring, angle, &side);
        let template_index = (random.next_unit() * leaves.len() as f64) as usize;
        template.attach_child(ChildJoint { ring, direction, template_index }, &leaves[template_index])?;
    }
    Ok(())
}

/// A part of wood with `sides` vertices per ring and `rank` modes. It has level 0, and no skin, children or damping
/// yet.
fn wooden_part(kind: PartKind, centerline: Centerline, radii: Vec<f64>, [sides, rank]: [usize; 2]) -> PartTemplate {
    PartTemplate {
        kind,
        level: Some(0),
        centerline,
        radii,
        sides,
        skin: SkinBuilder::default(),
        elastic: WOOD,
        damping: 0.0,
        own_bodies: vec![],
        carried_bodies: vec![],
        up: Vector3::y(),
        children: vec![],
        rank,
        leaf_area: 0.0,
    }
}

/// Radii from the base to the tip, with a branch collar at the base.
fn tapered_radii(centerline: &Centerline, base_radius: f64, tip_radius: f64) -> Vec<f64> {
    let radius = |ring: usize| {
        let fraction = centerline.fraction(ring);
        (tip_radius + (base_radius - tip_radius) * (1.0 - fraction).powf(0.9))
            * (1.0 + 0.45 * (-centerline.arc_lengths[ring] / (2.6 * base_radius)).exp())
    };
    (0..centerline.points.len()).map(radius).collect()
}

/// A unit vector perpendicular to the centerline, at the angle `azimuth`.
fn perpendicular_at(centerline: &Centerline, ring: usize, azimuth: f64) -> Vector3<f64> {
    Rotation3::from_axis_angle(&Unit::new_unchecked(centerline.tangents[ring]), azimuth) * centerline.side_vectors[ring]
}

/// A unit vector perpendicular to the centerline: left or right depending on the parity of `index`, and more often
/// tilted up than down.
fn side_direction(
    centerline: &Centerline,
    ring: usize,
    up: &Vector3<f64>,
    index: usize,
    random: &mut SplitMix64,
) -> Vector3<f64> {
    let basis = part_orientation(&centerline.tangents[ring], up);
    let tilt = random.uniform(-0.6, 0.8);
    let side = if index.is_multiple_of(2) { 1.0 } else { -1.0 };
    basis * Vector3::new(side * tilt.cos(), 0.0, tilt.sin())
}

/// The index of the twig template with the nearest length. `length` is varied randomly by up to 7 %.
fn choose_twig(length: f64, twig_range: &std::ops::Range<usize>, random: &mut SplitMix64) -> usize {
    let length = length * random.uniform(0.93, 1.07);
    let difference = |twig: &usize| (TWIG_LENGTHS[twig - twig_range.start] - length).abs();
    twig_range.clone().min_by(|a, b| difference(a).total_cmp(&difference(b))).unwrap_or(twig_range.start)
}
