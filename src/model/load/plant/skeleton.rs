//! Meshes of a plant whose structure has no OBJ file: tubes along the polylines of shoots and petioles, and a blade per
//! leaf, with the bark and the leaves of the built-in tree.
//!
//! A blade without `tip` continues its petiole. Leaflets with a common base spread to both sides. A leaf without a
//! petiole points away from its shoot, and successive nodes turn by the golden angle.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::f64::consts::TAU;

use nalgebra::{Rotation3, Unit, Vector3};

use super::PlantMeshes;
use super::organs::{Organ, nearest_point_on_polyline};
use super::structure::{Leaf, PlantStructure};
use crate::error::Result;
use crate::load::polygons::{Corner, NO_INDEX, PolygonMesh};
use crate::memory::TemporaryReservation;
use crate::tree::{LEAF_BLADE_START, LEAF_SPAN, STEM_U, TREE_MATERIALS};

/// Sides of the tubes of shoots whose largest radius in meters is at least the second number.
const SHOOT_SIDES: [(usize, f64); 3] = [(12, 0.01), (8, 0.002), (6, 0.0)];

/// Sides of the tube of a petiole.
const PETIOLE_SIDES: usize = 5;

/// Radius of a petiole as a fraction of the length of petiole and blade together, at its base and at its end.
const PETIOLE_RADII: [f64; 2] = [1.0 / 140.0, 1.0 / 220.0];

/// The bark image scales with the radius of a shoot, but not below this radius in meters.
const MIN_BARK_RADIUS: f64 = 0.012;

/// Length of a blade without `tip`, in median lengths of the petioles.
const BLADE_IN_PETIOLES: f64 = 1.5;

/// Length of a blade in a plant without petioles, as a fraction of the plant's diagonal.
const BLADE_IN_DIAGONALS: f64 = 0.04;

/// Width of a blade without `width`, as a fraction of its length.
const BLADE_ASPECT: f64 = 0.45;

/// Angle in radians between the first and the last of several leaflets at a common base.
const LEAFLET_SPREAD: f64 = 2.4;

/// Angle in radians from one leaf without a petiole to the next one around the shoot.
const GOLDEN_ANGLE: f64 = 2.399_963;

/// Downward part of the direction of a blade without `tip`.
const DROOP: f64 = 0.25;

/// Angle in radians by which the end of a blade points below its start.
const CURL: f64 = 0.5;

/// Angle in radians by which each half of a blade is raised from the midrib outwards.
const FOLD: f64 = 0.25;

/// Rows of vertices across a blade: the fraction of the length, and the width as a fraction of that of the image, so
/// that the mesh is little larger than the leaf in the image.
const BLADE_ROWS: [(f64, f64); 5] = [(0.0, 0.55), (0.15, 0.95), (0.4, 1.0), (0.7, 0.87), (1.0, 0.3)];

/// The rows of a blade in a plant with more than [`MAX_CURLED_LEAVES`] leaves.
const FLAT_BLADE_ROWS: [(f64, f64); 2] = [(0.0, 1.0), (1.0, 1.0)];

/// Most leaves whose blades are curled. The blades of more leaves are flat, which saves three quarters of the
/// triangles.
const MAX_CURLED_LEAVES: usize = 5000;

/// Fraction of the leaves with the material of sunlit leaves.
const SUNLIT_LEAVES: f64 = 0.35;

/// The middle of the image, in which the leaf is, from left to right.
const IMAGE_CENTER: f32 = 0.5 * (LEAF_SPAN[0] + LEAF_SPAN[1]);

/// Builds the meshes, whose materials are [`TREE_MATERIALS`]. The objects of the structure are replaced by those of the
/// meshes. `memory` grows with the lists of the meshes.
///
/// # Errors
/// `OutOfMemory`.
pub(super) fn build_meshes(
    structure: &mut PlantStructure,
    memory: Option<TemporaryReservation>,
) -> Result<PlantMeshes> {
    let leaf_objects: HashSet<u64> = structure.leaves.iter().map(|leaf| leaf.object_id).collect();
    let mut polygons = PolygonMesh::default();
    (polygons.memory, polygons.materials) = (memory, TREE_MATERIALS.map(str::to_owned).to_vec());
    let mut builder = SkeletonBuilder {
        meshes: PlantMeshes { polygons, ..PlantMeshes::default() },
        free_objects: Box::new((0..=u64::MAX).filter(move |id| !leaf_objects.contains(id))),
        objects: BTreeMap::new(),
    };
    let layout = LeafLayout::new(structure);
    for (index, shoot) in structure.shoots.iter().enumerate() {
        let points: Vec<Vector3<f64>> = shoot.vertices.iter().map(|point| Vector3::from(*point)).collect();
        // The parser requires radii.
        let radii = shoot.radii.as_deref().unwrap_or_default();
        let part = builder.start_object(Organ::Shoot(index), "internode");
        builder.add_shoot(part, &points, radii)?;
    }
    for (index, leaf) in structure.leaves.iter().enumerate() {
        let blade = layout.blade(structure, index);
        if let Some(polyline) = &leaf.petiole_vertices {
            let part = builder.start_object(Organ::Leaf(index), "petiole");
            let points: Vec<Vector3<f64>> = polyline.iter().map(|point| Vector3::from(*point)).collect();
            builder.add_petiole(part, &points, &blade)?;
        }
        builder.objects.insert(leaf.object_id, "leaf".into());
        builder.add_blade(Part { organ: Organ::Leaf(index), object: leaf.object_id }, &blade)?;
    }
    structure.objects = builder.objects;
    Ok(builder.meshes)
}

/// An object of an organ.
#[derive(Debug, Clone, Copy)]
struct Part {
    organ: Organ,
    object: u64,
}

/// The blade of a leaf.
#[derive(Debug, Clone, Copy)]
struct Blade {
    base: Vector3<f64>,
    /// Unit vector along the midrib.
    forward: Vector3<f64>,
    /// Unit normal of the upper face.
    normal: Vector3<f64>,
    length: f64,
    width: f64,
    /// Index of its material.
    material: usize,
    rows: &'static [(f64, f64)],
}

/// Where the blades of all leaves are.
struct LeafLayout {
    /// Length of a blade without `tip`.
    default_length: f64,
    /// Direction of the end of each petiole, by shoot, node and number of the petiole.
    petiole_directions: HashMap<(i64, i64, i64), Vector3<f64>>,
    /// Per leaf: its number among the leaflets at the same base, and the number of these leaflets.
    leaflets: Vec<(usize, usize)>,
    rows: &'static [(f64, f64)],
}

/// How the texture of a tube is mapped.
#[derive(Debug, Clone, Copy)]
enum TubeTexture {
    /// The image repeats around the tube, and along it in proportion.
    Bark { repeats: f64 },
    /// The strip of stems in the image of a leaf.
    Stem,
}

/// A tube along a polyline.
struct Tube {
    sides: usize,
    material: usize,
    texture: TubeTexture,
}

struct SkeletonBuilder {
    meshes: PlantMeshes,
    /// The ids of objects that are no leaves.
    free_objects: Box<dyn Iterator<Item = u64>>,
    objects: BTreeMap<u64, String>,
}

impl LeafLayout {
    fn new(structure: &PlantStructure) -> Self {
        let mut lengths: Vec<f64> = Vec::new();
        let mut petiole_directions = HashMap::new();
        let mut bases: HashMap<_, usize> = HashMap::new();
        let mut numbers = Vec::new();
        let base_key = |leaf: &Leaf| (key(leaf), leaf.base.map(|coordinate| (coordinate as f32).to_bits()));
        for leaf in &structure.leaves {
            let count = bases.entry(base_key(leaf)).or_insert(0);
            numbers.push(*count);
            *count += 1;
            let Some(polyline) = &leaf.petiole_vertices else { continue };
            let points = || polyline.iter().map(|point| Vector3::from(*point));
            let length: f64 = points().zip(points().skip(1)).map(|(start, end)| (end - start).norm()).sum();
            lengths.extend((length > 0.0).then_some(length));
            let last = points().next_back().unwrap_or_default();
            let direction = points().rev().find_map(|point| (last - point).try_normalize(0.0));
            if let Some(direction) = direction {
                petiole_directions.entry(key(leaf)).or_insert(direction);
            }
        }
        lengths.sort_by(f64::total_cmp);
        let median = lengths.get(lengths.len() / 2).map(|length| length * BLADE_IN_PETIOLES);
        let leaflets = structure.leaves.iter().zip(numbers).map(|(leaf, number)| (number, bases[&base_key(leaf)]));
        Self {
            default_length: median.unwrap_or_else(|| BLADE_IN_DIAGONALS * diagonal(structure)),
            petiole_directions,
            leaflets: leaflets.collect(),
            rows: if structure.leaves.len() > MAX_CURLED_LEAVES { &FLAT_BLADE_ROWS } else { &BLADE_ROWS },
        }
    }

    fn blade(&self, structure: &PlantStructure, index: usize) -> Blade {
        let leaf = &structure.leaves[index];
        let base = Vector3::from(leaf.base);
        let midrib = leaf.tip.and_then(|tip| {
            let midrib = Vector3::from(tip) - base;
            Some((midrib.try_normalize(0.0)?, midrib.norm()))
        });
        let (forward, length) = midrib.unwrap_or_else(|| (self.direction(structure, index), self.default_length));
        let normal = perpendicular(&Vector3::z(), &forward);
        // The fractional part of a multiple of the golden ratio is evenly distributed.
        let is_sunlit = (index as f64 * 0.618_034).fract() < SUNLIT_LEAVES;
        let (width, material) = (leaf.width.unwrap_or(BLADE_ASPECT * length), 1 + usize::from(is_sunlit));
        Blade { base, forward, normal, length, width, material, rows: self.rows }
    }

    /// The direction of a blade without `tip`.
    fn direction(&self, structure: &PlantStructure, index: usize) -> Vector3<f64> {
        let leaf = &structure.leaves[index];
        let direction = self.petiole_directions.get(&key(leaf)).copied();
        let direction = direction.unwrap_or_else(|| direction_from_shoot(structure, leaf));
        let forward = (direction - Vector3::z() * DROOP).try_normalize(1e-9).unwrap_or(direction);
        let (number, count) = self.leaflets[index];
        if count < 2 {
            return forward;
        }
        let angle = LEAFLET_SPREAD * (number as f64 / (count - 1) as f64 - 0.5);
        let normal = perpendicular(&Vector3::z(), &forward);
        Rotation3::from_axis_angle(&Unit::new_unchecked(normal), angle) * forward
    }
}

/// The petiole of a leaf.
const fn key(leaf: &Leaf) -> (i64, i64, i64) {
    (leaf.shoot, leaf.node, leaf.petiole)
}

/// The direction from the shoot of a leaf to its base or, for a base on the polyline, one across the shoot by the
/// number of the node.
fn direction_from_shoot(structure: &PlantStructure, leaf: &Leaf) -> Vector3<f64> {
    // The parser checks that the shoot exists.
    let Some(shoot) = structure.shoot(leaf.shoot).map(|index| &structure.shoots[index]) else { return Vector3::x() };
    let base = Vector3::from(leaf.base);
    let nearest = nearest_point_on_polyline(&shoot.vertices, &base);
    let radius = shoot.radii.as_ref().and_then(|radii| radii.iter().copied().reduce(f64::max)).unwrap_or(0.0);
    let offset = base - nearest;
    if let Some(direction) = offset.try_normalize(0.25 * radius) {
        return direction;
    }
    let ends = [0, shoot.vertices.len() - 1].map(|point| Vector3::from(shoot.vertices[point]));
    let axis = (ends[1] - ends[0]).try_normalize(0.0).unwrap_or_else(Vector3::z);
    let across = perpendicular(&Vector3::x(), &axis);
    let angle = (leaf.node as f64 + 0.5 * leaf.petiole as f64) * GOLDEN_ANGLE;
    (Rotation3::from_axis_angle(&Unit::new_unchecked(axis), angle) * across + axis * 0.5).normalize()
}

/// The diagonal of the bounding box of all shoots.
fn diagonal(structure: &PlantStructure) -> f64 {
    let (mut min, mut max) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
    for point in structure.shoots.iter().flat_map(|shoot| &shoot.vertices) {
        (min, max) = (min.inf(&Vector3::from(*point)), max.sup(&Vector3::from(*point)));
    }
    (max - min).norm()
}

/// The unit vector perpendicular to the unit vector `axis` that is nearest to `direction`, or any if they are parallel.
fn perpendicular(direction: &Vector3<f64>, axis: &Vector3<f64>) -> Vector3<f64> {
    let across = |vector: &Vector3<f64>| (vector - axis * axis.dot(vector)).try_normalize(1e-6);
    let other = if axis.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    across(direction).or_else(|| across(&other)).unwrap_or_else(Vector3::z)
}

impl SkeletonBuilder {
    /// A new object of an organ.
    fn start_object(&mut self, organ: Organ, kind: &str) -> Part {
        // There are fewer objects than ids.
        let object = self.free_objects.next().unwrap_or(u64::MAX);
        self.objects.insert(object, kind.to_owned());
        Part { organ, object }
    }

    fn add_shoot(&mut self, part: Part, points: &[Vector3<f64>], radii: &[f64]) -> Result<()> {
        let largest = radii.iter().copied().fold(0.0, f64::max);
        let sides = SHOOT_SIDES.iter().find(|(_, radius)| largest >= *radius).map_or(6, |(sides, _)| *sides);
        let repeats = (largest / MIN_BARK_RADIUS).sqrt().round().clamp(1.0, 8.0);
        self.add_tube(part, points, radii, &Tube { sides, material: 0, texture: TubeTexture::Bark { repeats } })
    }

    fn add_petiole(&mut self, part: Part, points: &[Vector3<f64>], blade: &Blade) -> Result<()> {
        let length: f64 = points.windows(2).map(|ends| (ends[1] - ends[0]).norm()).sum();
        let scale = length + blade.length;
        let mut arc_length = 0.0;
        let mut radii = Vec::with_capacity(points.len());
        for (index, point) in points.iter().enumerate() {
            arc_length += (point - points[index.saturating_sub(1)]).norm();
            let fraction = if length > 0.0 { arc_length / length } else { 0.0 };
            radii.push(scale * (PETIOLE_RADII[0] * (1.0 - fraction) + PETIOLE_RADII[1] * fraction));
        }
        let tube = Tube { sides: PETIOLE_SIDES, material: blade.material, texture: TubeTexture::Stem };
        self.add_tube(part, points, &radii, &tube)
    }

    /// Adds a tube with a ring of vertices at each point that differs from the previous one, and a pointed end. The
    /// base is open, because it is in the ground or in the parent. A polyline without length has no tube.
    fn add_tube(&mut self, part: Part, points: &[Vector3<f64>], radii: &[f64], tube: &Tube) -> Result<()> {
        let mut rings: Vec<(Vector3<f64>, f64)> = Vec::with_capacity(points.len());
        for (point, radius) in points.iter().zip(radii) {
            if rings.last().is_none_or(|(last, _)| last != point) {
                rings.push((*point, *radius));
            }
        }
        if rings.len() < 2 {
            return Ok(());
        }
        let directions: Vec<Vector3<f64>> = rings
            .windows(2)
            .map(|ends| (ends[1].0 - ends[0].0).try_normalize(0.0).unwrap_or_else(Vector3::z))
            .collect();
        let length: f64 = rings.windows(2).map(|ends| (ends[1].0 - ends[0].0).norm()).sum();
        let polygons = &mut self.meshes.polygons;
        let (first_vertex, first_uv) = (polygons.positions.len() as u32, polygons.uvs.len() as u32);
        let first_normal = polygons.normals.len() as u32;
        let (mut across, mut arc_length, mut circumferences) = (Vector3::x(), 0.0, 0.0);
        for (index, (point, radius)) in rings.iter().enumerate() {
            let before = directions[index.saturating_sub(1)];
            let after = directions[index.min(directions.len() - 1)];
            // The plane of a ring halves the bend.
            let tangent = (before + after).try_normalize(1e-6).unwrap_or(after);
            across = perpendicular(&across, &tangent);
            let third = tangent.cross(&across);
            if index > 0 {
                let step = (point - rings[index - 1].0).norm();
                arc_length += step;
                circumferences += step / (TAU * (0.5 * (radius + rings[index - 1].1)).max(MIN_BARK_RADIUS));
            }
            for side in 0..tube.sides {
                let (sin, cos) = (TAU * side as f64 / tube.sides as f64).sin_cos();
                let normal = across * cos + third * sin;
                polygons.positions.push((point + normal * *radius).into());
                polygons.normals.push(normal.cast::<f32>().into());
            }
            for side in 0..=tube.sides {
                let around = side as f64 / tube.sides as f64;
                polygons.uvs.push(tube.texture.uv(around, circumferences, arc_length / length));
            }
        }
        let (last, radius) = rings[rings.len() - 1];
        let direction = directions[directions.len() - 1];
        polygons.positions.push((last + direction * radius).into());
        polygons.normals.push(direction.cast::<f32>().into());
        let ring_corner = |ring: usize, side: usize| {
            let vertex = (ring * tube.sides + side % tube.sides) as u32;
            let uv = (ring * (tube.sides + 1) + side) as u32;
            Corner { vertex: first_vertex + vertex, uv: first_uv + uv, normal: first_normal + vertex }
        };
        for (ring, side) in (0..rings.len() - 1).flat_map(|ring| (0..tube.sides).map(move |side| (ring, side))) {
            let [a, b] = [side, side + 1].map(|side| ring_corner(ring, side));
            let [d, c] = [side, side + 1].map(|side| ring_corner(ring + 1, side));
            self.add_face(part, &[a, b, c, d], tube.material)?;
        }
        let end = (rings.len() * tube.sides) as u32;
        for side in 0..tube.sides {
            let [a, b] = [side, side + 1].map(|side| ring_corner(rings.len() - 1, side));
            let tip = Corner { vertex: first_vertex + end, uv: a.uv, normal: first_normal + end };
            self.add_face(part, &[a, b, tip], tube.material)?;
        }
        Ok(())
    }

    /// Adds a blade that is folded along its midrib and curled along its length.
    fn add_blade(&mut self, part: Part, blade: &Blade) -> Result<()> {
        let polygons = &mut self.meshes.polygons;
        let (first_vertex, first_uv) = (polygons.positions.len() as u32, polygons.uvs.len() as u32);
        let right = blade.forward.cross(&blade.normal);
        let curl = if blade.rows.len() > 2 { CURL } else { 0.0 };
        let (mut center, mut reached) = (blade.base, 0.0);
        for (fraction, relative_width) in blade.rows {
            // The midrib is an arc. Its chord is `forward`.
            let angle = |fraction: f64| curl * (fraction - 0.5);
            let (sin, cos) = angle(0.5 * (fraction + reached)).sin_cos();
            center += (blade.forward * cos - blade.normal * sin) * (blade.length * (fraction - reached));
            reached = *fraction;
            let (sin, cos) = angle(*fraction).sin_cos();
            let upward = blade.normal * cos + blade.forward * sin;
            for side in [-1.0, 0.0, 1.0] {
                let offset = 0.5 * blade.width * relative_width * side;
                let place = center + right * (offset * FOLD.cos()) + upward * (offset.abs() * FOLD.sin());
                polygons.positions.push(place.into());
                let half_span = 0.5 * (LEAF_SPAN[1] - LEAF_SPAN[0]) * (*relative_width * side) as f32;
                polygons.uvs.push([IMAGE_CENTER + half_span, LEAF_BLADE_START * (1.0 - *fraction as f32)]);
            }
        }
        let corner = |row: usize, column: usize| {
            let index = (3 * row + column) as u32;
            Corner { vertex: first_vertex + index, uv: first_uv + index, normal: NO_INDEX }
        };
        for (row, column) in (0..blade.rows.len() - 1).flat_map(|row| [(row, 0), (row, 1)]) {
            let quad =
                [corner(row, column), corner(row, column + 1), corner(row + 1, column + 1), corner(row + 1, column)];
            self.add_face(part, &quad, blade.material)?;
        }
        Ok(())
    }

    fn add_face(&mut self, part: Part, corners: &[Corner], material: usize) -> Result<()> {
        let face = self.meshes.polygons.faces.len();
        self.meshes.polygons.add_face(corners.iter().copied(), material, face)?;
        self.meshes.object_ids.push(part.object);
        self.meshes.faces_by_organ.entry(part.organ).or_default().push(face);
        Ok(())
    }
}

impl TubeTexture {
    /// The texture coordinates at a fraction of the circumference, at a length in circumferences, and at a fraction of
    /// the length.
    fn uv(self, around: f64, circumferences: f64, fraction: f64) -> [f32; 2] {
        match self {
            Self::Bark { repeats } => [(around * repeats) as f32, (-circumferences * repeats) as f32],
            Self::Stem => [STEM_U, (0.95 - 0.9 * fraction) as f32],
        }
    }
}
