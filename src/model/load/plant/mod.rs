//! Loader of plants (`STEM.obj`, `STEM.structure.json`, `STEM_object_id.dat`). Each shoot and each leaf becomes a rigid
//! domain. Lengths are in meters, Z is up. Steps can move every domain independently. A `scene.toml` with
//! `follows = "leaf"` makes leaves move with their shoots instead.

mod organs;
mod structure;

use std::collections::{BTreeMap, HashMap};

use nalgebra::Matrix4;
use organs::{Organ, assign_organs};
use structure::{PlantStructure, parse_object_ids};

use super::asset_dir::{AssetDir, MAX_TEXT_BYTES, stem_of};
use super::obj;
use super::polygons::{self, PolygonMesh};
use crate::domain::{Attachment, CreaseAngle, Domain, Metadata, Modes, Shape, Transform};
use crate::error::Result;
use crate::scene::{SceneParts, UpAxis};

/// Reads the plant whose OBJ file is `name` in the folder `files`.
///
/// The frame of a domain has the axes of the scene. Its origin is the base of the organ: the first point of a shoot,
/// the start of a leaf's petiole, or the base of a leaf whose petiole belongs to another leaf.
///
/// # Errors
/// `Invalid` with the file, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, crease_angle: CreaseAngle) -> Result<SceneParts> {
    let stem = stem_of(name);
    let (structure_file, ids_file) = (format!("{stem}.structure.json"), format!("{stem}_object_id.dat"));
    let file_field = |name: &str| format!("file '{name}'");
    let obj = obj::parse_file(files, name)?;
    files.reserve(&format!("mesh of '{name}'"), obj.polygons.build_bytes())?;
    let structure = PlantStructure::parse(&files.read(&structure_file, MAX_TEXT_BYTES)?)
        .map_err(|error| error.prefix_field(&file_field(&structure_file)))?;
    let object_ids = parse_object_ids(&files.read(&ids_file, MAX_TEXT_BYTES)?, obj.polygons.faces.len());
    let object_ids = object_ids.map_err(|error| error.prefix_field(&file_field(&ids_file)))?;
    let organs = assign_organs(&structure, &positions_by_object(&obj.polygons, &object_ids))
        .map_err(|error| error.prefix_field(&file_field(&structure_file)))?;
    let mut parts = SceneParts { up: UpAxis::Z, unit: Some(1.0), ..SceneParts::named(stem) };
    obj::add_materials(&obj, files, &mut parts)?;
    let mut faces_by_organ: HashMap<Organ, Vec<usize>> = HashMap::new();
    for (face, object_id) in object_ids.iter().enumerate() {
        // Always `Some`, because `assign_organs` received every object that has faces.
        if let Some(organ) = organs.get(object_id) {
            faces_by_organ.entry(*organ).or_default().push(face);
        }
    }
    PlantBuilder {
        polygons: &obj.polygons,
        structure: &structure,
        faces_by_organ,
        organ_domains: HashMap::new(),
        parts,
        crease_angle,
    }
    .build()
}

/// For each object id, the positions of the corners of its faces.
fn positions_by_object(polygons: &PolygonMesh, object_ids: &[u64]) -> BTreeMap<u64, Vec<[f64; 3]>> {
    let mut positions: BTreeMap<u64, Vec<[f64; 3]>> = BTreeMap::new();
    for (face, object_id) in object_ids.iter().enumerate() {
        let corners = polygons.corners_of(face).iter().map(|corner| polygons.positions[corner.vertex as usize]);
        positions.entry(*object_id).or_default().extend(corners);
    }
    positions
}

struct PlantBuilder<'a> {
    polygons: &'a PolygonMesh,
    structure: &'a PlantStructure,
    faces_by_organ: HashMap<Organ, Vec<usize>>,
    /// Index and origin of the domain of each organ so far.
    organ_domains: HashMap<Organ, (usize, [f64; 3])>,
    parts: SceneParts,
    crease_angle: CreaseAngle,
}

impl PlantBuilder<'_> {
    /// Adds the shoots, parents first, then the leaves with a petiole polyline, then the leaves without one. The parent
    /// of a leaf without a polyline is the leaf with the polyline of the same petiole or, if there is none, the shoot.
    fn build(mut self) -> Result<SceneParts> {
        let structure = self.structure;
        for index in &structure.parent_first_order {
            let shoot = &structure.shoots[*index];
            let parent = structure.shoot(shoot.parent).map(Organ::Shoot);
            self.add_domain(Organ::Shoot(*index), format!("shoot {}", shoot.id), shoot.vertices[0], parent)?;
        }
        let mut petiole_leaves = HashMap::new();
        for (index, leaf) in structure.leaves.iter().enumerate() {
            let Some(petiole) = &leaf.petiole_vertices else { continue };
            petiole_leaves.entry((leaf.shoot, leaf.node, leaf.petiole)).or_insert(Organ::Leaf(index));
            let parent = structure.shoot(leaf.shoot).map(Organ::Shoot);
            self.add_domain(Organ::Leaf(index), format!("leaf {}", leaf.object_id), petiole[0], parent)?;
        }
        for (index, leaf) in structure.leaves.iter().enumerate() {
            if leaf.petiole_vertices.is_none() {
                let petiole_leaf = petiole_leaves.get(&(leaf.shoot, leaf.node, leaf.petiole)).copied();
                let parent = petiole_leaf.or_else(|| structure.shoot(leaf.shoot).map(Organ::Shoot));
                self.add_domain(Organ::Leaf(index), format!("leaf {}", leaf.object_id), leaf.base, parent)?;
            }
        }
        Ok(self.parts)
    }

    fn add_domain(&mut self, organ: Organ, name: String, origin: [f64; 3], parent: Option<Organ>) -> Result<()> {
        let faces = self.faces_by_organ.remove(&organ).unwrap_or_default();
        let triangle_mesh = polygons::build_faces(self.polygons, &faces, origin, self.crease_angle)
            .map_err(|error| error.prefix_field(&name))?;
        self.parts.remarks.extend(triangle_mesh.remark().map(|remark| format!("{name}: {remark}")));
        self.parts.shapes.push(Shape::new(triangle_mesh.mesh, Modes::rigid())?);
        let attachment =
            parent.and_then(|parent| self.organ_domains.get(&parent)).map(|(index, parent_origin)| Attachment {
                parent: *index,
                frame: translation_transform([0, 1, 2].map(|axis| origin[axis] - parent_origin[axis])),
                vertices: Vec::new(),
            });
        self.organ_domains.insert(organ, (self.parts.domains.len(), origin));
        let kind = if matches!(organ, Organ::Shoot(_)) { "shoot" } else { "leaf" };
        let mut domain = Domain {
            material: triangle_mesh.material,
            material_ranges: triangle_mesh.material_ranges,
            attachment,
            metadata: Metadata { eigenvalues: Vec::new(), notes: [("plant.kind".into(), kind.into())].into() },
            ..Domain::new(name, self.parts.shapes.len() - 1)
        };
        domain.set_placement(&Matrix4::new_translation(&origin.into()));
        self.parts.domains.push(domain);
        Ok(())
    }
}

fn translation_transform(translation: [f64; 3]) -> Transform {
    Transform::from_parts(&nalgebra::Matrix3::identity(), &translation.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five triangles with two materials, one per object of [`IDS`]. No face uses the last vertex.
    const OBJ: &str = "v 0 0 1\nv 0.1 0 1\nv 0 0.1 2\nv 0 0 2\nv 1 0 2\nv 1 1 2\nv 0.9 0 2\nv 3 3 9\n\
        usemtl bark\nf 1 2 3\nf 4 5 7\nusemtl leaf\nf 5 6 7\nf 7 6 5\nusemtl bark\nf 1 3 2\n";
    /// The object of each face: the internode of the shoot, a petiole, the petiole's leaf, a leaflet of the same
    /// petiole, and a fruit.
    const IDS: &str = "1\n4\n2\n3\n5\n";
    const JSON: &str = r#"{
        "objects": {"1": "internode", "2": "leaf", "3": "leaf", "4": "petiole", "5": "fruit"},
        "shoots": [{"id": 0, "parent": -1, "vertices": [[0,0,1],[0,0,2]]}],
        "leaves": [
            {"object_id": 3, "shoot": 0, "node": 0, "petiole": 0, "base": [0.9,0,2], "petiole_vertices": null},
            {"object_id": 2, "shoot": 0, "node": 0, "petiole": 0, "base": [1,0,2], "petiole_vertices": [[0,0,2],[1,0,2]]}
        ]
    }"#;

    /// Reads the plant with some of its files replaced by `files`.
    fn read_plant(files: &[(&str, &str)]) -> Result<SceneParts> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, text) in [("p.obj", OBJ), ("p_object_id.dat", IDS), ("p.structure.json", JSON)].iter().chain(files) {
            std::fs::write(folder.path().join(name), text).expect("a writable file");
        }
        read(&AssetDir::unrestricted(folder.path()), "p.obj", CreaseAngle::default())
    }

    #[test]
    fn organs_have_their_faces_and_parents() {
        let parts = read_plant(&[]).expect("a valid plant");
        let domains: Vec<_> = parts
            .domains
            .iter()
            .map(|domain| {
                let triangles = parts.shapes[domain.shape].mesh.triangles().len();
                (
                    domain.name.as_str(),
                    triangles,
                    domain.attachment.as_ref().map(|attachment| attachment.parent),
                    domain.material_ranges.len(),
                )
            })
            .collect();
        // Name, triangles, parent and material ranges. The fruit belongs to the shoot, the petiole to leaf 2.
        let expected = [("shoot 0", 2, None, 0), ("leaf 2", 2, Some(0), 2), ("leaf 3", 1, Some(1), 0)];
        assert_eq!(domains, expected, "expected the leaf with the petiole as parent of the leaflet");
        assert_eq!(parts.up, UpAxis::Z);
    }

    #[test]
    fn leaf_keeps_its_position_and_attaches_at_its_petiole() {
        let parts = read_plant(&[]).expect("a valid plant");
        let leaf = &parts.domains[1];
        assert_eq!(leaf.placement.translation(), nalgebra::Vector3::new(0.0, 0.0, 2.0));
        assert_eq!(
            leaf.attachment.as_ref().expect("an attachment").frame.translation(),
            nalgebra::Vector3::new(0.0, 0.0, 1.0)
        );
        let world_positions: Vec<_> = parts.shapes[leaf.shape]
            .mesh
            .rest_positions()
            .iter()
            .map(|position| leaf.placement.translation() + nalgebra::Vector3::from(*position).cast::<f64>())
            .collect();
        assert!(world_positions.contains(&nalgebra::Vector3::new(1.0, 1.0, 2.0)), "{world_positions:?}");
        let scene = crate::scene::Scene::new(parts).expect("a valid scene");
        assert_eq!((scene.rest_bounds.min, scene.rest_bounds.max), ([0.0, 0.0, 1.0], [1.0, 1.0, 2.0]));
    }

    #[test]
    fn inconsistent_files_are_rejected_by_name() {
        for (name, text, start) in [
            ("p_object_id.dat", "1\n4\n", "file 'p_object_id.dat': lines: expected 5 (one per face), got 2"),
            (
                "p_object_id.dat",
                "1\n4\n2\n3\n6\n",
                "file 'p.structure.json': object: expected the id of an object of the structure",
            ),
            ("p_object_id.dat", "1\n4\n2\n2\n5\n", "leaf 3: mesh: expected at least one vertex and one triangle"),
            ("p.structure.json", "{}", "file 'p.structure.json': json: expected objects"),
            ("p.obj", "f 1 2 3\n", "file 'p.obj': line 1: f: index of v"),
        ] {
            let message = read_plant(&[(name, text)]).expect_err(start).to_string();
            assert!(message.starts_with(start), "{message}");
        }
    }
}
