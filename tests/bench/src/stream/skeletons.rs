//! Generated plants with the counts of table 4.5 of the thesis, whose modes follow from their shape: a structure file
//! of shoots that branch, and rigid leaves. The loader computes the modes, so that the physics process can simulate the
//! plants.
//!
//! Exact are the numbers of domains (d), of domains with modes (d') and of modes (r). The vertices of the domains with
//! modes are those of tubes whose rings are chosen for the number of rows of U (u), which differs by at most 7 %. The
//! thesis's other vertices and triangles follow from the leaves, so that they differ.

use std::f64::consts::{PI, TAU};
use std::fmt::Write as _;
use std::path::Path;

use fastrand::Rng;
use nalgebra::{Rotation3, Unit, Vector3};

use crate::thesis::{PLANTS, ThesisPlant};
use crate::workloads::Size;
use modalcast_model::error::{Result, fault_in};

/// The counts of a quick report are divided by this number.
const QUICK_DIVISOR: usize = 16;

/// Children of a shoot.
const CHILDREN: usize = 3;

/// Length and radius of the trunk in meters.
const TRUNK: (f64, f64) = (2.5, 0.04);

/// Length and radius of a child, as a fraction of those of its parent.
const CHILD_SCALE: (f64, f64) = (0.62, 0.55);

/// Smallest radius of a shoot in meters.
const MIN_RADIUS: f64 = 0.002;

/// Radius at the end of a shoot, as a fraction of that at its base.
const TAPER: f64 = 0.6;

/// Angle in radians from one child or leaf to the next one around a shoot.
const GOLDEN_ANGLE: f64 = 2.399_963;

/// Vertices of the rings that the loader makes of a shoot whose radius in meters is at least the second number.
const RING_VERTICES: [(usize, f64); 2] = [(12, 0.01), (8, MIN_RADIUS)];

/// Least number of points of a polyline.
const MIN_POINTS: usize = 4;

/// The counts of a generated plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Counts {
    domains: usize,
    deformable: usize,
    modes: usize,
    /// Rows of all U.
    rows: usize,
}

/// A shoot with its polyline.
struct Shoot {
    parent: Option<usize>,
    points: Vec<Vector3<f64>>,
    /// At the base.
    radius: f64,
}

/// The plant `index` of table 4.5, counted from 0, has this file in its folder.
pub(super) const FILES: [&str; PLANTS.len()] = [
    "plant-1.structure.json",
    "plant-2.structure.json",
    "plant-3.structure.json",
    "plant-4.structure.json",
    "plant-5.structure.json",
    "plant-6.structure.json",
    "plant-7.structure.json",
    "plant-8.structure.json",
    "plant-9.structure.json",
    "plant-10.structure.json",
    "plant-11.structure.json",
    "plant-12.structure.json",
];

/// Writes the structure of the plant `index` into a folder.
///
/// # Errors
/// `Fault` when the file cannot be written.
pub(super) fn write(folder: &Path, index: usize, size: Size) -> Result<()> {
    let text = structure(Counts::of(&PLANTS[index], size), index as u64);
    std::fs::write(folder.join(FILES[index]), text).map_err(fault_in("report"))
}

impl Counts {
    fn of(plant: &ThesisPlant, size: Size) -> Self {
        let divisor = if size == Size::Quick { QUICK_DIVISOR } else { 1 };
        let deformable = plant.deformable.div_ceil(divisor);
        Self {
            domains: plant.domains.div_ceil(divisor).max(deformable),
            deformable,
            modes: plant.modes.div_ceil(divisor),
            rows: plant.rows.div_ceil(divisor),
        }
    }
}

/// The text of a structure file with these counts.
fn structure(counts: Counts, seed: u64) -> String {
    let mut random = Rng::with_seed(seed);
    let vertices = counts.rows / 3 / counts.deformable;
    let mut shoots: Vec<Shoot> = Vec::with_capacity(counts.deformable);
    for index in 0..counts.deformable {
        let parent = index.checked_sub(1).map(|earlier| earlier / CHILDREN);
        shoots.push(grow(parent, index, &shoots, vertices, &mut random));
    }
    let mut text = String::from("{\"shoots\": [");
    for (index, shoot) in shoots.iter().enumerate() {
        let modes = share(counts.modes, counts.deformable, index);
        write_shoot(&mut text, index, shoot, modes);
    }
    text.push_str("\n], \"leaves\": [");
    // Leaves are on all shoots but the first ones, unless there are too few.
    let leafless = if counts.deformable > 2 * CHILDREN { CHILDREN } else { 0 };
    for leaf in 0..counts.domains - counts.deformable {
        let shoot = leafless + leaf % (counts.deformable - leafless);
        let number = leaf / (counts.deformable - leafless);
        let per_shoot = (counts.domains - counts.deformable).div_ceil(counts.deformable - leafless);
        let place = 0.2 + 0.8 * (number as f64 + 0.5) / per_shoot as f64;
        let base = point_at(&shoots[shoot].points, place);
        let separator = if leaf == 0 { "" } else { "," };
        // Writing into a string cannot fail.
        let _ = write!(
            text,
            "{separator}\n{{\"object_id\": {leaf}, \"shoot\": {shoot}, \"node\": {number}, \"petiole\": 0, \
             \"base\": {}, \"modes\": 0}}",
            point_text(&base)
        );
    }
    text.push_str("\n]}\n");
    text
}

/// The part of `total` that the entry `index` of `count` entries has.
const fn share(total: usize, count: usize, index: usize) -> usize {
    total / count + if index < total % count { 1 } else { 0 }
}

/// A shoot of about `vertices` vertices that bends slightly upwards. Children are on the upper part of their parent.
fn grow(parent: Option<usize>, index: usize, shoots: &[Shoot], vertices: usize, random: &mut Rng) -> Shoot {
    let (base, direction, length, radius) = match parent {
        None => (Vector3::zeros(), Vector3::z(), TRUNK.0, TRUNK.1),
        Some(parent) => {
            let number = (index - 1) % CHILDREN;
            let carrier = &shoots[parent];
            let place = 1.0 - 0.55 * number as f64 / CHILDREN as f64;
            let axis = (carrier.points[carrier.points.len() - 1] - carrier.points[0]).normalize();
            let across = axis.cross(&if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() }).normalize();
            let azimuth = index as f64 * GOLDEN_ANGLE + random.f64() * 0.4;
            let side = Rotation3::from_axis_angle(&Unit::new_unchecked(axis), azimuth) * across;
            let angle = PI * (0.2 + 0.1 * random.f64());
            let length: f64 = carrier.points.windows(2).map(|ends| (ends[1] - ends[0]).norm()).sum();
            let scale = CHILD_SCALE.0 * (0.9 + 0.2 * random.f64());
            let radius = (carrier.radius * CHILD_SCALE.1).max(MIN_RADIUS);
            (point_at(&carrier.points, place), axis * angle.cos() + side * angle.sin(), scale * length, radius)
        }
    };
    let ring_vertices = RING_VERTICES.iter().find(|(_, least)| radius >= *least).map_or(8, |(count, _)| *count);
    let points = (vertices / ring_vertices).max(MIN_POINTS);
    let step = length / (points - 1) as f64;
    let phase = TAU * random.f64();
    let mut polyline = vec![base];
    for point in 1..points {
        let fraction = point as f64 / points as f64;
        let wander = Vector3::new((phase + 7.0 * fraction).sin(), (phase + 5.0 * fraction).cos(), 0.0) * 0.12;
        let upward = Vector3::z() * (0.3 * fraction);
        polyline.push(polyline[point - 1] + (direction + wander + upward).normalize() * step);
    }
    Shoot { parent, points: polyline, radius }
}

/// The point at a fraction of the points of a polyline.
fn point_at(points: &[Vector3<f64>], fraction: f64) -> Vector3<f64> {
    let place = fraction.clamp(0.0, 1.0) * (points.len() - 1) as f64;
    let first = (place as usize).min(points.len() - 2);
    points[first].lerp(&points[first + 1], place - first as f64)
}

fn write_shoot(text: &mut String, index: usize, shoot: &Shoot, modes: usize) {
    let last = (shoot.points.len() - 1) as f64;
    let radius = |point: usize| shoot.radius * (1.0 - (1.0 - TAPER) * point as f64 / last);
    let vertices: Vec<String> = shoot.points.iter().map(point_text).collect();
    let radii: Vec<String> = (0..shoot.points.len()).map(|point| format!("{:.6}", radius(point))).collect();
    let parent = shoot.parent.map_or_else(|| "-1".to_owned(), |parent| parent.to_string());
    let separator = if index == 0 { "" } else { "," };
    // Writing into a string cannot fail.
    let _ = write!(
        text,
        "{separator}\n{{\"id\": {index}, \"parent\": {parent}, \"modes\": {modes}, \"vertices\": [{}], \"radii\": [{}]}}",
        vertices.join(","),
        radii.join(",")
    );
}

fn point_text(point: &Vector3<f64>) -> String {
    format!("[{:.6},{:.6},{:.6}]", point.x, point.y, point.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plants_have_the_counts_of_table_4_5() {
        let folder = tempfile::tempdir().expect("expected a folder");
        // The pansy has no leaves, and the conifer has 601.
        for index in [0, 1] {
            write(folder.path(), index, Size::Full).expect("expected a file");
            let path = folder.path().join(FILES[index]);
            let scene = modalcast_model::load::open(&path.to_string_lossy()).expect("expected a scene").scene;
            let ranks: Vec<usize> = (0..scene.domains.len()).map(|domain| scene.rank_of(domain)).collect();
            let plant = &PLANTS[index];
            assert_eq!(
                (ranks.len(), ranks.iter().filter(|rank| **rank > 0).count(), ranks.iter().sum::<usize>()),
                (plant.domains, plant.deformable, plant.modes)
            );
            let flexible = scene.layout.domains.iter().filter(|domain| domain.rank > 0);
            let rows: usize = flexible.map(|domain| 3 * domain.vertices).sum();
            assert!((rows as f64 / plant.rows as f64 - 1.0).abs() < 0.1, "{}: {rows} rows", plant.name);
            // All domains are joined, and all eigenvalues are positive.
            assert_eq!(scene.domains.iter().filter(|domain| domain.attachment.is_none()).count(), 1);
            let eigenvalues = || scene.domains.iter().flat_map(|domain| &domain.metadata.eigenvalues);
            assert_eq!(eigenvalues().filter(|eigenvalue| **eigenvalue > 0.0).count(), plant.modes);
        }
    }

    #[test]
    fn quick_plants_have_a_sixteenth_of_the_counts() {
        for plant in &PLANTS {
            let Counts { domains, deformable, modes, rows } = Counts::of(plant, Size::Quick);
            for (quick, full) in [(domains, plant.domains), (modes, plant.modes), (rows, plant.rows)] {
                assert!(quick >= full / 16 && quick <= full / 16 + 1, "{}: {quick} of {full}", plant.name);
            }
            assert!(deformable >= 1 && modes >= deformable && domains >= deformable);
        }
    }

    #[test]
    fn shares_add_up() {
        assert_eq!((0..5).map(|index| share(17, 5, index)).collect::<Vec<_>>(), [4, 4, 3, 3, 3]);
    }
}
