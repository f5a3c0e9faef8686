//! Parser of OBJ files.
//!
//! The `tobj` crate is not used because it renumbers vertices by first use. The rows of U follow the `v` lines of the
//! file. Renumbered vertices would get wrong rows, and no check would notice because the number of rows still matches.

use std::collections::{BTreeMap, HashMap};

use crate::error::{Error, Result, invalid};
use crate::load::polygons::{Corner, NO_INDEX, PolygonMesh, within_f32};
use crate::load::text::{lines, without_byte_order_mark};
use crate::load::values::{CorrectedValue, MISSING_COLOR};
use crate::memory::TemporaryReservation;

/// The largest number of material libraries of a file.
pub(super) const MAX_LIBRARIES: usize = 256;
/// The largest number of remarks on unsupported statements, one per key.
const MAX_REMARKS: usize = 16;

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
        for (index, line) in lines(without_byte_order_mark(bytes)?).enumerate() {
            // A backslash at the end of a line continues it on the next one, unless it ends a comment such as a path.
            if let Some(line_start) = line.strip_suffix(b"\\").filter(|line| !has_comment(line)) {
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
    /// The index and the last number of each vertex with seven numbers.
    seventh_numbers: Vec<(usize, f32)>,
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
            b"mtllib" => self.add_libraries(text_after_key(line)),
            // Groups and smoothing groups do not affect geometry: normals come from the file or are computed.
            b"o" | b"g" | b"s" => {}
            other => *self.unsupported_counts.entry(String::from_utf8_lossy(other).into_owned()).or_default() += 1,
        }
        Ok(())
    }

    /// Adds an `mtllib` statement unless an earlier one is equal, up to [`MAX_LIBRARIES`].
    fn add_libraries(&mut self, statement: String) {
        if self.obj.libraries.len() < MAX_LIBRARIES && !self.obj.libraries.contains(&statement) {
            self.obj.libraries.push(statement);
        }
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
            let polygons = &mut self.obj.polygons;
            let corrections = &mut polygons.corrections;
            let mut parse_index = |list: &str, count: usize| match fields.next() {
                None | Some(b"") => Ok(NO_INDEX),
                Some(digits) => {
                    let field = || format!("line {line}: f: {list}: index");
                    let given = String::from_utf8_lossy(digits);
                    let index = given.parse().map_err(|_| invalid(field(), "a whole number", &given))?;
                    let expected = || format!("1 to {count} or -{count} to -1");
                    match resolve_index(index, count) {
                        Some(index) => Ok(index),
                        None if list == "v" => Err(invalid(field(), expected(), given)),
                        None => {
                            let place = || CorrectedValue::new(format!("line {line}: f"), expected(), given);
                            corrections.add(&format!("index of {list}"), "the index is ignored", place);
                            Ok(NO_INDEX)
                        }
                    }
                }
            };
            let vertex = parse_index("v", polygons.positions.len())?;
            let uv = parse_index("vt", polygons.uvs.len())?;
            let normal = parse_index("vn", polygons.normals.len())?;
            if vertex == NO_INDEX || fields.next().is_some() {
                let given = String::from_utf8_lossy(word).into_owned();
                return Err(invalid(format!("line {line}: f"), "corners of the form v, v/vt, v//vn or v/vt/vn", given));
            }
            corners.push(Corner { vertex, uv, normal });
        }
        let material = self.current_material_index();
        self.obj.polygons.add_face(corners.iter().copied(), material, line)?;
        self.corners = corners;
        Ok(())
    }

    /// Adds a vertex: its position and, if three or more numbers follow, its color.
    fn add_vertex<'a>(&mut self, mut words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<()> {
        let position = parse_position(words.by_ref(), line)?;
        let polygons = &mut self.obj.polygons;
        polygons.positions.push(position);
        let color_words: Vec<&[u8]> = words.take(4).collect();
        // A single number is the weight of a rational curve.
        if color_words.len() >= 3 {
            let vertex = polygons.positions.len() - 1;
            let color = parse_vector(color_words[..3].iter().copied(), "v: color", line)?;
            polygons.colors.resize(vertex, MISSING_COLOR);
            polygons.colors.push(color);
            if let Some(word) = color_words.get(3) {
                let number = parse_number(word);
                let error = || number_error("v", "seven numbers", Some(*word), line);
                self.seventh_numbers.push((vertex, number.ok_or_else(error)?));
            }
        }
        Ok(())
    }

    /// Interprets seven numbers of a vertex as x y z w r g b if w is 1 everywhere, and otherwise as x y z r g b a.
    fn resolve_seventh_numbers(&mut self) {
        let Self { obj: ObjFile { polygons, .. }, seventh_numbers, .. } = self;
        if seventh_numbers.is_empty() {
            return;
        }
        let count = seventh_numbers.len();
        if seventh_numbers.iter().all(|(vertex, _)| polygons.colors[*vertex][0] == 1.0) {
            for (vertex, blue) in seventh_numbers {
                let [_, red, green] = polygons.colors[*vertex];
                polygons.colors[*vertex] = [red, green, *blue];
            }
            polygons
                .corrections
                .add_note(format!("{count} vertices have seven numbers, read as x y z w r g b: w is 1"));
        } else {
            let note = "read as x y z r g b a, because the fourth is not always 1: a is not used";
            polygons.corrections.add_note(format!("{count} vertices have seven numbers, {note}"));
        }
    }

    fn finish(mut self) -> Result<ObjFile> {
        self.resolve_seventh_numbers();
        let polygons = &mut self.obj.polygons;
        if !polygons.colors.is_empty() {
            polygons.colors.resize(polygons.positions.len(), MISSING_COLOR);
        }
        polygons.validate(|line| format!("line {line}: f"), 1)?;
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

fn has_comment(line: &[u8]) -> bool {
    line.split(u8::is_ascii_whitespace).any(|word| word.starts_with(b"#"))
}

/// The text after the first word: a name that may contain spaces.
pub(super) fn text_after_key(line: &[u8]) -> String {
    let text = String::from_utf8_lossy(line);
    text.trim()
        .split_once(|character: char| character.is_ascii_whitespace())
        .map_or("", |(_, remainder)| remainder.trim())
        .to_owned()
}

/// Parses a number, which may be infinite or not a number.
pub(super) fn parse_number(word: &[u8]) -> Option<f32> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

/// Parses the position of a vertex in f64. `line` is part of the error.
fn parse_position<'a>(mut words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<[f64; 3]> {
    let mut numbers = [0.0; 3];
    for number in &mut numbers {
        let word = words.next();
        let parse = |word: &[u8]| -> Option<f64> { std::str::from_utf8(word).ok()?.parse().ok() };
        *number = word.and_then(parse).map(within_f32).ok_or_else(|| number_error("v", "three numbers", word, line))?;
    }
    Ok(numbers)
}

/// Parses three numbers. `key` and `line` are part of the error.
fn parse_vector<'a>(mut words: impl Iterator<Item = &'a [u8]>, key: &str, line: usize) -> Result<[f32; 3]> {
    let mut numbers = [0.0; 3];
    for number in &mut numbers {
        let word = words.next();
        *number = word.and_then(parse_number).ok_or_else(|| number_error(key, "three numbers", word, line))?;
    }
    Ok(numbers)
}

fn parse_texture_coordinates<'a>(mut words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<[f32; 2]> {
    let (u, v) = (words.next(), words.next());
    let parse = |word: Option<&[u8]>| {
        word.and_then(parse_number).ok_or_else(|| number_error("vt", "one to three numbers", word, line))
    };
    Ok([parse(u)?, if v.is_some() { parse(v)? } else { 0.0 }])
}

fn number_error(key: &str, expected: &str, word: Option<&[u8]>, line: usize) -> Error {
    let given = word.map_or("the end of the line".into(), String::from_utf8_lossy);
    invalid(format!("line {line}: {key}"), expected, given)
}

/// Converts an index of the file to an index from 0. A positive index counts from 1, a negative one backwards from the
/// last of the `count` elements so far. `None` for an index that no element can have.
fn resolve_index(index: i64, count: usize) -> Option<u32> {
    let zero_based_index = if index < 0 { i64::try_from(count).ok()?.checked_add(index)? } else { index - 1 };
    u32::try_from(zero_based_index).ok().filter(|index| *index != NO_INDEX)
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
    fn backslash_at_the_end_of_a_comment_continues_nothing() {
        let faces = "v 1 0 0\nv 0 1 0\nf 1 2 3\n";
        for comment in ["# C:\\models\\", "g head # C:\\", "#\\"] {
            for line_end in ["\n", "\r\n", "\r"] {
                let text = format!("{comment}\nv 0 0 0\n{faces}").replace('\n', line_end);
                let obj = ObjFile::parse(text.as_bytes(), None).expect("a valid file");
                assert_eq!(obj.polygons.positions.len(), 3, "{text:?}");
            }
        }
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
            ("f 1 2 3/x", "line 4: f: vt: index: expected a whole number, got x"),
            ("f 1 2 3/1/1/1", "line 4: f: expected corners of the form v, v/vt, v//vn or v/vt/vn, got 3/1/1/1"),
            ("f 1 2 /1", "line 4: f: expected corners of the form v, v/vt, v//vn or v/vt/vn, got /1"),
            ("f 1 2", "faces: expected at least one face, got 1 points and lines"),
            ("v 1 nan 2\nf 1 2 4", "line 5: f: position of vertex 4: expected finite numbers, got [1.0, NaN, 2.0]"),
            ("v 1 1e39 2\nf 1 2 4", "line 5: f: position of vertex 4: expected finite numbers, got [1.0, inf, 2.0]"),
            ("v 1 x 2\nf 1 2 3", "line 4: v: expected three numbers, got x"),
            ("v 1 2\nf 1 2 3", "line 4: v: expected three numbers, got the end of the line"),
            ("v 1 2 3 0 x 0\nf 1 2 3", "line 4: v: color: expected three numbers, got x"),
            ("vt\nf 1 2 3", "line 4: vt: expected one to three numbers, got the end of the line"),
            ("vn 0 0 x\nf 1 2 3", "line 4: vn: expected three numbers, got x"),
            ("", "faces: expected at least one face, got 0"),
        ] {
            let text = format!("{TRIANGLE}{statement}\n");
            assert_eq!(ObjFile::parse(text.as_bytes(), None).expect_err(statement).to_string(), message);
        }
    }

    /// Values that do not matter, each with its remark.
    #[test]
    fn values_without_effect_are_remarks() {
        for (text, expected) in [
            (
                "f 1 2 3/1",
                "index of vt: expected no index in a file without vt, got 1 (line 4: f): the index is ignored",
            ),
            (
                "f 1//1 2//2 3//7",
                "index of vn: expected no index in a file without vn, got 1 (line 4: f): the index is ignored (3 times)",
            ),
            ("f 1 2 3/-1", "index of vt: expected 1 to 0 or -0 to -1, got -1 (line 4: f): the index is ignored"),
            ("f 1 2 3/0", "index of vt: expected 1 to 0 or -0 to -1, got 0 (line 4: f): the index is ignored"),
            (
                "vn nan 0 1\nf 1//1 2//1 3//1",
                "normal: expected finite numbers, got [NaN, 0.0, 1.0] (element 1): the normal is computed",
            ),
            (
                "vt 0 inf\nf 1/1 2/1 3/1",
                "texture coordinates: expected finite numbers, got [0.0, -inf] (element 1): (0, 0) is used",
            ),
            (
                "v 0 -nan 0\nf 1 2 3",
                "position: expected finite numbers, got [0.0, NaN, 0.0] (vertex 4): no face uses the vertex",
            ),
            ("f 1 2\nf 1 2 3\nf 3", "faces: expected at least 3 corners, got 2 points and lines: they are not drawn"),
            (
                "v 1 2 3 0 -1 0\nf 1 2 3",
                "color of a vertex: expected 0 to 1, got [0.0, -1.0, 0.0] (vertex 4): the channels are clamped",
            ),
        ] {
            let text = format!("{TRIANGLE}{text}\n");
            let polygons = ObjFile::parse(text.as_bytes(), None).expect(&text).polygons;
            assert_eq!(polygons.corrections.remarks(false), Ok(vec![expected.to_owned()]));
            assert!(polygons.corrections.remarks(true).is_err(), "{text}: expected an error in strict mode");
            assert!(polygons.positions.as_flattened().iter().all(|number| number.is_finite()));
        }
    }

    #[test]
    fn seven_numbers_have_a_weight_if_it_is_1_everywhere() {
        let colors = |vertices: &str| {
            let polygons = ObjFile::parse(format!("{vertices}f 1 2 3\n").as_bytes(), None).expect("a file").polygons;
            (polygons.colors[0], polygons.corrections.remarks(true).expect("no correction").remove(0))
        };
        let (color, note) = colors("v 0 0 0 1 0.5 0.25 0\nv 1 0 0 1.0 1 0 0\nv 0 1 0\n");
        assert_eq!(
            (color, note.as_str()),
            ([0.5, 0.25, 0.0], "2 vertices have seven numbers, read as x y z w r g b: w is 1")
        );
        let (color, note) = colors("v 0 0 0 1 0.5 0.25 0\nv 1 0 0 0.5 1 0 0\nv 0 1 0\n");
        assert_eq!(color, [1.0, 0.5, 0.25]);
        assert!(note.starts_with("2 vertices have seven numbers, read as x y z r g b a, because the fourth"), "{note}");
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
