//! Parser of a plant's structure (`STEM.structure.json`) and of its object ids (`STEM_object_id.dat`).

use std::collections::{BTreeMap, HashMap, HashSet};

use crate::error::{Result, invalid};

/// A shoot: a polyline from its base, in scene units, and its parent shoot.
#[derive(Debug, Clone, serde::Deserialize)]
pub(super) struct Shoot {
    pub(super) id: i64,
    /// Id of the parent shoot, negative for none.
    pub(super) parent: i64,
    pub(super) vertices: Vec<[f64; 3]>,
}

/// A leaf. One leaf per petiole has the petiole's polyline; the other leaflets of that petiole have none.
#[derive(Debug, Clone, serde::Deserialize)]
pub(super) struct Leaf {
    pub(super) object_id: u64,
    pub(super) shoot: i64,
    pub(super) node: i64,
    pub(super) petiole: i64,
    pub(super) base: [f64; 3],
    #[serde(default)]
    pub(super) petiole_vertices: Option<Vec<[f64; 3]>>,
}

#[derive(serde::Deserialize)]
struct StructureJson {
    objects: BTreeMap<String, String>,
    shoots: Vec<Shoot>,
    leaves: Vec<Leaf>,
}

/// A validated structure of a plant.
#[derive(Debug)]
pub(super) struct PlantStructure {
    /// Kind of each object.
    pub(super) objects: BTreeMap<u64, String>,
    /// Shoots in file order.
    pub(super) shoots: Vec<Shoot>,
    pub(super) leaves: Vec<Leaf>,
    /// Indices of the shoots, every parent before its children.
    pub(super) order: Vec<usize>,
    index_of: HashMap<i64, usize>,
}

impl PlantStructure {
    /// Parses and validates the JSON text.
    ///
    /// # Errors
    /// `Invalid` with the entry: invalid JSON, an unknown parent, a cycle, a number that exceeds f32, an empty line, or
    /// a leaf that is not an object or is duplicated.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self> {
        let raw: StructureJson =
            serde_json::from_slice(bytes).map_err(|error| invalid("json", "objects, shoots and leaves", error))?;
        let number = |id: &str| id.parse().map_err(|_| invalid("objects", "whole numbers as names", id));
        let objects = raw.objects.into_iter().map(|(id, kind)| Ok((number(&id)?, kind))).collect::<Result<_>>()?;
        let index_of: HashMap<_, _> = raw.shoots.iter().enumerate().map(|(index, shoot)| (shoot.id, index)).collect();
        if index_of.len() != raw.shoots.len() {
            return Err(invalid("shoots", "each id once", format!("{} ids of {}", index_of.len(), raw.shoots.len())));
        }
        let order = topological_order(&raw.shoots, &index_of)?;
        let structure = Self { objects, shoots: raw.shoots, leaves: raw.leaves, order, index_of };
        structure.check_lines()?;
        structure.check_leaves()?;
        Ok(structure)
    }

    /// The index of the shoot `id`, or `None` if there is no such shoot.
    pub(super) fn shoot(&self, id: i64) -> Option<usize> {
        self.index_of.get(&id).copied()
    }

    fn check_lines(&self) -> Result<()> {
        let shoots = self.shoots.iter().map(|shoot| (format!("shoot {}", shoot.id), &shoot.vertices[..]));
        let leaves = self.leaves.iter().flat_map(|leaf| {
            let line = leaf.petiole_vertices.as_deref().unwrap_or(std::slice::from_ref(&leaf.base));
            let base = std::slice::from_ref(&leaf.base);
            [line, base].map(|line| (format!("leaf {}", leaf.object_id), line))
        });
        for (name, line) in shoots.chain(leaves) {
            if line.is_empty() || !line.as_flattened().iter().all(|number| (*number as f32).is_finite()) {
                return Err(invalid(
                    name,
                    "a line of finite points",
                    format!("{} points: {:.3?}", line.len(), line.first()),
                ));
            }
        }
        Ok(())
    }

    fn check_leaves(&self) -> Result<()> {
        let mut seen = HashSet::new();
        for leaf in &self.leaves {
            let field = || format!("leaf {}", leaf.object_id);
            if self.objects.get(&leaf.object_id).is_none_or(|kind| kind != "leaf") || !seen.insert(leaf.object_id) {
                return Err(invalid(field(), "the object_id of a leaf, each once", leaf.object_id));
            }
            if self.shoot(leaf.shoot).is_none() {
                return Err(invalid(field(), "the id of a shoot", leaf.shoot));
            }
        }
        Ok(())
    }
}

/// Indices of shoots by depth in the hierarchy, in file order within a depth.
fn topological_order(shoots: &[Shoot], index_of: &HashMap<i64, usize>) -> Result<Vec<usize>> {
    let mut depths: Vec<Option<usize>> = vec![None; shoots.len()];
    for start in 0..shoots.len() {
        // Walk up to an ancestor of known depth and back, so that each shoot is visited once.
        let (mut path, mut at, mut depth) = (Vec::new(), Some(start), 0);
        while let Some(index) = at {
            if let Some(known) = depths[index] {
                depth = known + 1;
                break;
            }
            path.push(index);
            if path.len() > shoots.len() {
                return Err(invalid(format!("shoot {}", shoots[start].id), "an ancestor without parent", "a cycle"));
            }
            let parent = shoots[index].parent;
            at = index_of.get(&parent).copied();
            if at.is_none() && parent >= 0 {
                return Err(invalid(format!("shoot {}: parent", shoots[index].id), "the id of a shoot, or -1", parent));
            }
        }
        for index in path.into_iter().rev() {
            depths[index] = Some(depth);
            depth += 1;
        }
    }
    let mut order: Vec<usize> = (0..shoots.len()).collect();
    order.sort_by_key(|index| depths[*index]);
    Ok(order)
}

/// Parses the object of each face, one number per line.
///
/// # Errors
/// `Invalid` with the line, or if the number of lines is not the number of faces.
pub(super) fn parse_object_ids(bytes: &[u8], faces: usize) -> Result<Vec<u64>> {
    let lines = bytes.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).enumerate();
    let ids: Vec<u64> = lines
        .filter(|(_, line)| !line.is_empty())
        .map(|(index, line)| {
            let number = std::str::from_utf8(line).ok().and_then(|line| line.parse().ok());
            number
                .ok_or_else(|| invalid(format!("line {}", index + 1), "a whole number", String::from_utf8_lossy(line)))
        })
        .collect::<Result<_>>()?;
    if ids.len() != faces {
        return Err(invalid("lines", format!("{faces}, one per face"), ids.len()));
    }
    Ok(ids)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(shoots: &str, leaves: &str) -> Result<PlantStructure> {
        let text =
            format!(r#"{{"objects": {{"1": "internode", "2": "leaf"}}, "shoots": [{shoots}], "leaves": [{leaves}]}}"#);
        PlantStructure::parse(text.as_bytes())
    }

    fn shoot(id: i64, parent: i64) -> String {
        format!(r#"{{"id": {id}, "parent": {parent}, "vertices": [[0, 0, 0]], "more": 1}}"#)
    }

    fn leaf(object: u64, shoot: i64, base: &str) -> String {
        format!(r#"{{"object_id": {object}, "shoot": {shoot}, "node": 0, "petiole": 0, "base": {base}}}"#)
    }

    #[test]
    fn shoots_come_parents_first_whatever_their_order_in_the_file() {
        let text = [shoot(7, 3), shoot(3, -1), shoot(9, 7), shoot(4, -1)].join(",");
        assert_eq!(parse(&text, "").expect("good").order, [1, 3, 0, 2]);
    }

    #[test]
    fn broken_structures_are_refused_by_entry() {
        for (shoots, leaves, start) in [
            (shoot(0, 5), String::new(), "shoot 0: parent: expected the id of a shoot, or -1, got 5"),
            ([shoot(0, 1), shoot(1, 0)].join(","), String::new(), "shoot 0: expected an ancestor without parent"),
            ([shoot(0, -1), shoot(0, -1)].join(","), String::new(), "shoots: expected each id once"),
            (r#"{"id": 0, "parent": -1, "vertices": []}"#.into(), String::new(), "shoot 0: expected a line"),
            (shoot(0, -1), leaf(2, 1, "[0,0,0]"), "leaf 2: expected the id of a shoot, got 1"),
            (shoot(0, -1), leaf(1, 0, "[0,0,0]"), "leaf 1: expected the object_id of a leaf"),
            (shoot(0, -1), leaf(2, 0, "[0,1e300,0]"), "leaf 2: expected a line of finite points"),
            (shoot(0, -1), [leaf(2, 0, "[0,0,0]"), leaf(2, 0, "[0,0,0]")].join(","), "leaf 2: expected the object_id"),
            (shoot(0, -1), leaf(2, 0, "[0,0]"), "json: expected objects, shoots and leaves"),
        ] {
            let refusal = parse(&shoots, &leaves).expect_err(start).to_string();
            assert!(refusal.starts_with(start), "{refusal}");
        }
        assert!(
            PlantStructure::parse("[".repeat(100_000).as_bytes()).is_err(),
            "deep nesting is no way to end the program"
        );
    }

    #[test]
    fn one_number_per_face() {
        assert_eq!(parse_object_ids(b"1\n2\r\n 3 \n\n", 3).expect("good"), [1, 2, 3]);
        let few = parse_object_ids(b"1\n", 2).expect_err("too few").to_string();
        assert_eq!(few, "lines: expected 2, one per face, got 1");
        let odd = parse_object_ids(b"1\n-2\n", 2).expect_err("negative").to_string();
        assert_eq!(odd, "line 2: expected a whole number, got -2");
    }
}
