//! Parser of OBJ files.
//!
//! The `tobj` crate is not used because it renumbers vertices by first use. The rows of U follow the `v` lines of the
//! file. Renumbered vertices would get wrong rows, and no check would notice because the number of rows still matches.

use std::collections::{BTreeMap, HashMap};

use crate::error::{Error, Result, invalid};
use crate::load::polygons::{Corner, NO_INDEX, PolygonMesh};
use crate::memory::TemporaryReservation;

/// The largest number of remarks on unsupported statements, one per key.
const MAX_REMARKS: usize = 16;

/// Marks a vertex without a color in a file that has colors. Such a vertex is white.
const NO_COLOR: [f32; 3] = [-1.0; 3];

/// The contents of an OBJ file.
#[derive(Debug, Default)]
pub(in crate::load) struct ObjFile {
    /// Faces before any `usemtl` have a material with an empty name.
    pub(in crate::load) polygons: PolygonMesh,
    /// The arguments of each `mtllib`.
    pub(in crate::load) libraries: Vec<String>,
    /// Messages about statements that are not supported.
    pub(in crate::load) remarks: Vec<String>,
}

impl ObjFile {
    /// Parses a file. The polygons grow in `memory`, if it is limited.
    ///
    /// # Errors
    /// `Invalid` with the line and the statement, `OutOfMemory`.
    pub(in crate::load) fn parse(bytes: &[u8], memory: Option<TemporaryReservation>) -> Result<Self> {
        let mut parser = Parser::default();
        parser.obj.polygons.memory = memory;
        let mut joined_line = Vec::new();
        for (index, line) in without_byte_order_mark(bytes)?.split(|byte| *byte == b'\n').enumerate() {
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            // A backslash at the end of a line continues it on the next one.
            if let Some(line_start) = line.strip_suffix(b"\\") {
                joined_line.extend_from_slice(line_start);
                joined_line.push(b' ');
                continue;
            }
            let line_number = index + 1;
            if joined_line.is_empty() {
                parser.parse_line(line, line_number)?;
            } else {
                joined_line.extend_from_slice(line);
                parser.parse_line(&std::mem::take(&mut joined_line), line_number)?;
            }
        }
        parser.finish()
    }
}

/// A text without the byte-order mark that some programs write at its start.
///
/// # Errors
/// `Invalid` for the mark of UTF-16.
pub(super) fn without_byte_order_mark(text: &[u8]) -> Result<&[u8]> {
    match text {
        [0xef, 0xbb, 0xbf, rest @ ..] => Ok(rest),
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => Err(invalid("text", "UTF-8", "UTF-16")),
        _ => Ok(text),
    }
}

#[derive(Default)]
struct Parser {
    obj: ObjFile,
    /// The name of the last `usemtl`.
    current_material: String,
    /// The index of `current_material` in [`PolygonMesh::materials`]; `None` until a face uses it.
    current_index: Option<usize>,
    /// Indices in [`PolygonMesh::materials`] by name.
    material_indices: HashMap<String, usize>,
    /// The corners of the current face. The allocation is reused.
    corners: Vec<Corner>,
    /// The largest channel of all colors of vertices.
    max_color: f32,
    /// Number of statements per unsupported key.
    unsupported_counts: BTreeMap<String, usize>,
}

impl Parser {
    fn parse_line(&mut self, line: &[u8], line_number: usize) -> Result<()> {
        let mut words = words(line);
        let Some(key) = words.next() else { return Ok(()) };
        match key {
            b"v" => self.add_vertex(words, line_number)?,
            b"vn" => self.obj.polygons.normals.push(parse_vector(words, "vn", line_number)?),
            b"vt" => {
                let [u, v] = parse_texture_coordinates(words, line_number)?;
                // In the file, v = 0 is the bottom of the image; in meshes, it is the top.
                self.obj.polygons.uvs.push([u, 1.0 - v]);
            }
            b"f" => self.add_face(words, line_number)?,
            b"usemtl" => (self.current_material, self.current_index) = (text_after_key(line), None),
            b"mtllib" => self.obj.libraries.push(text_after_key(line)),
            // Groups and smoothing groups do not affect geometry: normals come from the file or are computed.
            b"o" | b"g" | b"s" => {}
            other => *self.unsupported_counts.entry(String::from_utf8_lossy(other).into_owned()).or_default() += 1,
        }
        Ok(())
    }

    /// The index of the current material. The first face with a material adds it to the list.
    fn current_material_index(&mut self) -> usize {
        if let Some(index) = self.current_index {
            return index;
        }
        let materials = &mut self.obj.polygons.materials;
        let index = *self.material_indices.entry(self.current_material.clone()).or_insert_with(|| {
            materials.push(self.current_material.clone());
            materials.len() - 1
        });
        *self.current_index.insert(index)
    }

    fn add_face<'a>(&mut self, words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<()> {
        let mut corners = std::mem::take(&mut self.corners);
        corners.clear();
        for word in words {
            let mut fields = word.split(|byte| *byte == b'/');
            let mut parse_index = |list: &str, count: usize| match fields.next() {
                None | Some(b"") => Ok(NO_INDEX),
                Some(digits) => {
                    resolve_index(digits, count).map_err(|error| error.prefix_field(&format!("line {line}: f: {list}")))
                }
            };
            let polygons = &self.obj.polygons;
            let vertex = parse_index("v", polygons.positions.len())?;
            let uv = parse_index("vt", polygons.uvs.len())?;
            let normal = parse_index("vn", polygons.normals.len())?;
            if vertex == NO_INDEX || fields.next().is_some() {
                let given = String::from_utf8_lossy(word).into_owned();
                return Err(invalid(format!("line {line}: f"), "corners of the form v, v/vt, v//vn or v/vt/vn", given));
            }
            corners.push(Corner { vertex, uv, normal });
        }
        if corners.len() < 3 {
            return Err(invalid(format!("line {line}: f"), "at least 3 corners", corners.len()));
        }
        let material = self.current_material_index();
        self.obj.polygons.add_face(corners.iter().copied(), material, line)?;
        self.corners = corners;
        Ok(())
    }

    /// Adds a vertex: its position and, if three or more numbers follow, its color.
    fn add_vertex<'a>(&mut self, mut words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<()> {
        let position = parse_vector(words.by_ref(), "v", line)?;
        let polygons = &mut self.obj.polygons;
        polygons.positions.push(position);
        let color_words: Vec<&[u8]> = words.take(3).collect();
        // A single number is the weight of a rational curve.
        if let [_, _, _] = color_words[..] {
            let color = parse_vector(color_words.into_iter(), "v: color", line)?;
            if color.iter().any(|channel| !(0.0..=255.0).contains(channel)) {
                return Err(invalid(format!("line {line}: v: color"), "0 to 1, or 0 to 255", format!("{color:?}")));
            }
            self.max_color = color.into_iter().fold(self.max_color, f32::max);
            polygons.colors.resize(polygons.positions.len() - 1, NO_COLOR);
            polygons.colors.push(color);
        }
        Ok(())
    }

    fn finish(mut self) -> Result<ObjFile> {
        let polygons = &mut self.obj.polygons;
        polygons.check(|line| format!("line {line}: f"), 1)?;
        if !polygons.colors.is_empty() {
            let scale = if self.max_color > 1.0 { 255.0 } else { 1.0 };
            if scale > 1.0 {
                self.obj.remarks.push("colors of vertices are divided by 255, because some exceed 1".into());
            }
            polygons.colors.resize(polygons.positions.len(), NO_COLOR);
            for color in &mut polygons.colors {
                *color = if *color == NO_COLOR { [1.0; 3] } else { color.map(|channel| channel / scale) };
            }
        }
        let remark = |(key, count): (&String, &usize)| format!("{count} statements '{key}' are not used");
        self.obj.remarks.extend(self.unsupported_counts.iter().take(MAX_REMARKS).map(remark));
        Ok(self.obj)
    }
}

/// Words of a line up to a comment.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    let words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    words.take_while(|word| !word.starts_with(b"#"))
}

/// The text after the first word: a name that may contain spaces.
pub(super) fn text_after_key(line: &[u8]) -> String {
    let text = String::from_utf8_lossy(line);
    text.trim()
        .split_once(|character: char| character.is_ascii_whitespace())
        .map_or("", |(_, remainder)| remainder.trim())
        .to_owned()
}

/// Parses a finite number.
pub(super) fn parse_number(word: &[u8]) -> Option<f32> {
    std::str::from_utf8(word).ok()?.parse().ok().filter(|number: &f32| number.is_finite())
}

/// Parses three finite numbers. `key` and `line` are part of the error.
fn parse_vector<'a>(mut words: impl Iterator<Item = &'a [u8]>, key: &str, line: usize) -> Result<[f32; 3]> {
    let mut numbers = [0.0; 3];
    for number in &mut numbers {
        let word = words.next();
        *number = word.and_then(parse_number).ok_or_else(|| number_error(key, "three finite numbers", word, line))?;
    }
    Ok(numbers)
}

fn parse_texture_coordinates<'a>(mut words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<[f32; 2]> {
    let (u, v) = (words.next(), words.next());
    let parse = |word: Option<&[u8]>| {
        word.and_then(parse_number).ok_or_else(|| number_error("vt", "one to three finite numbers", word, line))
    };
    Ok([parse(u)?, if v.is_some() { parse(v)? } else { 0.0 }])
}

fn number_error(key: &str, expected: &str, word: Option<&[u8]>, line: usize) -> Error {
    let given = word.map_or("the end of the line".into(), String::from_utf8_lossy);
    invalid(format!("line {line}: {key}"), expected, given)
}

/// Converts an index of the file to an index from 0. A positive index counts from 1, a negative one backwards from the
/// last of the `count` elements so far.
fn resolve_index(digits: &[u8], count: usize) -> Result<u32> {
    let text = String::from_utf8_lossy(digits);
    let invalid_index = |expected: String| invalid("index", expected, &text);
    let index: i64 = text.parse().map_err(|_| invalid_index("a whole number".into()))?;
    let zero_based_index =
        if index < 0 { i64::try_from(count).ok().and_then(|count| count.checked_add(index)) } else { Some(index - 1) };
    let valid_index = zero_based_index.and_then(|index| u32::try_from(index).ok()).filter(|index| *index != NO_INDEX);
    valid_index.ok_or_else(|| invalid_index(format!("1 to {count} or -{count} to -1")))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

    #[test]
    fn negative_indices_count_back_from_the_last_element() {
        let text = format!("{TRIANGLE}vt 0.25 0.25\nvn 0 0 1\nf -3/-1/-1 -2/-1/-1 -1/-1/-1\nv 9 9 9\n");
        let obj = ObjFile::parse(text.as_bytes(), None).expect("a valid file");
        let indices: Vec<_> =
            obj.polygons.corners_of(0).iter().map(|corner| (corner.vertex, corner.uv, corner.normal)).collect();
        assert_eq!(indices, [(0, 0, 0), (1, 0, 0), (2, 0, 0)]);
        assert_eq!(obj.polygons.uvs, [[0.25, 0.75]], "expected a flipped v");
        assert_eq!(obj.polygons.positions.len(), 4, "expected the unreferenced vertex");
    }

    #[test]
    fn comments_continuations_and_names_with_spaces_are_parsed() {
        // The third vertex has a color. The material `none` has no face.
        let text = "# head\r\nmtllib my file.mtl\r\nv 0 0 0 # first\r\nv 1 \\\r\n 0 0\r\nv 0 1 0 1 0 0\r\n\
                    usemtl dark bark\r\nf 1 2 \\\n 3\r\nl 1 2\r\nusemtl none\nusemtl light\nf 3 2 1 # back\n";
        let obj = ObjFile::parse(text.as_bytes(), None).expect("a valid file");
        assert_eq!(obj.libraries, ["my file.mtl"]);
        assert_eq!(obj.polygons.materials, ["dark bark", "light"]);
        assert_eq!(obj.polygons.positions, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        assert_eq!((obj.polygons.faces[0].material, obj.polygons.faces[1].material), (0, 1));
        assert_eq!(obj.remarks, ["1 statements 'l' are not used"]);
    }

    #[test]
    fn byte_order_mark_is_no_part_of_the_first_statement() {
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        let marked = ObjFile::parse(format!("\u{feff}{text}").as_bytes(), None).expect("a valid file");
        assert_eq!(
            marked.polygons.positions,
            ObjFile::parse(text.as_bytes(), None).expect("a valid file").polygons.positions
        );
        assert!(marked.remarks.is_empty(), "{:?}", marked.remarks);
        let utf16: Vec<u8> = format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect();
        let message = ObjFile::parse(&utf16, None).expect_err("UTF-16").to_string();
        assert_eq!(message, "text: expected UTF-8, got UTF-16");
    }

    #[test]
    fn invalid_statements_are_rejected_with_their_line() {
        for (statement, message) in [
            ("f 1 2 4", "line 4: f: index of v: expected 1 to 3, got 4"),
            ("f 1 2 0", "line 4: f: v: index: expected 1 to 3 or -3 to -1, got 0"),
            ("f 1 2 -4", "line 4: f: v: index: expected 1 to 3 or -3 to -1, got -4"),
            ("f 1 2 4294967296", "line 4: f: v: index: expected 1 to 3 or -3 to -1, got 4294967296"),
            ("f 1 2 2147483648", "line 4: f: index of v: expected 1 to 3, got 2147483648"),
            ("f 1 2 99999999999999999999", "line 4: f: v: index: expected a whole number, got 99999999999999999999"),
            ("f 1 2 3/1", "line 4: f: index of vt: expected no index in a file without vt, got 1"),
            ("f 1 2 3//7", "line 4: f: index of vn: expected no index in a file without vn, got 7"),
            ("f 1 2 3/1/1/1", "line 4: f: expected corners of the form v, v/vt, v//vn or v/vt/vn, got 3/1/1/1"),
            ("f 1 2 /1", "line 4: f: expected corners of the form v, v/vt, v//vn or v/vt/vn, got /1"),
            ("f 1 2", "line 4: f: expected at least 3 corners, got 2"),
            ("v 1 nan 2\nf 1 2 3", "line 4: v: expected three finite numbers, got nan"),
            ("v 1 1e39 2\nf 1 2 3", "line 4: v: expected three finite numbers, got 1e39"),
            ("v 1 2\nf 1 2 3", "line 4: v: expected three finite numbers, got the end of the line"),
            ("v 1 2 3 0 nan 0\nf 1 2 3", "line 4: v: color: expected three finite numbers, got nan"),
            ("v 1 2 3 0 0 300\nf 1 2 3", "line 4: v: color: expected 0 to 1, or 0 to 255, got [0.0, 0.0, 300.0]"),
            ("v 1 2 3 0 -1 0\nf 1 2 3", "line 4: v: color: expected 0 to 1, or 0 to 255, got [0.0, -1.0, 0.0]"),
            ("vt\nf 1 2 3", "line 4: vt: expected one to three finite numbers, got the end of the line"),
            ("vn 0 0 x\nf 1 2 3", "line 4: vn: expected three finite numbers, got x"),
            ("", "faces: expected at least one face, got 0"),
        ] {
            let text = format!("{TRIANGLE}{statement}\n");
            assert_eq!(ObjFile::parse(text.as_bytes(), None).expect_err(statement).to_string(), message);
        }
    }

    #[test]
    fn parser_rejects_malformed_bytes_without_panic() {
        for text in [
            &b"\xff\xfe\0\0"[..],
            b"f",
            b"\\",
            b"v \xff 0 0",
            b"f 1/\xff/1 2 3",
            b"usemtl",
            b"mtllib",
            b"f -9223372036854775808 1 1",
        ] {
            assert!(ObjFile::parse(text, None).is_err());
        }
    }
}
