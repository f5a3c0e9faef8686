//! Loader of plants (`STEM.obj`, `STEM.structure.json`, `STEM_object_id.dat`): each shoot and each leaf becomes a rigid
//! domain. Lengths are in meters, Z is up. Every domain can be moved independently; a `scene.toml` with
//! `follows = "leaf"` keeps leaves attached to their shoots.

mod organs;
mod structure;

use std::collections::{BTreeMap, HashMap};

use organs::{Organ, assign_organs};
use structure::{PlantStructure, parse_object_ids};

use super::asset_dir::{AssetDir, MAX_TEXT_BYTES};
use super::obj::{self, ObjFile};
use crate::domain::{Attachment, Domain, Metadata, Modes, Shape, Transform};
use crate::error::Result;
use crate::scene::{SceneParts, UpAxis};

/// Reads the plant `stem` in the folder `files`.
///
/// The frame of a domain has the axes of the scene. Its origin is the point from which the member grows: the first
/// point of a shoot, the start of a leaf's petiole, or the base of a leaf whose petiole belongs to another leaf.
///
/// # Errors
/// `Invalid` with the file, and the expected and given value.
pub(super) fn read(files: &AssetDir, stem: &str) -> Result<SceneParts> {
    let (json, ids) = (format!("{stem}.structure.json"), format!("{stem}_object_id.dat"));
    let in_file = |name: &str| format!("file '{name}'");
    let obj = obj::parse_file(files, &format!("{stem}.obj"))?;
    let structure = PlantStructure::parse(&files.read(&json, MAX_TEXT_BYTES)?)
        .map_err(|error| error.prefix_field(&in_file(&json)))?;
    let objects = parse_object_ids(&files.read(&ids, MAX_TEXT_BYTES)?, obj.faces.len());
    let objects = objects.map_err(|error| error.prefix_field(&in_file(&ids)))?;
    let assign_organs =
        assign_organs(&structure, &points_of(&obj, &objects)).map_err(|error| error.prefix_field(&in_file(&json)))?;
    let mut parts = SceneParts { up: UpAxis::Z, ..SceneParts::named(stem) };
    obj::add_materials(&obj, files, &mut parts)?;
    let mut faces: HashMap<Organ, Vec<usize>> = HashMap::new();
    for (face, object) in objects.iter().enumerate() {
        // Always `Some`: `assign_organs` received every object that has faces.
        if let Some(member) = assign_organs.get(object) {
            faces.entry(*member).or_default().push(face);
        }
    }
    PlantBuilder { obj: &obj, structure: &structure, faces, domain_of: HashMap::new(), parts }.build()
}

/// Positions of the corners of each object.
fn points_of(obj: &ObjFile, objects: &[u64]) -> BTreeMap<u64, Vec<[f32; 3]>> {
    let mut points: BTreeMap<u64, Vec<[f32; 3]>> = BTreeMap::new();
    for (face, object) in objects.iter().enumerate() {
        let corners = obj.corners_of(face).iter().map(|corner| obj.positions[corner.v as usize]);
        points.entry(*object).or_default().extend(corners);
    }
    points
}

struct PlantBuilder<'a> {
    obj: &'a ObjFile,
    structure: &'a PlantStructure,
    faces: HashMap<Organ, Vec<usize>>,
    domain_of: HashMap<Organ, (usize, [f64; 3])>,
    parts: SceneParts,
}

impl PlantBuilder<'_> {
    /// Adds the shoots, parents first, then the leaves with a petiole, then the other leaflets, whose parents they are.
    fn build(mut self) -> Result<SceneParts> {
        let structure = self.structure;
        for index in &structure.order {
            let shoot = &structure.shoots[*index];
            let parent = structure.shoot(shoot.parent).map(Organ::Shoot);
            self.add(Organ::Shoot(*index), format!("shoot {}", shoot.id), shoot.vertices[0], parent)?;
        }
        let mut carriers = HashMap::new();
        for (index, leaf) in structure.leaves.iter().enumerate() {
            let Some(line) = &leaf.petiole_vertices else { continue };
            carriers.entry((leaf.shoot, leaf.node, leaf.petiole)).or_insert(Organ::Leaf(index));
            let parent = structure.shoot(leaf.shoot).map(Organ::Shoot);
            self.add(Organ::Leaf(index), format!("leaf {}", leaf.object_id), line[0], parent)?;
        }
        for (index, leaf) in structure.leaves.iter().enumerate() {
            if leaf.petiole_vertices.is_none() {
                let carrier = carriers.get(&(leaf.shoot, leaf.node, leaf.petiole)).copied();
                let parent = carrier.or_else(|| structure.shoot(leaf.shoot).map(Organ::Shoot));
                self.add(Organ::Leaf(index), format!("leaf {}", leaf.object_id), leaf.base, parent)?;
            }
        }
        Ok(self.parts)
    }

    fn add(&mut self, member: Organ, name: String, base: [f64; 3], parent: Option<Organ>) -> Result<()> {
        let faces = self.faces.remove(&member).unwrap_or_default();
        let piece = obj::build_faces(self.obj, &faces, base).map_err(|error| error.prefix_field(&name))?;
        self.parts.shapes.push(Shape::new(piece.mesh, Modes::rigid())?);
        let attachment = parent.and_then(|parent| self.domain_of.get(&parent)).map(|(index, parent_base)| Attachment {
            parent: *index,
            frame: translation_transform([0, 1, 2].map(|axis| base[axis] - parent_base[axis])),
            rows: Vec::new(),
        });
        self.domain_of.insert(member, (self.parts.domains.len(), base));
        let kind = if matches!(member, Organ::Shoot(_)) { "shoot" } else { "leaf" };
        self.parts.domains.push(Domain {
            name,
            shape: self.parts.shapes.len() - 1,
            material: piece.material,
            material_ranges: piece.material_ranges,
            placement: translation_transform(base),
            attachment,
            follows: None,
            rest_q: Vec::new(),
            shares_q_with: None,
            metadata: Metadata { eigenvalues: Vec::new(), notes: [("plant.kind".into(), kind.into())].into() },
        });
        Ok(())
    }
}

fn translation_transform(translation: [f64; 3]) -> Transform {
    Transform::from_parts(&nalgebra::Matrix3::identity(), &translation.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A shoot, a leaf with petiole, its leaflet, and a fruit; two materials.
    const OBJ: &str = "v 0 0 1\nv 0.1 0 1\nv 0 0.1 2\nv 0 0 2\nv 1 0 2\nv 1 1 2\nv 0.9 0 2\nv 3 3 9\n\
        usemtl bark\nf 1 2 3\nf 4 5 7\nusemtl leaf\nf 5 6 7\nf 7 6 5\nusemtl bark\nf 1 3 2\n";
    const IDS: &str = "1\n4\n2\n3\n5\n";
    const JSON: &str = r#"{
        "objects": {"1": "internode", "2": "leaf", "3": "leaf", "4": "petiole", "5": "fruit"},
        "shoots": [{"id": 0, "parent": -1, "vertices": [[0,0,1],[0,0,2]]}],
        "leaves": [
            {"object_id": 3, "shoot": 0, "node": 0, "petiole": 0, "base": [0.9,0,2], "petiole_vertices": null},
            {"object_id": 2, "shoot": 0, "node": 0, "petiole": 0, "base": [1,0,2], "petiole_vertices": [[0,0,2],[1,0,2]]}
        ]
    }"#;

    fn plant(files: &[(&str, &str)]) -> Result<SceneParts> {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, text) in [("p.obj", OBJ), ("p_object_id.dat", IDS), ("p.structure.json", JSON)].iter().chain(files) {
            std::fs::write(folder.path().join(name), text).expect("written");
        }
        read(&AssetDir::unrestricted(folder.path()), "p")
    }

    #[test]
    fn every_face_finds_its_member_and_every_member_its_parent() {
        let parts = plant(&[]).expect("good");
        let found: Vec<_> = parts
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
        let expected = [("shoot 0", 2, None, 0), ("leaf 2", 2, Some(0), 2), ("leaf 3", 1, Some(1), 0)];
        assert_eq!(found, expected, "the leaflet hangs on the leaf that carries the petiole");
        assert_eq!(parts.up, UpAxis::Z);
    }

    #[test]
    fn a_member_lies_where_its_faces_were_and_hangs_where_it_grows_from() {
        let parts = plant(&[]).expect("good");
        let leaf = &parts.domains[1];
        assert_eq!(leaf.placement.translation(), nalgebra::Vector3::new(0.0, 0.0, 2.0));
        assert_eq!(
            leaf.attachment.as_ref().expect("attached").frame.translation(),
            nalgebra::Vector3::new(0.0, 0.0, 1.0)
        );
        let world: Vec<_> = parts.shapes[leaf.shape]
            .mesh
            .rest_positions()
            .iter()
            .map(|point| leaf.placement.translation() + nalgebra::Vector3::from(*point).cast::<f64>())
            .collect();
        assert!(world.contains(&nalgebra::Vector3::new(1.0, 1.0, 2.0)), "{world:?}");
        let scene = crate::scene::Scene::new(parts).expect("a scene");
        assert_eq!((scene.rest_bounds.min, scene.rest_bounds.max), ([0.0, 0.0, 1.0], [1.0, 1.0, 2.0]), "and no more");
    }

    #[test]
    fn files_that_do_not_belong_together_are_refused_by_name() {
        for (name, text, start) in [
            ("p_object_id.dat", "1\n4\n", "file 'p_object_id.dat': lines: expected 5, one per face, got 2"),
            ("p_object_id.dat", "1\n4\n2\n3\n6\n", "file 'p.structure.json': object: expected one of the structure"),
            ("p_object_id.dat", "1\n4\n2\n2\n5\n", "leaf 3: mesh: expected at least one vertex and one triangle"),
            ("p.structure.json", "{}", "file 'p.structure.json': json: expected objects"),
            ("p.obj", "f 1 2 3\n", "file 'p.obj': line 1: f: index of v"),
        ] {
            let refusal = plant(&[(name, text)]).expect_err(start).to_string();
            assert!(refusal.starts_with(start), "{refusal}");
        }
    }
}
