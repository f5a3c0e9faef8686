//! Assigns each object of a plant to a member: every shoot and every leaf is a member, and each other object joins one.

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

/// Points per object that are compared with the shoots.
const MAX_SAMPLED_POINTS: usize = 32;

/// The member of each object. `points` contains the corners of each object that has faces.
///
/// The structure does not assign object ids to shoots; internode ids, sorted, are in the order of the shoots. A petiole
/// joins the leaf whose petiole line has the nearest center. Any other object joins the nearest shoot.
///
/// # Errors
/// `Invalid` if the numbers of internodes and shoots differ, or an object is unknown.
pub(super) fn assign_organs(
    structure: &PlantStructure,
    points: &BTreeMap<u64, Vec<[f32; 3]>>,
) -> Result<HashMap<u64, Organ>> {
    let mut assign_organs = HashMap::new();
    let internodes = structure.objects.iter().filter(|(_, kind)| *kind == "internode");
    let internodes: Vec<u64> = internodes.map(|(id, _)| *id).collect();
    if internodes.len() != structure.shoots.len() {
        let expected = format!("{} internodes, one per shoot", structure.shoots.len());
        return Err(invalid("objects", expected, internodes.len()));
    }
    assign_organs.extend(internodes.into_iter().enumerate().map(|(shoot, id)| (id, Organ::Shoot(shoot))));
    assign_organs.extend(structure.leaves.iter().enumerate().map(|(leaf, about)| (about.object_id, Organ::Leaf(leaf))));
    let centers = petiole_centers(structure);
    for (id, points) in points {
        let kind = structure.objects.get(id).ok_or_else(|| invalid("object", "one of the structure", id))?;
        let member = match kind.as_str() {
            "internode" => continue,
            "leaf" if assign_organs.contains_key(id) => continue,
            "leaf" => return Err(invalid(format!("leaf {id}"), "an entry in leaves", "none")),
            "petiole" => nearest_leaf(&centers, center(points.iter().map(|point| Vector3::from(*point).cast()))),
            _ => None,
        };
        let member = member.or_else(|| nearest_shoot(structure, points));
        assign_organs.insert(*id, member.ok_or_else(|| invalid(format!("{kind} {id}"), "a shoot to join", "none"))?);
    }
    Ok(assign_organs)
}

/// Centers of the petiole lines of all leaves that have one. If none has, the bases of all leaves.
fn petiole_centers(structure: &PlantStructure) -> Vec<(usize, Vector3<f64>)> {
    let with_line: Vec<_> = structure
        .leaves
        .iter()
        .enumerate()
        .filter_map(|(leaf, about)| {
            Some((leaf, center(about.petiole_vertices.as_ref()?.iter().map(|point| (*point).into()))))
        })
        .collect();
    if !with_line.is_empty() {
        return with_line;
    }
    structure.leaves.iter().enumerate().map(|(leaf, about)| (leaf, about.base.into())).collect()
}

fn center(points: impl Iterator<Item = Vector3<f64>>) -> Vector3<f64> {
    let (sum, count) = points.fold((Vector3::zeros(), 0.0), |(sum, count), point| (sum + point, count + 1.0));
    sum / f64::max(count, 1.0)
}

fn nearest_leaf(centers: &[(usize, Vector3<f64>)], petiole: Vector3<f64>) -> Option<Organ> {
    let distance = |(_, center): &&(usize, Vector3<f64>)| (center - petiole).norm_squared();
    centers.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).map(|(leaf, _)| Organ::Leaf(*leaf))
}

/// The shoot whose line is nearest to any of the points.
fn nearest_shoot(structure: &PlantStructure, points: &[[f32; 3]]) -> Option<Organ> {
    let step = points.len().div_ceil(MAX_SAMPLED_POINTS).max(1);
    let points: Vec<Vector3<f64>> = points.iter().step_by(step).map(|point| Vector3::from(*point).cast()).collect();
    let distance = |shoot: &usize| {
        let line = &structure.shoots[*shoot].vertices;
        points.iter().map(|point| squared_distance_to_polyline(line, point)).fold(f64::INFINITY, f64::min)
    };
    let by_distance = (0..structure.shoots.len()).map(|shoot| (distance(&shoot), shoot));
    by_distance.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, shoot)| Organ::Shoot(shoot))
}

/// Squared distance of a point to a polyline.
fn squared_distance_to_polyline(line: &[[f64; 3]], point: &Vector3<f64>) -> f64 {
    let to_segment = |ends: &[[f64; 3]]| {
        let start = Vector3::from(ends[0]);
        let along = Vector3::from(ends[ends.len() - 1]) - start;
        let length = along.norm_squared();
        let share = if length > 0.0 { ((point - start).dot(&along) / length).clamp(0.0, 1.0) } else { 0.0 };
        (start + along * share - point).norm_squared()
    };
    line.windows(2.min(line.len())).map(to_segment).fold(f64::INFINITY, f64::min)
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
    fn petioles_join_their_leaf_fruit_the_nearest_shoot_and_internodes_follow_shoot_order() {
        let structure = PlantStructure::parse(STRUCTURE.as_bytes()).expect("good");
        let points = BTreeMap::from([
            (5, vec![[0.0; 3]]),
            (10, vec![[0.0, 0.0, 3.0], [0.0, 3.0, 3.0]]),
            (11, vec![[9.5, 0.0, 0.0], [20.0, 0.0, 0.0]]),
        ]);
        let assign_organs = assign_organs(&structure, &points).expect("good");
        assert_eq!(assign_organs[&5], Organ::Shoot(0));
        assert_eq!(assign_organs[&9], Organ::Shoot(1));
        assert_eq!(assign_organs[&3], Organ::Leaf(0));
        assert_eq!(assign_organs[&10], Organ::Leaf(1));
        assert_eq!(assign_organs[&11], Organ::Shoot(1));
    }

    #[test]
    fn unknown_objects_and_missing_internodes_are_refused() {
        let structure = PlantStructure::parse(STRUCTURE.as_bytes()).expect("good");
        let refusal = assign_organs(&structure, &BTreeMap::from([(77, vec![])])).expect_err("unknown").to_string();
        assert_eq!(refusal, "object: expected one of the structure, got 77");
        let text = STRUCTURE.replace(r#""9": "internode", "#, "");
        let structure = PlantStructure::parse(text.as_bytes()).expect("good");
        let refusal = assign_organs(&structure, &BTreeMap::new()).expect_err("one internode").to_string();
        assert_eq!(refusal, "objects: expected 2 internodes, one per shoot, got 1");
    }
}
