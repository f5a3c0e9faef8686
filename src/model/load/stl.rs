//! Loader of STL files, binary and ASCII.
//!
//! An STL file repeats the coordinates of a vertex in each of its triangles. Equal coordinates become one vertex, and
//! vertices are numbered by their first occurrence in the file. The rows of U follow this numbering. Normals of facets
//! are not used. Attribute words of binary files are colors in one of two formats ([`facet_colors`]).
//!
//! The `stl_io` crate (0.11) is not used: it reads a binary file whose header begins with `solid ` as text, ends
//! silently after the first of several solids, and rejects facets whose normal is not a number, although normals are
//! redundant.

mod facet_colors;

use std::collections::HashMap;

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, stem_of};
use super::polygons::{Corner, PolygonMesh};
use super::surface::{self, ModelOptions};
use super::text::{lines, without_byte_order_mark};
use crate::domain::{Material, origin_of_positions};
use crate::error::{Result, invalid};
use crate::memory::TemporaryReservation;
use crate::scene::{Lighting, SceneParts, UpAxis};

/// Bytes of a binary header: a comment, then the number of triangles.
const HEADER_BYTES: usize = 84;
/// Bytes at the start of a text that have no byte 0.
const TEXT_START_BYTES: usize = 1024;
/// Bytes of a binary triangle: normal, three vertices, attribute.
const TRIANGLE_BYTES: usize = 50;

/// Reads the STL file `name` in the folder `files` as one domain. Z is up.
///
/// # Errors
/// `Invalid` with the file, the line or triangle, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let mut parts = SceneParts { up: UpAxis::Z, look: Lighting::Studio.settings(), ..SceneParts::named(stem_of(name)) };
    let content = files.read(name, MAX_MODEL_BYTES)?;
    let memory = files.reserve_polygons(name, content.len())?;
    let mut polygons =
        parse(&content, memory, &mut parts.remarks).map_err(|error| error.prefix_field(&format!("file '{name}'")))?;
    parts.materials = match polygons.face_colors.is_empty() {
        true => vec![Material::unspecified("")],
        false => polygons.color_faces(&mut parts.remarks),
    };
    surface::add_domain(files, name, &polygons, options, None, &mut parts)?;
    Ok(parts)
}

fn parse(bytes: &[u8], memory: Option<TemporaryReservation>, remarks: &mut Vec<String>) -> Result<PolygonMesh> {
    let declared_bytes = bytes.get(HEADER_BYTES - 4..).and_then(|rest| rest.first_chunk()).map(|count| {
        let count = u32::from_le_bytes(*count) as usize;
        HEADER_BYTES + TRIANGLE_BYTES * count
    });
    let mut merger = VertexMerger::default();
    merger.polygons.memory = memory;
    // A binary file may also begin with `solid`. It has a byte 0: in the number of triangles, unless there are more than
    // 16,777,215, or in a coordinate.
    let text = without_byte_order_mark(bytes).unwrap_or(bytes);
    let has_key = text.trim_ascii_start().get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    let is_text = has_key && !bytes[..bytes.len().min(TEXT_START_BYTES)].contains(&0);
    match declared_bytes {
        Some(size) if size == bytes.len() || (size < bytes.len() && !is_text) => {
            if size < bytes.len() {
                remarks.push(format!("{} bytes after the last triangle are not used", bytes.len() - size));
            }
            let triangles = &bytes[HEADER_BYTES..size];
            parse_binary(triangles, &mut merger)?;
            let attributes = triangles.as_chunks::<TRIANGLE_BYTES>().0.iter();
            let attributes = attributes.map(|triangle| u16::from_le_bytes([triangle[48], triangle[49]]));
            merger.polygons.face_colors = facet_colors::decode(&bytes[..HEADER_BYTES - 4], attributes);
        }
        _ if is_text => parse_text(text, &mut merger)?,
        Some(size) => return Err(invalid("size", format!("{size} bytes, as the header declares"), bytes.len())),
        None => return Err(invalid("header", "84 bytes, or a text that begins with solid", bytes.len())),
    }
    let mut polygons = merger.polygons;
    polygons.materials.push(String::new());
    polygons.validate(|triangle| format!("triangle {triangle}"), 0)?;
    Ok(polygons)
}

fn parse_binary(triangles: &[u8], merger: &mut VertexMerger) -> Result<()> {
    for (index, triangle) in triangles.as_chunks::<TRIANGLE_BYTES>().0.iter().enumerate() {
        let coordinate = |number: usize| {
            // The normal has 12 bytes.
            let first_byte = 12 + 4 * number;
            f32::from_le_bytes([
                triangle[first_byte],
                triangle[first_byte + 1],
                triangle[first_byte + 2],
                triangle[first_byte + 3],
            ])
        };
        let vertices = [0, 3, 6].map(|first| [coordinate(first), coordinate(first + 1), coordinate(first + 2)]);
        let vertices = vertices.map(|vertex| vertex.map(f64::from));
        merger.add_triangle(vertices, index).map_err(|error| error.prefix_field(&format!("triangle {index}")))?;
    }
    Ok(())
}

/// Parses the `vertex` lines between each `outer loop` and `endloop`. The other words are not needed. Vertices are
/// merged after all of them are known, because f32 coordinates are compared relative to an origin near the mesh.
fn parse_text(bytes: &[u8], merger: &mut VertexMerger) -> Result<()> {
    let mut vertices: Vec<[f64; 3]> = Vec::new();
    let (mut positions, mut line_numbers) = (Vec::new(), Vec::new());
    let mut is_in_loop = false;
    for (index, line) in lines(bytes).enumerate() {
        let location = format_args!("line {}", index + 1).to_string();
        let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
        let key = words.next().unwrap_or_default().to_ascii_lowercase();
        match key.as_slice() {
            b"outer" => (vertices.clear(), is_in_loop = true).0,
            b"vertex" if is_in_loop && vertices.len() < 3 => {
                let number = |word: Option<&[u8]>| std::str::from_utf8(word?).ok()?.parse::<f64>().ok();
                let [x, y, z] = [words.next(), words.next(), words.next()].map(number);
                let (Some(x), Some(y), Some(z)) = (x, y, z) else {
                    let given = String::from_utf8_lossy(line.trim_ascii()).chars().take(80).collect::<String>();
                    return Err(invalid(location, "vertex and three numbers", given));
                };
                vertices.push([x, y, z]);
            }
            b"endloop" if is_in_loop => {
                let [a, b, c] = vertices[..] else {
                    return Err(invalid(location, "three vertices in a loop", vertices.len()));
                };
                check_finite(&vertices).map_err(|error| error.prefix_field(&location))?;
                positions.extend([a, b, c]);
                line_numbers.push(index + 1);
                is_in_loop = false;
            }
            b"vertex" | b"endloop" => return Err(invalid(location, "a loop of three vertices", "another statement")),
            b"" | b"solid" | b"facet" | b"endfacet" | b"endsolid" => {}
            other => {
                let given = String::from_utf8_lossy(other).chars().take(80).collect::<String>();
                return Err(invalid(location, "a statement of STL", given));
            }
        }
    }
    if is_in_loop {
        return Err(invalid("end", "endloop", "the end of the file"));
    }
    merger.origin = origin_of_positions(&positions);
    for (vertices, line) in positions.as_chunks::<3>().0.iter().zip(line_numbers) {
        merger.add_triangle(*vertices, line).map_err(|error| error.prefix_field(&format!("line {line}")))?;
    }
    Ok(())
}

/// Rejects coordinates that are not numbers in the range of f32.
fn check_finite(vertices: &[[f64; 3]]) -> Result<()> {
    match vertices.as_flattened().iter().find(|number| !(**number as f32).is_finite()) {
        None => Ok(()),
        Some(number) => Err(invalid("vertex", "finite numbers", number)),
    }
}

/// Numbers vertices by the first occurrence of their f32 coordinates.
#[derive(Default)]
struct VertexMerger {
    polygons: PolygonMesh,
    /// The point that the compared coordinates are relative to. Zero for binary files, whose coordinates are f32.
    origin: [f64; 3],
    index_of: HashMap<[u32; 3], u32>,
}

impl VertexMerger {
    fn add_triangle(&mut self, vertices: [[f64; 3]; 3], place: usize) -> Result<()> {
        check_finite(&vertices)?;
        let corners = vertices.map(|position| {
            // The sum with 0 changes -0 to 0, which is equal but has other bits.
            let position = position.map(|number| number + 0.0);
            let compared: [f32; 3] = std::array::from_fn(|axis| (position[axis] - self.origin[axis]) as f32);
            let positions = &mut self.polygons.positions;
            Corner::of_vertex(*self.index_of.entry(compared.map(f32::to_bits)).or_insert_with(|| {
                positions.push(position);
                positions.len() as u32 - 1
            }))
        });
        self.polygons.add_face(corners, 0, place)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "solid \nfacet normal nan nan nan\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 0 1 0\n\
         endloop\nendfacet\nendsolid\nsolid second\nfacet normal 0 0 1\nouter loop\nvertex 1 0 0\nVERTEX 1 1e0 -0.0\n\
         vertex 0 1 0\nendloop\nendfacet\nendsolid second\n";

    fn binary(header: &str, count: u32, triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
        let mut bytes = vec![b' '; 80];
        bytes[..header.len()].copy_from_slice(header.as_bytes());
        bytes.extend(count.to_le_bytes());
        for triangle in triangles {
            bytes.extend([0; 12]);
            bytes.extend(triangle.as_flattened().iter().flat_map(|number| number.to_le_bytes()));
            bytes.extend([0; 2]);
        }
        bytes
    }

    const SQUARE: [[[f32; 3]; 3]; 2] =
        [[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]];

    #[test]
    fn text_and_binary_files_merge_equal_vertices_in_file_order() {
        // A binary file may begin with the word that begins text files, and may have bytes after its triangles.
        let mut remarks = Vec::new();
        let padded = [binary("", 2, &SQUARE), vec![0; 3]].concat();
        let solid_padded = [binary("solid exported", 2, &SQUARE), vec![7; 3]].concat();
        let marked = format!("\u{feff}{TEXT}");
        let [cr_lf, cr] = ["\r\n", "\r"].map(|line_end| TEXT.replace('\n', line_end));
        for bytes in [
            TEXT.as_bytes(),
            marked.as_bytes(),
            cr_lf.as_bytes(),
            cr.as_bytes(),
            &binary("solid exported", 2, &SQUARE),
            &padded,
            &solid_padded,
        ] {
            let polygons = parse(bytes, None, &mut remarks).expect("a valid file");
            assert_eq!(polygons.faces.len(), 2, "expected the triangles of both solids");
            assert_eq!(polygons.positions, [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]);
            let vertices: Vec<u32> = polygons.corners_of(1).iter().map(|corner| corner.vertex).collect();
            assert_eq!(vertices, [1, 3, 2]);
        }
        assert_eq!(remarks, ["3 bytes after the last triangle are not used"; 2]);
    }

    /// Two triangles with colors, in the formats of VisCAM and of Magics, and with attributes that are no colors.
    #[test]
    fn attribute_words_are_colors_of_facets() {
        let words = |header: &[u8], attributes: [u16; 2]| {
            let mut bytes = binary("", 2, &SQUARE);
            bytes[..header.len()].copy_from_slice(header);
            for (triangle, attribute) in attributes.into_iter().enumerate() {
                let end = HEADER_BYTES + TRIANGLE_BYTES * (triangle + 1);
                bytes[end - 2..end].copy_from_slice(&attribute.to_le_bytes());
            }
            parse(&bytes, None, &mut Vec::new()).expect("a valid file").face_colors
        };
        let magics = b"by hand COLOR=\x0a\x14\x1e\xff,MATERIAL=";
        let (red, blue) = (Some([255, 0, 0]), Some([0, 0, 255]));
        assert_eq!(words(b"", [0x8000 | (31 << 10), 0x8000 | 31]), [red, blue]);
        assert_eq!(words(b"", [0x8000 | (16 << 5), 31]), [Some([0, 132, 0]), None]);
        assert_eq!(words(magics, [31, 0x8000]), [red, Some([10, 20, 30])]);
        assert_eq!(words(magics, [0, 0]), [Some([10, 20, 30]); 2]);
        assert_eq!(words(magics, [0x8000; 2]), [Some([10, 20, 30]); 2]);
        // MeshLab.
        let meshlab = b"VCG COLOR=\x7f\x7f\x7f\x7f";
        assert_eq!(words(magics, [0x8000 | 31, 0x8000 | (31 << 10)]), [red, blue]);
        assert_eq!(words(meshlab, [0x8000 | 31; 2]), [red; 2]);
        assert!(words(meshlab, [0, 0]).is_empty());
        assert!(words(b"", [0, 0]).is_empty());
        assert!(words(b"", [1, 0x7fff]).is_empty());
    }

    #[test]
    fn hostile_files_are_rejected_before_allocation() {
        let mut nan = SQUARE;
        nan[1][2][1] = f32::NAN;
        for (bytes, message) in [
            (binary("", u32::MAX, &SQUARE), "size: expected 214748364834 bytes, as the header declares, got 184"),
            (binary("solid", 3, &SQUARE), "size: expected 234 bytes, as the header declares, got 184"),
            (binary("", 3, &SQUARE), "size: expected 234 bytes, as the header declares, got 184"),
            (binary("", 2, &nan), "triangle 1: vertex: expected finite numbers, got NaN"),
            (binary("", 0, &[]), "faces: expected at least one face, got 0"),
            (vec![0; 83], "header: expected 84 bytes, or a text that begins with solid, got 83"),
            (vec![], "header: expected 84 bytes, or a text that begins with solid, got 0"),
            (TEXT.replace("1e0", "inf").into(), "line 16: vertex: expected finite numbers, got inf"),
            (TEXT.replace("1e0", "x").into(), "line 14: expected vertex and three numbers, got VERTEX 1 x -0.0"),
            (
                TEXT.replace(" outer loop", "").into(),
                "line 4: expected a loop of three vertices, got another statement",
            ),
            (TEXT.replacen("vertex 0 1 0", "", 1).into(), "line 7: expected three vertices in a loop, got 2"),
            (TEXT[..60].into(), "end: expected endloop, got the end of the file"),
            ("solid\nobject\n".into(), "line 2: expected a statement of STL, got object"),
        ] {
            assert_eq!(parse(&bytes, None, &mut Vec::new()).map(drop).expect_err(message).to_string(), message);
        }
    }
}
