//! Assigns each object of a plant to an organ. An object is a set of faces with one id, such as an internode (the stem
//! of one shoot), a petiole (leaf stalk) or a fruit. The organs are the shoots and the leaves; every other object
//! becomes a part of a shoot or leaf.

use std::collections::{BTreeMap, HashMap};

use nalgebra::Vector3;

use super::structure::PlantStructure;
use crate::error::{Result, invalid};

/// A part of the plant that moves independently: the index of a shoot or of a leaf.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) enum Organ {
    Shoot(usize),
    Leaf(usize),
}

/// The largest number of points per object whose distances to the shoots are computed.
const MAX_SAMPLED_POINTS: usize = 32;

/// Returns the organ of each object. `points_by_object` contains the corners of each object that has faces.
///
/// The structure does not assign object ids to shoots, but the sorted ids of the internodes are in the order of the
/// shoots. A petiole belongs to the leaf whose petiole polyline has the nearest center. Any other object belongs to the
/// nearest shoot.
///
/// # Errors
/// `Invalid` if the numbers of internodes and shoots differ, or an object is unknown.
pub(super) fn assign_organs(
    structure: &PlantStructure,
    points_by_object: &BTreeMap<u64, Vec<[f64; 3]>>,
) -> Result<HashMap<u64, Organ>> {
    let mut organs = HashMap::new();
    let internodes = structure.objects.iter().filter(|(_, kind)| *kind == "internode");
    let internodes: Vec<u64> = internodes.map(|(id, _)| *id).collect();
    if internodes.len() != structure.shoots.len() {
        let expected = format!("{} internodes, one per shoot", structure.shoots.len());
        return Err(invalid("objects", expected, internodes.len()));
    }
    organs.extend(internodes.into_iter().enumerate().map(|(shoot, id)| (id, Organ::Shoot(shoot))));
    organs.extend(
        structure.leaves.iter().enumerate().map(|(leaf_index, leaf)| (leaf.object_id, Organ::Leaf(leaf_index))),
    );
    let centers = petiole_centers(structure);
    for (id, points) in points_by_object {
        let kind = structure.objects.get(id);
        let kind = kind.ok_or_else(|| invalid("object", "the id of an object of the structure", id))?;
        let organ = match kind.as_str() {
            "internode" => continue,
            "leaf" if organs.contains_key(id) => continue,
            "leaf" => return Err(invalid(format!("leaf {id}"), "an entry in leaves", "none")),
            "petiole" => nearest_leaf(&centers, mean_point(points.iter().map(|point| Vector3::from(*point)))),
            _ => None,
        };
        let organ = organ.or_else(|| nearest_shoot(structure, points));
        organs.insert(*id, organ.ok_or_else(|| invalid(format!("{kind} {id}"), "at least one shoot", "none"))?);
    }
    Ok(organs)
}

/// Returns the index of each leaf that has a petiole polyline, and the center of the polyline. If no leaf has one,
/// returns the index and the base of every leaf.
fn petiole_centers(structure: &PlantStructure) -> Vec<(usize, Vector3<f64>)> {
    let centers: Vec<_> = structure
        .leaves
        .iter()
        .enumerate()
        .filter_map(|(index, leaf)| {
            Some((index, mean_point(leaf.petiole_vertices.as_ref()?.iter().map(|point| (*point).into()))))
        })
        .collect();
    if !centers.is_empty() {
        return centers;
    }
    structure.leaves.iter().enumerate().map(|(index, leaf)| (index, leaf.base.into())).collect()
}

fn mean_point(points: impl Iterator<Item = Vector3<f64>>) -> Vector3<f64> {
    let (sum, count) = points.fold((Vector3::zeros(), 0.0), |(sum, count), point| (sum + point, count + 1.0));
    sum / f64::max(count, 1.0)
}

fn nearest_leaf(centers: &[(usize, Vector3<f64>)], point: Vector3<f64>) -> Option<Organ> {
    let squared_distance = |(_, petiole_center): &&(usize, Vector3<f64>)| (petiole_center - point).norm_squared();
    centers
        .iter()
        .min_by(|a, b| squared_distance(a).total_cmp(&squared_distance(b)))
        .map(|(leaf, _)| Organ::Leaf(*leaf))
}

/// The shoot whose polyline is nearest to any of the points.
fn nearest_shoot(structure: &PlantStructure, points: &[[f64; 3]]) -> Option<Organ> {
    let stride = points.len().div_ceil(MAX_SAMPLED_POINTS).max(1);
    let points: Vec<Vector3<f64>> = points.iter().step_by(stride).map(|point| Vector3::from(*point)).collect();
    let squared_distance = |shoot: &usize| {
        let polyline = &structure.shoots[*shoot].vertices;
        points.iter().map(|point| squared_distance_to_polyline(polyline, point)).fold(f64::INFINITY, f64::min)
    };
    let squared_distances = (0..structure.shoots.len()).map(|shoot| (squared_distance(&shoot), shoot));
    squared_distances.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, shoot)| Organ::Shoot(shoot))
}

/// Squared distance of a point to a polyline.
fn squared_distance_to_polyline(polyline: &[[f64; 3]], point: &Vector3<f64>) -> f64 {
    (nearest_point_on_polyline(polyline, point) - point).norm_squared()
}

/// The point of a polyline that is nearest to a point. The polyline has at least one point.
pub(super) fn nearest_point_on_polyline(polyline: &[[f64; 3]], point: &Vector3<f64>) -> Vector3<f64> {
    let nearest_on_segment = |end_points: &[[f64; 3]]| {
        let start = Vector3::from(end_points[0]);
        let direction = Vector3::from(end_points[end_points.len() - 1]) - start;
        let squared_length = direction.norm_squared();
        let fraction =
            if squared_length > 0.0 { ((point - start).dot(&direction) / squared_length).clamp(0.0, 1.0) } else { 0.0 };
        start + direction * fraction
    };
    // A polyline of one point is a segment of length 0.
    let points_per_segment = 2.min(polyline.len());
    let squared_distance = |nearest: &Vector3<f64>| (nearest - point).norm_squared();
    let nearest = polyline.windows(points_per_segment).map(nearest_on_segment);
    nearest.min_by(|a, b| squared_distance(a).total_cmp(&squared_distance(b))).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const STRUCTURE: &str = r#"{
        "objects": {"5": "internode", "9": "internode", "3": "leaf", "4": "leaf", "10": "petiole", "11": "fruit"},
        "shoots": [{"id": 0, "parent": -1, "vertices": [[0,0,0],[0,0,9]]}, {"id": 1, "parent": 0, "vertices": [[5,0,0],[9,0,0]]}],
        "leaves": [
            {"object_id": 3, "shoot": 0, "node": 0, "petiole": 0, "base": [1,0,0], "petiole_vertices": [[0,0,0],[1,0,0]]},
            {"object_id": 4, "shoot": 0, "node": 1, "petiole": 0, "base": [0,3,3], "petiole_vertices": [[0,0,3],[0,3,3]]}
        ]
    }"#;

    #[test]
    fn objects_are_assigned_to_leaves_and_nearest_shoots() {
        let structure = PlantStructure::parse(STRUCTURE.as_bytes()).expect("a valid structure");
        let points = BTreeMap::from([
            (5, vec![[0.0; 3]]),
            (10, vec![[0.0, 0.0, 3.0], [0.0, 3.0, 3.0]]),
            (11, vec![[9.5, 0.0, 0.0], [20.0, 0.0, 0.0]]),
        ]);
        let organs = assign_organs(&structure, &points).expect("a valid structure");
        assert_eq!(organs[&5], Organ::Shoot(0));
        assert_eq!(organs[&9], Organ::Shoot(1));
        assert_eq!(organs[&3], Organ::Leaf(0));
        // The points of object 10 are the petiole polyline of leaf 1. Object 11 begins 0.5 from the end of shoot 1.
        assert_eq!(organs[&10], Organ::Leaf(1));
        assert_eq!(organs[&11], Organ::Shoot(1));
    }

    #[test]
    fn unknown_objects_and_missing_internodes_are_rejected() {
        let structure = PlantStructure::parse(STRUCTURE.as_bytes()).expect("a valid structure");
        let message =
            assign_organs(&structure, &BTreeMap::from([(77, vec![])])).expect_err("an unknown object").to_string();
        assert_eq!(message, "object: expected the id of an object of the structure, got 77");
        let text = STRUCTURE.replace(r#""9": "internode", "#, "");
        let structure = PlantStructure::parse(text.as_bytes()).expect("a valid structure");
        let message = assign_organs(&structure, &BTreeMap::new()).expect_err("a missing internode").to_string();
        assert_eq!(message, "objects: expected 2 internodes, one per shoot, got 1");
    }
}
