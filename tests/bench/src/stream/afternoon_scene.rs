//! Writes a scene as plain arrays for `tests/bench/peers/afternoon.py`. Numbers are little-endian.
//!
//! | file | contents |
//! |---|---|
//! | `scene.json` | camera, light, look, materials, and the coordinates of each domain |
//! | `rest_positions.f32` | 3 numbers for each vertex of all domains, in the frame of its domain |
//! | `modes.f32` | 3 x r numbers for each vertex; r is the largest rank, and smaller ranks are padded with zeros |
//! | `vertex_domains.u32` | the domain of each vertex |
//! | `corner_vertices.u32`, `rest_normals.f32`, `uvs.f32` | vertex, normal and texture coordinates of each corner |
//! | `indices.u32` | corners of the triangles, ordered by material |
//! | `image-0.rgba`, ... | pixels of each texture |

use std::path::Path;

use modalcast_client::{AlphaMode, DescriptionRequest, Domain, Material, SceneDescription, Shape, ShapeArray};
use serde_json::{Value, json};

use super::SCENE;
use super::motion::coordinate_ranges;
use super::session::Session;
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::load;
use modalcast_model::scene::{Camera, Lens, Scene, View};

/// The arrays of the program, joined over all domains.
#[derive(Debug, Default)]
struct JoinedArrays {
    rest_positions: Vec<f32>,
    modes: Vec<f32>,
    vertex_domains: Vec<u32>,
    corner_vertices: Vec<u32>,
    rest_normals: Vec<f32>,
    uvs: Vec<f32>,
    /// Corners of the triangles of each material.
    triangles: Vec<Vec<u32>>,
}

/// Writes the scene of a session, without its motion.
///
/// # Errors
/// `Fault` when a file cannot be written or the server does not describe the scene.
pub(super) fn write(session: &Session, folder: &Path, [width, height]: [u32; 2]) -> Result<()> {
    let arrays = [
        ShapeArray::Indices,
        ShapeArray::CornerVertices,
        ShapeArray::RestPositions,
        ShapeArray::Uvs,
        ShapeArray::RestNormals,
        ShapeArray::Modes,
    ];
    let request = DescriptionRequest::new(SCENE).arrays(&arrays).textures();
    let description = session.runtime.block_on(session.client.describe_with(&request)).map_err(fault_in("report"))?;
    let scene = load::open(&session.path())?.scene;
    let settings = scene_settings(&scene, &description, [width, height])?;
    write_description(folder, &description, settings)
}

fn write_description(folder: &Path, description: &SceneDescription, mut settings: Value) -> Result<()> {
    let max_rank = description.shapes.iter().map(|shape| shape.rank).max().unwrap_or(0);
    let joined = JoinedArrays::new(description, max_rank);
    settings["max_rank"] = max_rank.into();
    settings["coordinates"] = coordinates(description);
    settings["materials"] = materials(description, &joined.triangles);
    settings["images"] = description.textures.iter().map(|image| json!([image.width, image.height])).collect();
    std::fs::create_dir_all(folder).map_err(fault_in("report"))?;
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).map_err(fault_in("report"));
    write("scene.json", &serde_json::to_vec(&settings).map_err(fault_in("report"))?)?;
    write("rest_positions.f32", bytemuck::cast_slice(&joined.rest_positions))?;
    write("modes.f32", bytemuck::cast_slice(&joined.modes))?;
    write("vertex_domains.u32", bytemuck::cast_slice(&joined.vertex_domains))?;
    write("corner_vertices.u32", bytemuck::cast_slice(&joined.corner_vertices))?;
    write("rest_normals.f32", bytemuck::cast_slice(&joined.rest_normals))?;
    write("uvs.f32", bytemuck::cast_slice(&joined.uvs))?;
    write("indices.u32", bytemuck::cast_slice(&joined.triangles.concat()))?;
    for (index, image) in description.textures.iter().enumerate() {
        write(&format!("image-{index}.rgba"), &image.pixels)?;
    }
    Ok(())
}

impl JoinedArrays {
    fn new(description: &SceneDescription, max_rank: usize) -> Self {
        let mut joined = Self { triangles: vec![Vec::new(); description.materials.len()], ..Self::default() };
        for (index, domain) in description.domains.iter().enumerate() {
            joined.add(index, domain, &description.shapes[domain.shape], max_rank);
        }
        joined
    }

    fn add(&mut self, index: usize, domain: &Domain, shape: &Shape, max_rank: usize) {
        let first_vertex = self.vertex_domains.len() as u32;
        let first_corner = self.corner_vertices.len() as u32;
        self.rest_positions.extend_from_slice(&shape.rest_positions);
        for row in 0..3 * shape.vertex_count {
            self.modes.extend_from_slice(&shape.modes[row * shape.rank..(row + 1) * shape.rank]);
            self.modes.resize(self.modes.len() + max_rank - shape.rank, 0.0);
        }
        self.vertex_domains.resize(self.vertex_domains.len() + shape.vertex_count, index as u32);
        self.corner_vertices.extend(shape.corner_vertices.iter().map(|vertex| first_vertex + vertex));
        self.rest_normals.extend_from_slice(&shape.rest_normals);
        // A shape without texture coordinates has no textured material.
        self.uvs.extend_from_slice(&shape.uvs);
        self.uvs.resize(2 * self.corner_vertices.len(), 0.0);
        for (triangle, corners) in shape.indices.as_chunks::<3>().0.iter().enumerate() {
            let material = material_of(domain, triangle);
            self.triangles[material].extend(corners.map(|corner| first_corner + corner));
        }
    }
}

/// The material of a triangle: that of the last range that begins at or before it, or that of the domain.
fn material_of(domain: &Domain, triangle: usize) -> usize {
    let ranges = &domain.material_ranges;
    match ranges.partition_point(|range| range.first_triangle <= triangle).checked_sub(1) {
        Some(range) => ranges[range].material,
        None => domain.material,
    }
}

/// The first coordinate of each domain in a row of `q.npy`, and its number of coordinates.
fn coordinates(description: &SceneDescription) -> Value {
    let mut ranges = vec![0..0; description.domains.len()];
    for (domain, range) in coordinate_ranges(description) {
        ranges[domain as usize] = range;
    }
    // A domain shares the coordinates of one with a smaller index.
    for (index, domain) in description.domains.iter().enumerate() {
        if let Some(owner) = domain.shares_q_with {
            ranges[index] = ranges[owner].clone();
        }
    }
    ranges.iter().map(|range| json!([range.start, range.len()])).collect()
}

/// The materials, with the range of the triangles of each one.
fn materials(description: &SceneDescription, triangles: &[Vec<u32>]) -> Value {
    let mut first_triangle = 0;
    let with_range = |(material, indices): (&Material, &Vec<u32>)| {
        let count = indices.len() / 3;
        first_triangle += count;
        json!({
            "ambient": material.ambient, "diffuse": material.diffuse, "specular": material.specular,
            "shininess": material.shininess, "double_sided": material.double_sided, "image": material.color_texture,
            "cutoff": if material.alpha_mode == AlphaMode::Mask { material.alpha_cutoff } else { 0.0 },
            "first": first_triangle - count, "count": count,
        })
    };
    description.materials.iter().zip(triangles).map(with_range).collect()
}

fn scene_settings(scene: &Scene, description: &SceneDescription, [width, height]: [u32; 2]) -> Result<Value> {
    let (View::LookAt { eye, target, up }, Lens::FieldOfView(degrees)) =
        (Camera::fit_to_scene(scene, width, height).view, Camera::fit_to_scene(scene, width, height).lens)
    else {
        return Err(fault("report", "expected a camera with a position and a field of view"));
    };
    let to_sun: [f64; 3] = scene.look.to_sun(scene.up).into();
    let vertical: [f64; 3] = scene.up.vector().into();
    Ok(json!({
        "size": [width, height], "samples": scene.look.samples, "bounds": description.info.bounds,
        "camera": { "eye": eye, "target": target, "up": up, "field_of_view": degrees },
        "up": vertical, "to_sun": to_sun, "look": scene.look,
    }))
}

#[cfg(test)]
mod tests {
    use modalcast_client::MaterialRange;

    use super::*;

    /// Domains of one shape with rank 1 and one of rank 2: triangles of materials 1 and 0.
    fn description() -> SceneDescription {
        let shape = |rank: usize, indices: Vec<u32>| Shape {
            vertex_count: 3,
            rank,
            corner_vertices: vec![0, 1, 2, 2],
            rest_positions: vec![0.0; 9],
            rest_normals: vec![0.0; 12],
            modes: (0..9 * rank).map(|entry| 1.0 + entry as f32).collect(),
            indices,
            ..Shape::default()
        };
        let range = |first_triangle, material| MaterialRange { first_triangle, material };
        let domains = vec![
            Domain {
                index: 0,
                shape: 0,
                rank: 1,
                material_ranges: vec![range(0, 1), range(1, 0)],
                ..Domain::default()
            },
            Domain { index: 1, shape: 1, rank: 2, material: 1, ..Domain::default() },
            Domain { index: 2, shape: 0, rank: 1, shares_q_with: Some(0), ..Domain::default() },
        ];
        SceneDescription {
            shapes: vec![shape(1, vec![0, 1, 2, 0, 1, 3]), shape(2, vec![0, 1, 2])],
            materials: vec![Material::default(); 2],
            domains,
            ..SceneDescription::default()
        }
    }

    #[test]
    fn domains_are_joined_and_triangles_ordered_by_material() {
        let joined = JoinedArrays::new(&description(), 2);
        assert_eq!(joined.vertex_domains, [0, 0, 0, 1, 1, 1, 2, 2, 2]);
        assert_eq!(joined.corner_vertices, [0, 1, 2, 2, 3, 4, 5, 5, 6, 7, 8, 8]);
        assert_eq!(joined.triangles, [vec![0, 1, 3, 8, 9, 10, 8, 9, 11], vec![0, 1, 2, 4, 5, 6]]);
        // Rows of one mode have a zero as the second one.
        assert_eq!(joined.modes[..4], [1.0, 0.0, 2.0, 0.0]);
        assert_eq!(joined.modes[18..22], [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(joined.uvs.len(), 2 * joined.corner_vertices.len());
    }

    #[test]
    fn shared_coordinates_have_the_range_of_their_owner() {
        assert_eq!(coordinates(&description()), json!([[0, 1], [1, 2], [0, 1]]));
    }

    #[test]
    fn written_materials_cover_all_triangles() {
        let folder = tempfile::tempdir().expect("expected a folder");
        write_description(folder.path(), &description(), json!({})).expect("expected written files");
        let text = std::fs::read(folder.path().join("scene.json")).expect("expected a file");
        let settings: Value = serde_json::from_slice(&text).expect("expected JSON");
        let ranges = settings["materials"].as_array().expect("expected materials").iter();
        let ranges: Vec<_> = ranges.map(|material| (material["first"].clone(), material["count"].clone())).collect();
        assert_eq!(ranges, [(json!(0), json!(3)), (json!(3), json!(2))]);
        let size = std::fs::metadata(folder.path().join("indices.u32")).expect("expected a file").len();
        assert_eq!(size, 5 * 12);
    }
}
