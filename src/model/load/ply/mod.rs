//! Loader of PLY files, ASCII and binary. Vertices keep the order of the file. Colors of vertices are sRGB.

mod element;
mod header;
mod reader;

use ply_rs_bw::ply::ElementDef;

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, stem_of};
use super::polygons::{Corner, NO_INDEX, PolygonMesh};
use super::surface::{self, ModelOptions};
use super::texture_cache;
use super::values::{CorrectedValue, Corrections};
use crate::domain::{AlphaMode, Material};
use crate::error::{Result, invalid};
use crate::load::obj::DEFAULT_ALPHA_CUTOFF;
use crate::scene::{Lighting, SceneParts, UpAxis};
use element::{PlyFace, PlyVertex, Skipped};
use header::PlyHeader;
use reader::ElementReader;

/// Reads the PLY file `name` in the folder `files` as one domain. Z is up.
///
/// # Errors
/// `Invalid` with the file, the element, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let in_file = |error: crate::error::Error| error.prefix_field(&format!("file '{name}'"));
    let mut parts = SceneParts { up: UpAxis::Z, look: Lighting::Studio.settings(), ..SceneParts::named(stem_of(name)) };
    let mut ply = PlyReader::default();
    let content = files.read(name, MAX_MODEL_BYTES)?;
    ply.polygons.memory = files.reserve_polygons(name, content.len())?;
    ply.parse(&content).map_err(in_file)?;
    parts.remarks.append(&mut ply.remarks);
    parts.remarks.extend(ply.polygons.corrections.remarks(files.is_strict()).map_err(in_file)?);
    add_materials(&mut ply.polygons, files, &mut parts).map_err(in_file)?;
    surface::add_domain(files, name, &ply.polygons, options, None, &mut parts)?;
    Ok(parts)
}

/// Adds a material per image, or else per color of a face.
fn add_materials(polygons: &mut PolygonMesh, files: &AssetDir, parts: &mut SceneParts) -> Result<()> {
    let has_images = polygons.has_uvs() && polygons.materials.iter().any(|name| !name.is_empty());
    if !polygons.face_colors.is_empty() {
        // Programs without colors of vertices write white ones.
        if polygons.colors.iter().all(|color| *color == [1.0; 3]) {
            polygons.colors.clear();
        }
        let reason = if has_images { Some("the faces have images") } else { None };
        let reason = reason.or((!polygons.colors.is_empty()).then_some("the vertices have colors"));
        let Some(reason) = reason else {
            parts.materials = polygons.color_faces(&mut parts.remarks);
            return Ok(());
        };
        parts.remarks.push(format!("colors of faces are not used, because {reason}"));
    }
    for name in &polygons.materials {
        let mut material = Material::unspecified("");
        if has_images && !name.is_empty() {
            set_image(&mut material, files, name, parts)?;
        }
        parts.materials.push(material);
    }
    Ok(())
}

/// Gives a material the image that a comment `TextureFile` names.
fn set_image(material: &mut Material, files: &AssetDir, image: &str, parts: &mut SceneParts) -> Result<()> {
    let subject = format!("TextureFile '{image}'");
    let path = files.find_image(image, &subject, "the surface is drawn without it", &mut parts.remarks)?;
    let Some(path) = path else { return Ok(()) };
    let texture = texture_cache::decode(files, &path)?;
    let mask = AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF };
    material.alpha_mode = if texture.has_alpha() { mask } else { AlphaMode::Opaque };
    (material.ambient, material.diffuse) = ([1.0; 3], [1.0; 3]);
    material.color_texture = Some(parts.textures.len());
    parts.textures.push(texture);
    Ok(())
}

/// The content of a file.
#[derive(Debug, Default)]
struct PlyReader {
    polygons: PolygonMesh,
    /// One per face, as in the file; empty if the faces have no colors.
    face_colors: Vec<[f32; 3]>,
    remarks: Vec<String>,
}

impl PlyReader {
    fn parse(&mut self, bytes: &[u8]) -> Result<()> {
        let (header, mut body) = PlyHeader::parse(bytes)?;
        self.remarks = header.remarks();
        // One material per image, in the order of the property `texnumber`.
        self.polygons.materials = header.texture_files();
        if self.polygons.materials.is_empty() {
            self.polygons.materials.push(String::new());
        }
        for (name, definition) in &header.elements {
            let mut elements = ElementReader { body, encoding: header.encoding, definition };
            match name.as_str() {
                "vertex" => elements.for_each(|_, vertex: PlyVertex| {
                    self.add_vertex(&vertex, definition);
                    Ok(())
                })?,
                "face" => elements.for_each(|index, face: PlyFace| self.add_face(&face, index, definition))?,
                _ => elements.for_each(|_, Skipped| Ok(()))?,
            }
            body = elements.body;
        }
        let unused_bytes = body.trim_ascii().len();
        if unused_bytes > 0 {
            self.remarks.push(format!("{unused_bytes} bytes after the last element are not used"));
        }
        if header.elements.get("face").is_none_or(|face| face.count == 0) {
            let vertex_count = self.polygons.positions.len();
            return Err(invalid("element face", "at least one face", format!("{vertex_count} vertices, no face")));
        }
        self.polygons.corrections.face_colors(&mut self.face_colors);
        let bytes = |color: [f32; 3]| Some(color.map(|channel| (255.0 * channel).round() as u8));
        self.polygons.face_colors = std::mem::take(&mut self.face_colors).into_iter().map(bytes).collect();
        self.polygons.validate(|face| format!("face {face}"), 0)
    }

    fn add_vertex(&mut self, vertex: &PlyVertex, definition: &ElementDef) {
        let has = |name: &str| definition.properties.contains_key(name);
        let polygons = &mut self.polygons;
        polygons.positions.push(vertex.position);
        if has("nx") {
            polygons.normals.push(vertex.normal);
        }
        if ["s", "u", "texture_u"].into_iter().any(has) {
            // In the file, v = 0 is the bottom of the image; in meshes, it is the top.
            polygons.uvs.push([vertex.uv[0], 1.0 - vertex.uv[1]]);
        }
        if has("red") {
            polygons.colors.push(vertex.color);
        }
    }

    fn add_face(&mut self, face: &PlyFace, index: usize, definition: &ElementDef) -> Result<()> {
        let polygons = &mut self.polygons;
        let field = || format!("face {index}");
        let count = polygons.positions.len();
        let is_vertex = |vertex: &&f64| vertex.fract() == 0.0 && (0.0..count as f64).contains(*vertex);
        if let Some(vertex) = face.vertices.iter().find(|vertex| !is_vertex(vertex)) {
            return Err(invalid(format!("{}: index", field()), format!("0 to {}", count.saturating_sub(1)), vertex));
        }
        let (has_normals, has_uvs) = (!polygons.normals.is_empty(), polygons.uvs.len() >= count && count > 0);
        let first_wedge_uv = polygons.uvs.len() as u32;
        let has_wedge_uvs = face.uvs.len() == 2 * face.vertices.len();
        if has_wedge_uvs {
            polygons.uvs.extend(face.uvs.as_chunks::<2>().0.iter().map(|[u, v]| [*u, 1.0 - *v]));
        } else if !face.uvs.is_empty() {
            let expected = format!("{} numbers", 2 * face.vertices.len());
            let value = || CorrectedValue::new(field(), expected, face.uvs.len());
            polygons.corrections.add("texcoord", "the list is ignored", value);
        }
        let material = material_of(face, index, polygons.materials.len(), &mut polygons.corrections);
        let corner = |(corner, vertex): (usize, &f64)| {
            let vertex = *vertex as u32;
            let uv = match (has_wedge_uvs, has_uvs) {
                (true, _) => first_wedge_uv + corner as u32,
                (false, true) => vertex,
                (false, false) => NO_INDEX,
            };
            Corner { vertex, uv, normal: if has_normals { vertex } else { NO_INDEX } }
        };
        polygons
            .add_face(face.vertices.iter().enumerate().map(corner), material, index)
            .map_err(|error| error.prefix_field(&field()))?;
        // A face of a line or a point is not added.
        if definition.properties.contains_key("red") && polygons.faces.len() > self.face_colors.len() {
            self.face_colors.push(face.color);
        }
        Ok(())
    }
}

/// The index of the material of a face: that of its image, if the file has several.
fn material_of(face: &PlyFace, index: usize, material_count: usize, corrections: &mut Corrections) -> usize {
    match face.texture {
        Some(texture) if texture.fract() == 0.0 && (0.0..material_count as f64).contains(&texture) => texture as usize,
        None => 0,
        Some(_) if material_count == 1 => 0,
        Some(texture) => {
            let expected = format!("0 to {}", material_count - 1);
            let value = || CorrectedValue::new(format!("face {index}"), expected, texture);
            corrections.add("texnumber", "the first image is used", value);
            0
        }
    }
}

#[cfg(test)]
mod tests;
