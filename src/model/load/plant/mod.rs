//! Loader of plants (`STEM.obj`, `STEM.structure.json`, `STEM_object_id.dat`). Each shoot and each leaf becomes a domain.
//! Lengths are in meters, Z is up. Steps can move every domain independently. A `scene.toml` with `follows = "leaf"` makes
//! leaves move with their shoots instead.
//!
//! A shoot with radii is a beam along its polyline, and a leaf a beam along its petiole and its blade. Their modes are
//! loaded-interface modes (crate `modalcast-beam`). The rest shape is the equilibrium under the weight, so gravity is no
//! load. Other objects, such as fruits, move rigidly with the nearest section of their shoot. Shoots without radii are
//! rigid. If no shoot has radii, all organs are rigid.
//!
//! A structure without an OBJ file is a plant, too: its meshes are generated ([`skeleton`]).

mod blade;
#[cfg(test)]
mod flexible_tests;
mod organ_beams;
mod organ_modes;
mod organs;
mod skeleton;
#[cfg(test)]
mod skeleton_tests;
mod skin;
mod structure;

use std::collections::{BTreeMap, HashMap};

use nalgebra::{Matrix4, Vector3};
use organ_beams::{LeafGeometry, OrganBeam, solid_inertia};
use organ_modes::{FlexibleBody, OrganBody, OrganKind, add_modes};
use organs::{Organ, assign_organs};
use skin::Skin;
use structure::{PlantStructure, parse_object_ids};

use super::asset_dir::{AssetDir, MAX_TEXT_BYTES, stem_of};
use super::obj;
use super::plant_materials::PlantMaterials;
use super::polygons::{self, PolygonMesh};
use super::surface::{ModelOptions, ModesSource};
use crate::domain::{Attachment, CreaseAngle, Domain, Metadata, Modes, Shape, Transform};
use crate::error::{Error, Result};
use crate::scene::{SceneParts, UpAxis};

/// Most points of the polyline of a flexible organ. The time for an organ goes as its points times the vertices of its
/// mesh.
const MAX_BEAM_POINTS: usize = 4096;

/// The end of the name of a file with the structure of a plant.
pub(super) const STRUCTURE_SUFFIX: &str = ".structure.json";

/// The meshes of all organs of a plant.
#[derive(Debug, Default)]
struct PlantMeshes {
    polygons: PolygonMesh,
    /// The object of each face.
    object_ids: Vec<u64>,
    faces_by_organ: HashMap<Organ, Vec<usize>>,
}

/// Reads the plant whose OBJ file is `name` in the folder `files`.
///
/// The frame of a domain has the axes of the scene. Its origin is the base of the organ: the first point of a shoot,
/// the start of a leaf's petiole, or the base of a leaf whose petiole belongs to another leaf.
///
/// # Errors
/// `Invalid` with the file, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let stem = stem_of(name);
    let (structure_file, ids_file) = (format!("{stem}{STRUCTURE_SUFFIX}"), format!("{stem}_object_id.dat"));
    let obj = obj::parse_file(files, name)?;
    files.reserve(&format!("mesh of '{name}'"), obj.polygons.build_bytes())?;
    let structure = PlantStructure::parse(&files.read(&structure_file, MAX_TEXT_BYTES)?)
        .map_err(|error| error.prefix_field(&file_field(&structure_file)))?;
    let object_ids = parse_object_ids(&files.read(&ids_file, MAX_TEXT_BYTES)?, obj.polygons.faces.len());
    let object_ids = object_ids.map_err(|error| error.prefix_field(&file_field(&ids_file)))?;
    let organs = assign_organs(&structure, &positions_by_object(&obj.polygons, &object_ids))
        .map_err(|error| error.prefix_field(&file_field(&structure_file)))?;
    let mut parts = named_parts(stem);
    obj::add_materials(&obj, files, &mut parts)?;
    let mut faces_by_organ: HashMap<Organ, Vec<usize>> = HashMap::new();
    for (face, object_id) in object_ids.iter().enumerate() {
        // Always `Some`, because `assign_organs` received every object that has faces.
        if let Some(organ) = organs.get(object_id) {
            faces_by_organ.entry(*organ).or_default().push(face);
        }
    }
    build(PlantMeshes { polygons: obj.polygons, object_ids, faces_by_organ }, &structure, files, options, parts)
}

/// Reads the plant whose structure is the file `name` in the folder `files`, without an OBJ file. Frames are those of
/// [`read`].
///
/// # Errors
/// As for [`read`].
pub(super) fn read_skeleton(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let text = files.read(name, MAX_TEXT_BYTES)?;
    let in_file = |error: Error| error.prefix_field(&file_field(name));
    let mut structure = PlantStructure::parse_without_meshes(&text).map_err(in_file)?;
    let memory = files.reserve_polygons(name, text.len())?;
    drop(text);
    let meshes = skeleton::build_meshes(&mut structure, memory)?;
    files.reserve(&format!("mesh of '{name}'"), meshes.polygons.build_bytes())?;
    let mut parts = named_parts(&name[..name.len() - STRUCTURE_SUFFIX.len()]);
    crate::tree::add_materials(&mut parts)?;
    build(meshes, &structure, files, options, parts).map_err(in_file)
}

fn file_field(name: &str) -> String {
    format!("file '{name}'")
}

fn named_parts(name: &str) -> SceneParts {
    SceneParts { up: UpAxis::Z, unit: Some(1.0), ..SceneParts::named(name) }
}

/// Builds the domains, and adds their modes if any shoot has radii.
fn build(
    meshes: PlantMeshes,
    structure: &PlantStructure,
    files: &AssetDir,
    options: ModelOptions,
    parts: SceneParts,
) -> Result<SceneParts> {
    let PlantMeshes { polygons, object_ids, faces_by_organ } = meshes;
    let builder = PlantBuilder {
        polygons: &polygons,
        structure,
        object_ids: &object_ids,
        object_of_vertex: objects_of_vertices(&polygons, &object_ids),
        faces_by_organ,
        organ_domains: HashMap::new(),
        bodies: Vec::new(),
        parts,
        crease_angle: options.crease_angle,
        materials: options.plant,
    };
    let (mut parts, bodies) = builder.build()?;
    if options.modes != ModesSource::None {
        if structure.shoots.iter().any(|shoot| shoot.radii.is_some()) {
            add_modes(bodies, &options.plant, files, &mut parts)?;
        } else {
            parts.remarks.push("the structure has no radii: all organs are rigid".into());
        }
    }
    Ok(parts)
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

/// The object of each vertex of the file; 0 for a vertex without faces, which no mesh has.
fn objects_of_vertices(polygons: &PolygonMesh, object_ids: &[u64]) -> Vec<u64> {
    let mut objects = vec![0; polygons.positions.len()];
    for (face, object_id) in object_ids.iter().enumerate() {
        polygons.corners_of(face).iter().for_each(|corner| objects[corner.vertex as usize] = *object_id);
    }
    objects
}

struct PlantBuilder<'a> {
    polygons: &'a PolygonMesh,
    structure: &'a PlantStructure,
    /// The object of each face.
    object_ids: &'a [u64],
    /// The object of each vertex of the file.
    object_of_vertex: Vec<u64>,
    faces_by_organ: HashMap<Organ, Vec<usize>>,
    /// Index and origin of the domain of each organ so far.
    organ_domains: HashMap<Organ, (usize, [f64; 3])>,
    /// One per domain.
    bodies: Vec<OrganBody>,
    parts: SceneParts,
    crease_angle: CreaseAngle,
    materials: PlantMaterials,
}

/// The mesh of an organ, relative to the origin of its domain.
struct OrganMesh<'a> {
    faces: &'a [usize],
    origin: Vector3<f64>,
    positions: &'a [[f32; 3]],
    /// The vertex of the file for each vertex.
    file_vertices: &'a [u32],
}

impl PlantBuilder<'_> {
    /// Adds the shoots, parents first, then the leaves with a petiole polyline, then the leaves without one. The parent
    /// of a leaf without a polyline is the leaf with the polyline of the same petiole or, if there is none, the shoot.
    fn build(mut self) -> Result<(SceneParts, Vec<OrganBody>)> {
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
        Ok((self.parts, self.bodies))
    }

    fn add_domain(&mut self, organ: Organ, name: String, origin: [f64; 3], parent: Option<Organ>) -> Result<()> {
        let faces = self.faces_by_organ.remove(&organ).unwrap_or_default();
        let triangle_mesh = polygons::build_faces(self.polygons, &faces, origin, self.crease_angle)
            .map_err(|error| error.prefix_field(&name))?;
        self.parts.remarks.extend(triangle_mesh.remark().map(|remark| format!("{name}: {remark}")));
        let parent = parent.and_then(|parent| self.organ_domains.get(&parent)).copied();
        let (kind, mode_count) = match organ {
            Organ::Shoot(index) => (OrganKind::Shoot, self.structure.shoots[index].modes),
            Organ::Leaf(index) => (OrganKind::Leaf, self.structure.leaves[index].modes),
        };
        let mesh = OrganMesh {
            faces: &faces,
            origin: origin.into(),
            positions: triangle_mesh.mesh.rest_positions(),
            file_vertices: &triangle_mesh.file_vertices,
        };
        self.bodies.push(OrganBody {
            kind,
            parent: parent.map(|(index, _)| index),
            mode_count,
            origin: origin.into(),
            flexible: self.create_flexible_body(organ, &mesh),
        });
        self.parts.shapes.push(Shape::new(triangle_mesh.mesh, Modes::rigid())?);
        let attachment = parent.map(|(index, parent_origin)| Attachment {
            parent: index,
            frame: translation_transform([0, 1, 2].map(|axis| origin[axis] - parent_origin[axis])),
            vertices: Vec::new(),
        });
        self.organ_domains.insert(organ, (self.parts.domains.len(), origin));
        let kind_note = if kind == OrganKind::Shoot { "shoot" } else { "leaf" };
        let notes = [("plant.kind".into(), kind_note.into())].into();
        let mut domain = Domain {
            material: triangle_mesh.material,
            material_ranges: triangle_mesh.material_ranges,
            attachment,
            metadata: Metadata { notes, ..Metadata::default() },
            ..Domain::new(name, self.parts.shapes.len() - 1)
        };
        domain.set_placement(&Matrix4::new_translation(&origin.into()));
        self.parts.domains.push(domain);
        Ok(())
    }

    /// The beam and the skin of an organ, or why it is rigid.
    fn create_flexible_body(&self, organ: Organ, mesh: &OrganMesh<'_>) -> Result<FlexibleBody, String> {
        let relative = |points: &[[f64; 3]]| points.iter().map(|point| Vector3::from(*point) - mesh.origin).collect();
        let OrganBeam { mut beam, rings } = match organ {
            Organ::Shoot(index) => {
                let shoot = &self.structure.shoots[index];
                let radii = shoot.radii.as_ref().ok_or("it has no radii")?;
                check_point_count(&shoot.vertices)?;
                let points: Vec<_> = relative(&shoot.vertices);
                OrganBeam::of_shoot(&points, radii, &self.materials)
            }
            Organ::Leaf(index) => {
                let leaf = &self.structure.leaves[index];
                let petiole = leaf.petiole_vertices.as_deref().unwrap_or_default();
                check_point_count(petiole)?;
                let petiole_points = self.triangles(mesh, |object| self.kind(object) == "petiole");
                let geometry = LeafGeometry {
                    petiole: relative(petiole),
                    petiole_points: petiole_points.into_iter().flatten().collect(),
                    base: Vector3::from(leaf.base) - mesh.origin,
                    blade: self.triangles(mesh, |object| object == leaf.object_id),
                };
                OrganBeam::of_leaf(&geometry, &self.materials)
            }
        }
        .map_err(|error| error.to_string())?;
        let mut skin = Skin::new(&beam, &rings, mesh.positions);
        for object in self.rigid_objects(mesh) {
            let triangles = self.triangles(mesh, |other| other == object);
            let distance = |point: &Vector3<f64>| (beam.nearest_station(point), *point);
            let nearest = triangles.iter().flatten().map(distance).min_by(|a, b| a.0.1.total_cmp(&b.0.1));
            let Some(((station, _), _)) = nearest else { continue };
            let is_part = |vertex: &u32| {
                let file_vertex = mesh.file_vertices[*vertex as usize];
                self.object_of_vertex[file_vertex as usize] == object
            };
            let vertices: Vec<u32> = (0..mesh.positions.len() as u32).filter(is_part).collect();
            skin.fix_to_section(&vertices, &beam, station);
            let body = solid_inertia(&triangles, self.materials.wood().density, &beam.center(station));
            beam.add_own_body(station, body);
        }
        Ok(FlexibleBody { beam, skin })
    }

    fn kind(&self, object: u64) -> &str {
        self.structure.objects.get(&object).map_or("", String::as_str)
    }

    /// The objects of an organ that do not bend: neither a stem nor a petiole nor a leaf.
    fn rigid_objects(&self, mesh: &OrganMesh<'_>) -> Vec<u64> {
        let mut objects: Vec<u64> = mesh.faces.iter().map(|face| self.object_ids[*face]).collect();
        objects.sort_unstable();
        objects.dedup();
        objects.retain(|object| !["internode", "petiole", "leaf"].contains(&self.kind(*object)));
        objects
    }

    /// The triangles of the faces of some objects, relative to the origin of the domain.
    fn triangles(&self, mesh: &OrganMesh<'_>, is_chosen: impl Fn(u64) -> bool) -> Vec<[Vector3<f64>; 3]> {
        let mut triangles = Vec::new();
        for face in mesh.faces.iter().filter(|face| is_chosen(self.object_ids[**face])) {
            let place = |corner: &polygons::Corner| {
                Vector3::from(self.polygons.positions[corner.vertex as usize]) - mesh.origin
            };
            let corners: Vec<Vector3<f64>> = self.polygons.corners_of(*face).iter().map(place).collect();
            triangles.extend((2..corners.len()).map(|index| [corners[0], corners[index - 1], corners[index]]));
        }
        triangles
    }
}

fn check_point_count(polyline: &[[f64; 3]]) -> Result<(), String> {
    match polyline.len() {
        0..=MAX_BEAM_POINTS => Ok(()),
        count => Err(format!("expected at most {MAX_BEAM_POINTS} points of its polyline, got {count}")),
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
        read(&AssetDir::unrestricted(folder.path()), "p.obj", ModelOptions::default())
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
