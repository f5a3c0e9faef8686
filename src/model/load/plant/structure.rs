//! Parser of a plant's structure (`STEM.structure.json`) and of its object ids (`STEM_object_id.dat`).

use std::collections::{BTreeMap, HashMap, HashSet};

use crate::domain::MAX_RANK;
use crate::error::{Result, invalid};

/// A shoot: a polyline from its base, in scene units, and its parent shoot.
#[derive(Debug, Clone, serde::Deserialize)]
pub(super) struct Shoot {
    pub(super) id: i64,
    /// Id of the parent shoot; negative if the shoot has no parent.
    pub(super) parent: i64,
    pub(super) vertices: Vec<[f64; 3]>,
    /// One radius per vertex, in scene units; `None` if the file has none.
    #[serde(default)]
    pub(super) radii: Option<Vec<f64>>,
    /// Number of modes; `None` for the default.
    #[serde(default)]
    pub(super) modes: Option<usize>,
}

/// A leaf or leaflet. Leaflets of one petiole have the same `shoot`, `node` and `petiole`. One of them has the polyline
/// of the petiole.
#[derive(Debug, Clone, serde::Deserialize)]
pub(super) struct Leaf {
    pub(super) object_id: u64,
    /// Id of the shoot.
    pub(super) shoot: i64,
    /// Number of the node along the shoot.
    pub(super) node: i64,
    /// Number of the petiole at the node.
    pub(super) petiole: i64,
    /// Point where the leaf or leaflet begins, in scene units.
    pub(super) base: [f64; 3],
    #[serde(default)]
    pub(super) petiole_vertices: Option<Vec<[f64; 3]>>,
    /// Where the blade ends, in scene units. Only for plants without an OBJ file.
    #[serde(default)]
    pub(super) tip: Option<[f64; 3]>,
    /// Width of the blade, in scene units. Only for plants without an OBJ file.
    #[serde(default)]
    pub(super) width: Option<f64>,
    /// Number of modes; `None` for the default.
    #[serde(default)]
    pub(super) modes: Option<usize>,
}

#[derive(serde::Deserialize)]
struct StructureJson {
    objects: Option<BTreeMap<String, String>>,
    shoots: Vec<Shoot>,
    leaves: Vec<Leaf>,
}

/// A validated structure of a plant.
#[derive(Debug)]
pub(super) struct PlantStructure {
    /// Kind of each object by its id, such as `leaf`.
    pub(super) objects: BTreeMap<u64, String>,
    /// Shoots in file order.
    pub(super) shoots: Vec<Shoot>,
    pub(super) leaves: Vec<Leaf>,
    /// Indices of the shoots, every parent before its children.
    pub(super) parent_first_order: Vec<usize>,
    /// Indices of the shoots by id.
    shoot_indices: HashMap<i64, usize>,
}

impl PlantStructure {
    /// Parses and validates the JSON text.
    ///
    /// # Errors
    /// `Invalid` with the entry: invalid JSON, an unknown parent, a cycle, a number that exceeds f32, an empty
    /// polyline, a negative radius, radii and vertices of different numbers, too many modes, or a leaf that is not an
    /// object or is duplicated.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self> {
        let file: StructureJson =
            serde_json::from_slice(bytes).map_err(|error| invalid("json", "objects, shoots and leaves", error))?;
        if file.objects.is_none() {
            return Err(invalid("json", "objects, shoots and leaves", "no objects"));
        }
        Self::validated(file)
    }

    /// As [`Self::parse`], for a plant without an OBJ file: `objects` is optional, and there are shoots, which have
    /// radii and at least two different points.
    ///
    /// # Errors
    /// As for [`Self::parse`].
    pub(super) fn parse_without_meshes(bytes: &[u8]) -> Result<Self> {
        let file: StructureJson =
            serde_json::from_slice(bytes).map_err(|error| invalid("json", "shoots and leaves", error))?;
        let structure = Self::validated(file)?;
        if structure.shoots.is_empty() {
            return Err(invalid("shoots", "at least one shoot", 0));
        }
        for Shoot { id, vertices, radii, .. } in &structure.shoots {
            if radii.is_none() {
                return Err(invalid(
                    format!("shoot {id}: radii"),
                    format!("{} (one per vertex)", vertices.len()),
                    "none",
                ));
            }
            if vertices.iter().all(|point| *point == vertices[0]) {
                let given = format!("{} equal points", vertices.len());
                return Err(invalid(format!("shoot {id}: vertices"), "at least two different points", given));
            }
        }
        Ok(structure)
    }

    fn validated(file: StructureJson) -> Result<Self> {
        let parse_id = |id: &str| id.parse().map_err(|_| invalid("objects", "whole numbers as ids", id));
        let objects = match file.objects {
            Some(objects) => objects.into_iter().map(|(id, kind)| Ok((parse_id(&id)?, kind))).collect::<Result<_>>()?,
            None => file.leaves.iter().map(|leaf| (leaf.object_id, "leaf".to_owned())).collect(),
        };
        let shoot_indices: HashMap<_, _> =
            file.shoots.iter().enumerate().map(|(index, shoot)| (shoot.id, index)).collect();
        if shoot_indices.len() != file.shoots.len() {
            let given = format!("{} ids of {} shoots", shoot_indices.len(), file.shoots.len());
            return Err(invalid("shoots", "different ids", given));
        }
        let parent_first_order = topological_order(&file.shoots, &shoot_indices)?;
        let structure = Self { objects, shoots: file.shoots, leaves: file.leaves, parent_first_order, shoot_indices };
        structure.check_polylines()?;
        structure.check_radii()?;
        structure.check_leaves()?;
        structure.check_mode_counts()?;
        Ok(structure)
    }

    /// The index of the shoot `id`, or `None` if there is no such shoot.
    pub(super) fn shoot(&self, id: i64) -> Option<usize> {
        self.shoot_indices.get(&id).copied()
    }

    fn check_polylines(&self) -> Result<()> {
        let shoots = self.shoots.iter().map(|shoot| (format!("shoot {}", shoot.id), &shoot.vertices[..]));
        let leaves = self.leaves.iter().flat_map(|leaf| {
            // The base and the tip of a leaf are checked as polylines of one point.
            let base_point = std::slice::from_ref(&leaf.base);
            let petiole = leaf.petiole_vertices.as_deref().unwrap_or(base_point);
            let tip_point = leaf.tip.as_ref().map_or(base_point, std::slice::from_ref);
            [petiole, base_point, tip_point].map(|polyline| (format!("leaf {}", leaf.object_id), polyline))
        });
        for (name, polyline) in shoots.chain(leaves) {
            if polyline.is_empty() || !polyline.as_flattened().iter().all(|coordinate| (*coordinate as f32).is_finite())
            {
                return Err(invalid(
                    name,
                    "a polyline of finite points",
                    format!("{} points: {:.3?}", polyline.len(), polyline.first()),
                ));
            }
        }
        Ok(())
    }

    fn check_radii(&self) -> Result<()> {
        for shoot in &self.shoots {
            let Some(radii) = &shoot.radii else { continue };
            let field = || format!("shoot {}: radii", shoot.id);
            if radii.len() != shoot.vertices.len() {
                return Err(invalid(field(), format!("{} (one per vertex)", shoot.vertices.len()), radii.len()));
            }
            let is_valid = |radius: &f64| (*radius as f32).is_finite() && *radius >= 0.0;
            if let Some(radius) = radii.iter().find(|radius| !is_valid(radius)) {
                return Err(invalid(field(), "finite numbers of at least 0", radius));
            }
        }
        Ok(())
    }

    fn check_leaves(&self) -> Result<()> {
        let mut object_ids = HashSet::new();
        for leaf in &self.leaves {
            let field = || format!("leaf {}", leaf.object_id);
            if self.objects.get(&leaf.object_id).is_none_or(|kind| kind != "leaf") || !object_ids.insert(leaf.object_id)
            {
                return Err(invalid(field(), "the object_id of a leaf, without duplicates", leaf.object_id));
            }
            if self.shoot(leaf.shoot).is_none() {
                return Err(invalid(field(), "the id of a shoot", leaf.shoot));
            }
            if let Some(width) = leaf.width.filter(|width| !((*width as f32).is_finite() && *width > 0.0)) {
                return Err(invalid(format!("{}: width", field()), "a positive finite number", width));
            }
        }
        Ok(())
    }

    fn check_mode_counts(&self) -> Result<()> {
        let shoots = self.shoots.iter().map(|shoot| (shoot.modes, "shoot", shoot.id.to_string()));
        let leaves = self.leaves.iter().map(|leaf| (leaf.modes, "leaf", leaf.object_id.to_string()));
        for (modes, kind, id) in shoots.chain(leaves) {
            if let Some(modes) = modes.filter(|modes| *modes > MAX_RANK) {
                return Err(invalid(format!("{kind} {id}: modes"), format!("at most {MAX_RANK}"), modes));
            }
        }
        Ok(())
    }
}

/// Indices of shoots by depth in the hierarchy, in file order within a depth.
fn topological_order(shoots: &[Shoot], shoot_indices: &HashMap<i64, usize>) -> Result<Vec<usize>> {
    let mut depths: Vec<Option<usize>> = vec![None; shoots.len()];
    for start in 0..shoots.len() {
        // Ascend to an ancestor of known depth, then assign depths on the way back. Each shoot gets its depth once.
        let (mut path, mut current, mut depth) = (Vec::new(), Some(start), 0);
        while let Some(index) = current {
            if let Some(known_depth) = depths[index] {
                depth = known_depth + 1;
                break;
            }
            path.push(index);
            if path.len() > shoots.len() {
                return Err(invalid(format!("shoot {}", shoots[start].id), "an ancestor without parent", "a cycle"));
            }
            let parent = shoots[index].parent;
            current = shoot_indices.get(&parent).copied();
            if current.is_none() && parent >= 0 {
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

/// Parses the object id of each face, one per line.
///
/// # Errors
/// `Invalid` with the line, or if the number of lines is not the number of faces.
pub(super) fn parse_object_ids(bytes: &[u8], face_count: usize) -> Result<Vec<u64>> {
    let lines = bytes.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii).enumerate();
    let ids: Vec<u64> = lines
        .filter(|(_, line)| !line.is_empty())
        .map(|(index, line)| {
            let id = std::str::from_utf8(line).ok().and_then(|line| line.parse().ok());
            id.ok_or_else(|| invalid(format!("line {}", index + 1), "a whole number", String::from_utf8_lossy(line)))
        })
        .collect::<Result<_>>()?;
    if ids.len() != face_count {
        return Err(invalid("lines", format!("{face_count} (one per face)"), ids.len()));
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

    /// A shoot with the unknown key `more`, which the parser must ignore.
    fn shoot_json(id: i64, parent: i64) -> String {
        format!(r#"{{"id": {id}, "parent": {parent}, "vertices": [[0, 0, 0]], "more": 1}}"#)
    }

    fn shoot_with_radii(radii: &str) -> String {
        format!(r#"{{"id": 0, "parent": -1, "vertices": [[0, 0, 0], [0, 0, 1]], "radii": {radii}}}"#)
    }

    fn leaf_json(object_id: u64, shoot: i64, base: &str) -> String {
        format!(r#"{{"object_id": {object_id}, "shoot": {shoot}, "node": 0, "petiole": 0, "base": {base}}}"#)
    }

    #[test]
    fn parent_shoots_precede_their_children() {
        let text = [shoot_json(7, 3), shoot_json(3, -1), shoot_json(9, 7), shoot_json(4, -1)].join(",");
        assert_eq!(parse(&text, "").expect("a valid structure").parent_first_order, [1, 3, 0, 2]);
    }

    #[test]
    fn radii_are_optional() {
        let radii = |text: &str| parse(text, "").expect("a valid structure").shoots[0].radii.clone();
        assert_eq!(radii(&shoot_with_radii("[0.5, 0]")), Some(vec![0.5, 0.0]));
        assert_eq!(radii(&shoot_with_radii("null")), None);
        assert_eq!(radii(&shoot_json(0, -1)), None);
    }

    #[test]
    fn invalid_structures_are_rejected_with_their_entry() {
        for (shoots, leaves, start) in [
            (shoot_json(0, 5), String::new(), "shoot 0: parent: expected the id of a shoot, or -1, got 5"),
            (
                [shoot_json(0, 1), shoot_json(1, 0)].join(","),
                String::new(),
                "shoot 0: expected an ancestor without parent",
            ),
            ([shoot_json(0, -1), shoot_json(0, -1)].join(","), String::new(), "shoots: expected different ids"),
            (r#"{"id": 0, "parent": -1, "vertices": []}"#.into(), String::new(), "shoot 0: expected a polyline"),
            (shoot_with_radii("[1]"), String::new(), "shoot 0: radii: expected 2 (one per vertex), got 1"),
            (
                shoot_with_radii("[1, -1]"),
                String::new(),
                "shoot 0: radii: expected finite numbers of at least 0, got -1",
            ),
            (shoot_with_radii("[1, 1e300]"), String::new(), "shoot 0: radii: expected finite numbers"),
            (shoot_with_radii("[1, null]"), String::new(), "json: expected objects, shoots and leaves"),
            (shoot_json(0, -1), leaf_json(2, 1, "[0,0,0]"), "leaf 2: expected the id of a shoot, got 1"),
            (shoot_json(0, -1), leaf_json(1, 0, "[0,0,0]"), "leaf 1: expected the object_id of a leaf"),
            (shoot_json(0, -1), leaf_json(2, 0, "[0,1e300,0]"), "leaf 2: expected a polyline of finite points"),
            (
                shoot_json(0, -1),
                [leaf_json(2, 0, "[0,0,0]"), leaf_json(2, 0, "[0,0,0]")].join(","),
                "leaf 2: expected the object_id",
            ),
            (shoot_json(0, -1), leaf_json(2, 0, "[0,0]"), "json: expected objects, shoots and leaves"),
            (
                shoot_json(0, -1),
                leaf_json(2, 0, "[0,0,0], \"tip\": [0,-1e300,0]"),
                "leaf 2: expected a polyline of finite points",
            ),
            (
                shoot_json(0, -1),
                leaf_json(2, 0, "[0,0,0], \"width\": 0"),
                "leaf 2: width: expected a positive finite number, got 0",
            ),
            (
                shoot_json(0, -1),
                leaf_json(2, 0, "[0,0,0], \"modes\": 513"),
                "leaf 2: modes: expected at most 512, got 513",
            ),
            (
                r#"{"id": 4, "parent": -1, "vertices": [[0, 0, 0]], "modes": 1000}"#.into(),
                String::new(),
                "shoot 4: modes: expected at most 512, got 1000",
            ),
        ] {
            let message = parse(&shoots, &leaves).expect_err(start).to_string();
            assert!(message.starts_with(start), "{message}");
        }
        assert!(
            PlantStructure::parse("[".repeat(100_000).as_bytes()).is_err(),
            "expected an error instead of a stack overflow"
        );
    }

    #[test]
    fn plants_without_meshes_need_shoots_with_radii() {
        let parse = |shoots: &str, leaves: &str| {
            let text = format!(r#"{{"shoots": [{shoots}], "leaves": [{leaves}]}}"#);
            PlantStructure::parse_without_meshes(text.as_bytes())
        };
        let structure = parse(&shoot_with_radii("[0.5, 0]"), &leaf_json(7, 0, "[0,0,1]")).expect("a valid structure");
        assert_eq!(structure.objects, BTreeMap::from([(7, "leaf".to_owned())]));
        for (shoots, leaves, expected) in [
            (String::new(), String::new(), "shoots: expected at least one shoot, got 0"),
            (shoot_json(3, -1), String::new(), "shoot 3: radii: expected 1 (one per vertex), got none"),
            (
                shoot_with_radii("[1, 1]").replace("[0, 0, 1]", "[0, 0, 0]"),
                String::new(),
                "shoot 0: vertices: expected at least two different points, got 2 equal points",
            ),
            (
                shoot_with_radii("[1, 1]"),
                [leaf_json(2, 0, "[0,0,0]"), leaf_json(2, 0, "[0,0,0]")].join(","),
                "leaf 2: expected the object_id of a leaf, without duplicates, got 2",
            ),
        ] {
            assert_eq!(parse(&shoots, &leaves).expect_err(expected).to_string(), expected);
        }
        // A plant with an OBJ file needs its objects.
        let text = format!(r#"{{"shoots": [{}], "leaves": []}}"#, shoot_with_radii("[1, 1]"));
        let message = PlantStructure::parse(text.as_bytes()).expect_err("no objects").to_string();
        assert_eq!(message, "json: expected objects, shoots and leaves, got no objects");
    }

    #[test]
    fn parse_object_ids_requires_one_id_per_face() {
        assert_eq!(parse_object_ids(b"1\n2\r\n 3 \n\n", 3).expect("valid ids"), [1, 2, 3]);
        let missing_line_error = parse_object_ids(b"1\n", 2).expect_err("a missing line").to_string();
        assert_eq!(missing_line_error, "lines: expected 2 (one per face), got 1");
        let negative_id_error = parse_object_ids(b"1\n-2\n", 2).expect_err("a negative id").to_string();
        assert_eq!(negative_id_error, "line 2: expected a whole number, got -2");
    }
}
