//! Loader of PLY files, ASCII and binary. Vertices keep the order of the file. Colors of vertices are sRGB.

mod element;
mod header;

use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{ElementDef, Encoding, PropertyAccess};

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, stem_of};
use super::polygons::{Corner, NO_INDEX, PolygonMesh};
use super::surface::{self, ModelOptions};
use super::texture_cache;
use crate::domain::{AlphaMode, Material};
use crate::error::{Result, invalid};
use crate::load::obj::DEFAULT_ALPHA_CUTOFF;
use crate::scene::{SceneParts, UpAxis};
use element::{PlyFace, PlyVertex, Skipped};
use header::PlyHeader;

/// The longest part of a parser error in an error message, in characters.
const MAX_REASON_CHARACTERS: usize = 160;

/// Reads the PLY file `name` in the folder `files` as one domain. Z is up.
///
/// # Errors
/// `Invalid` with the file, the element, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let in_file = |error: crate::error::Error| error.prefix_field(&format!("file '{name}'"));
    let mut parts = SceneParts { up: UpAxis::Z, ..SceneParts::named(stem_of(name)) };
    let mut ply = PlyReader::default();
    let content = files.read(name, MAX_MODEL_BYTES)?;
    ply.polygons.memory = files.reserve_polygons(name, content.len())?;
    ply.parse(&content).map_err(in_file)?;
    let mut material = Material::unspecified("");
    if let Some(image) = ply.image.take().filter(|_| ply.polygons.has_uvs()) {
        if let Some(reason) = files.unusable_image(&image).map_err(in_file)? {
            parts.remarks.push(format!("TextureFile '{image}' {reason}: the surface is drawn without it"));
        } else {
            let texture = texture_cache::decode(files, &image)?;
            let mask = AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF };
            material.alpha_mode = if texture.has_alpha() { mask } else { AlphaMode::Opaque };
            (material.ambient, material.diffuse) = ([1.0; 3], [1.0; 3]);
            material.color_texture = Some(parts.textures.len());
            parts.textures.push(texture);
        }
    }
    parts.remarks.append(&mut ply.remarks);
    parts.materials.push(material);
    surface::add_domain(files, name, &ply.polygons, options, None, &mut parts)?;
    Ok(parts)
}

/// The content of a file.
#[derive(Debug, Default)]
struct PlyReader {
    polygons: PolygonMesh,
    /// The file in the comment `TextureFile`.
    image: Option<String>,
    remarks: Vec<String>,
    /// Number of faces with one or two corners: the points and lines of a finite-element mesh.
    small_face_count: usize,
}

impl PlyReader {
    fn parse(&mut self, bytes: &[u8]) -> Result<()> {
        let (header, mut body) = PlyHeader::parse(bytes)?;
        self.image = header.texture_file();
        self.remarks = header.remarks();
        self.polygons.materials.push(String::new());
        for (name, definition) in &header.elements {
            let mut elements = ElementReader { body, encoding: header.encoding, definition };
            match name.as_str() {
                "vertex" => elements.for_each(|_, vertex: PlyVertex| self.add_vertex(&vertex, definition))?,
                "face" => elements.for_each(|index, face: PlyFace| self.add_face(&face, index))?,
                _ => elements.for_each(|_, Skipped| Ok(()))?,
            }
            body = elements.body;
        }
        let vertex_count = self.polygons.positions.len() as u32;
        if header.elements.get("face").is_none_or(|face| face.count == 0) {
            return Err(invalid("element face", "at least one face", format!("{vertex_count} vertices, no face")));
        }
        let count = self.small_face_count;
        if header.elements.get("face").is_some_and(|face| face.count == count) {
            return Err(invalid("element face", "at least one face", format!("{count} points and lines")));
        }
        if count > 0 {
            self.remarks
                .push(format!("{count} faces are points or lines, with fewer than 3 corners: they are not drawn"));
        }
        self.polygons.check(|face| format!("face {face}"), 0)
    }

    fn add_vertex(&mut self, vertex: &PlyVertex, definition: &ElementDef) -> Result<()> {
        let numbers = vertex.position.iter().chain(&vertex.normal).chain(&vertex.uv).chain(&vertex.color);
        let field = || format!("vertex {}", self.polygons.positions.len());
        if let Some(number) = numbers.copied().find(|number| !number.is_finite()) {
            return Err(invalid(field(), "finite numbers", number));
        }
        let has = |name: &str| definition.properties.contains_key(name);
        if has("red") && vertex.color.iter().any(|channel| !(0.0..=1.0).contains(channel)) {
            return Err(invalid(field(), "colors of 0 to 1, or whole numbers", format!("{:?}", vertex.color)));
        }
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
        Ok(())
    }

    fn add_face(&mut self, face: &PlyFace, index: usize) -> Result<()> {
        let polygons = &mut self.polygons;
        let field = || format!("face {index}");
        if face.vertices.len() < 3 {
            self.small_face_count += 1;
            return Ok(());
        }
        let count = polygons.positions.len();
        if let Some(vertex) = face.vertices.iter().find(|vertex| !(0..count as i64).contains(*vertex)) {
            return Err(invalid(format!("{}: index", field()), format!("0 to {}", count.saturating_sub(1)), vertex));
        }
        let (has_normals, has_uvs) = (!polygons.normals.is_empty(), polygons.uvs.len() >= count && count > 0);
        let first_wedge_uv = polygons.uvs.len() as u32;
        if !face.uvs.is_empty() {
            if face.uvs.len() != 2 * face.vertices.len() || !face.uvs.iter().all(|number| number.is_finite()) {
                let expected = format!("{} finite numbers", 2 * face.vertices.len());
                return Err(invalid(format!("{}: texcoord", field()), expected, format!("{:?}", face.uvs)));
            }
            polygons.uvs.extend(face.uvs.as_chunks::<2>().0.iter().map(|[u, v]| [*u, 1.0 - *v]));
        }
        let corner = |(corner, vertex): (usize, &i64)| {
            let vertex = *vertex as u32;
            let uv = match (face.uvs.is_empty(), has_uvs) {
                (false, _) => first_wedge_uv + corner as u32,
                (true, true) => vertex,
                (true, false) => NO_INDEX,
            };
            Corner { vertex, uv, normal: if has_normals { vertex } else { NO_INDEX } }
        };
        polygons
            .add_face(face.vertices.iter().enumerate().map(corner), 0, index)
            .map_err(|error| error.prefix_field(&field()))
    }
}

/// Reads the elements of one definition, one after another, so that memory does not depend on their number.
struct ElementReader<'a> {
    /// The rest of the file.
    body: &'a [u8],
    encoding: Encoding,
    definition: &'a ElementDef,
}

impl ElementReader<'_> {
    fn for_each<E: PropertyAccess>(&mut self, mut add: impl FnMut(usize, E) -> Result<()>) -> Result<()> {
        let parser = Parser::<E>::new();
        for index in 0..self.definition.count {
            let element = match self.encoding {
                Encoding::Ascii => {
                    next_line(&mut self.body).and_then(|line| parser.read_ascii_element(line, self.definition))
                }
                Encoding::BinaryLittleEndian => parser.read_little_endian_element(&mut self.body, self.definition),
                Encoding::BinaryBigEndian => parser.read_big_endian_element(&mut self.body, self.definition),
            };
            let element = element.map_err(|error| {
                let reason: String = error.to_string().chars().take(MAX_REASON_CHARACTERS).collect();
                let reason = reason.replace(['\n', '\t'], " ");
                invalid(format!("{} {index}", self.definition.name), "a complete element", reason)
            })?;
            add(index, element)?;
        }
        Ok(())
    }
}

/// Takes the next line that is not empty.
fn next_line<'a>(body: &mut &'a [u8]) -> ply_rs_bw::parser::Result<&'a str> {
    loop {
        let length = body.iter().position(|byte| *byte == b'\n').map_or(body.len(), |length| length + 1);
        if length == 0 {
            return Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof).into());
        }
        let (line, rest) = body.split_at(length);
        *body = rest;
        let line = std::str::from_utf8(line).map_err(std::io::Error::other)?.trim();
        if !line.is_empty() {
            return Ok(line);
        }
    }
}

#[cfg(test)]
mod tests;
