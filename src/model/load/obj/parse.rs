//! Parser of OBJ files: lists and polygons with validated indices from 0.
//!
//! The `tobj` crate is not used because it renumbers vertices by first use. The rows of U follow the `v` lines of the
//! file: after renumbering they would be wrong without any error, as their number would still match.

use std::collections::{BTreeMap, HashMap};

use crate::error::{Error, Result, invalid};

/// Marks a missing texture coordinate or normal of a corner.
pub(in crate::load) const NO_INDEX: u32 = u32::MAX;

/// One corner of a polygon, as indices into the lists of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(in crate::load) struct Corner {
    pub(in crate::load) v: u32,
    pub(in crate::load) vt: u32,
    pub(in crate::load) vn: u32,
}

/// One polygon: its corners, its material and its line in the file.
#[derive(Debug, Clone, Copy)]
pub(in crate::load) struct Face {
    first: usize,
    count: usize,
    /// Index into [`ObjFile::materials`].
    pub(in crate::load) material: usize,
    line: usize,
}

/// The contents of an OBJ file. Texture coordinates have (0, 0) at the top left.
#[derive(Debug, Default)]
pub(in crate::load) struct ObjFile {
    pub(in crate::load) positions: Vec<[f32; 3]>,
    pub(in crate::load) uvs: Vec<[f32; 2]>,
    pub(in crate::load) normals: Vec<[f32; 3]>,
    pub(in crate::load) faces: Vec<Face>,
    corners: Vec<Corner>,
    /// Material names of `usemtl` in order of first use. Faces before any `usemtl` have an empty name.
    pub(in crate::load) materials: Vec<String>,
    /// The arguments of each `mtllib`.
    pub(in crate::load) libraries: Vec<String>,
    /// Messages about statements that are not supported.
    pub(in crate::load) remarks: Vec<String>,
}

impl ObjFile {
    /// Parses a whole file.
    ///
    /// # Errors
    /// `Invalid` with the line and the statement.
    pub(in crate::load) fn parse(bytes: &[u8]) -> Result<Self> {
        let mut parser = Parser::default();
        let mut joined = Vec::new();
        for (index, line) in bytes.split(|byte| *byte == b'\n').enumerate() {
            let line = line.strip_suffix(b"\r").unwrap_or(line);
            // A backslash at the end of a line continues it on the next one.
            if let Some(head) = line.strip_suffix(b"\\") {
                joined.extend_from_slice(head);
                joined.push(b' ');
                continue;
            }
            let number = index + 1;
            if joined.is_empty() {
                parser.line(line, number)?;
            } else {
                joined.extend_from_slice(line);
                parser.line(&std::mem::take(&mut joined), number)?;
            }
        }
        parser.finish()
    }

    /// The corners of a polygon.
    pub(in crate::load) fn corners_of(&self, face: usize) -> &[Corner] {
        let face = &self.faces[face];
        &self.corners[face.first..][..face.count]
    }

    fn check(&self) -> Result<()> {
        if self.faces.is_empty() {
            return Err(invalid("f", "at least one face", 0));
        }
        for (index, face) in self.faces.iter().enumerate() {
            for corner in self.corners_of(index) {
                below(face.line, "v", corner.v, self.positions.len())?;
                if corner.vt != NO_INDEX {
                    below(face.line, "vt", corner.vt, self.uvs.len())?;
                }
                if corner.vn != NO_INDEX {
                    below(face.line, "vn", corner.vn, self.normals.len())?;
                }
            }
        }
        Ok(())
    }
}

fn below(line: usize, list: &str, index: u32, count: usize) -> Result<()> {
    if (index as usize) < count {
        return Ok(());
    }
    Err(invalid(format!("line {line}: f: index of {list}"), format!("1 to {count}"), u64::from(index) + 1))
}

#[derive(Default)]
struct Parser {
    obj: ObjFile,
    /// The name of the last `usemtl`, and its index in [`ObjFile::materials`] once a face uses it.
    current_material: String,
    material: Option<usize>,
    by_name: HashMap<String, usize>,
    ignored: BTreeMap<String, usize>,
}

impl Parser {
    fn line(&mut self, line: &[u8], number: usize) -> Result<()> {
        let mut words = words(line);
        let Some(key) = words.next() else { return Ok(()) };
        match key {
            b"v" => self.obj.positions.push(numbers(words, "v", number)?),
            b"vn" => self.obj.normals.push(numbers(words, "vn", number)?),
            b"vt" => {
                let [u, v] = texture_coordinates(words, number)?;
                // The file measures v from the bottom of the image, meshes from the top.
                self.obj.uvs.push([u, 1.0 - v]);
            }
            b"f" => self.face(words, number)?,
            b"usemtl" => (self.current_material, self.material) = (rest_of(line), None),
            b"mtllib" => self.obj.libraries.push(rest_of(line)),
            // Groups and smoothing groups do not affect geometry: normals come from the file or are computed.
            b"o" | b"g" | b"s" => {}
            other => *self.ignored.entry(String::from_utf8_lossy(other).into_owned()).or_default() += 1,
        }
        Ok(())
    }

    /// The index of the current material, assigned at the first face that uses it.
    fn number(&mut self) -> usize {
        let list = &mut self.obj.materials;
        let made = || {
            list.push(self.current_material.clone());
            list.len() - 1
        };
        match self.material {
            Some(known) => known,
            None => *self.material.insert(*self.by_name.entry(self.current_material.clone()).or_insert_with(made)),
        }
    }

    fn face<'a>(&mut self, words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<()> {
        let first = self.obj.corners.len();
        for word in words {
            let mut parts = word.split(|byte| *byte == b'/');
            let mut index = |list: &str, count: usize| match parts.next() {
                None | Some(b"") => Ok(NO_INDEX),
                Some(digits) => {
                    resolve(digits, count).map_err(|error| error.prefix_field(&format!("line {line}: f: {list}")))
                }
            };
            let v = index("v", self.obj.positions.len())?;
            let vt = index("vt", self.obj.uvs.len())?;
            let vn = index("vn", self.obj.normals.len())?;
            if v == NO_INDEX || parts.next().is_some() {
                let given = String::from_utf8_lossy(word).into_owned();
                return Err(invalid(format!("line {line}: f"), "corners of the form v, v/vt, v//vn or v/vt/vn", given));
            }
            self.obj.corners.push(Corner { v, vt, vn });
        }
        let count = self.obj.corners.len() - first;
        if count < 3 {
            return Err(invalid(format!("line {line}: f"), "at least 3 corners", count));
        }
        let material = self.number();
        self.obj.faces.push(Face { first, count, material, line });
        Ok(())
    }

    fn finish(mut self) -> Result<ObjFile> {
        self.obj.check()?;
        let remark = |(key, count): (&String, &usize)| format!("{count} statements '{key}' are not used");
        self.obj.remarks.extend(self.ignored.iter().take(16).map(remark));
        Ok(self.obj)
    }
}

/// Words of a line up to a comment.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    let words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    words.take_while(|word| !word.starts_with(b"#"))
}

/// The text after the first word: a name that may contain spaces.
pub(super) fn rest_of(line: &[u8]) -> String {
    let text = String::from_utf8_lossy(line);
    text.trim().split_once(|letter: char| letter.is_ascii_whitespace()).map_or("", |(_, rest)| rest.trim()).to_owned()
}

/// Parses a finite number.
pub(super) fn number(word: &[u8]) -> Option<f32> {
    std::str::from_utf8(word).ok()?.parse().ok().filter(|number: &f32| number.is_finite())
}

fn numbers<'a>(mut words: impl Iterator<Item = &'a [u8]>, key: &str, line: usize) -> Result<[f32; 3]> {
    let mut found = [0.0; 3];
    for slot in &mut found {
        let word = words.next();
        *slot = word.and_then(number).ok_or_else(|| unreadable(key, "three finite numbers", word, line))?;
    }
    Ok(found)
}

fn texture_coordinates<'a>(mut words: impl Iterator<Item = &'a [u8]>, line: usize) -> Result<[f32; 2]> {
    let (u, v) = (words.next(), words.next());
    let read = |word: Option<&[u8]>| {
        word.and_then(number).ok_or_else(|| unreadable("vt", "one to three finite numbers", word, line))
    };
    Ok([read(u)?, if v.is_some() { read(v)? } else { 0.0 }])
}

fn unreadable(key: &str, expected: &str, word: Option<&[u8]>, line: usize) -> Error {
    let given = word.map_or("the end of the line".into(), String::from_utf8_lossy);
    invalid(format!("line {line}: {key}"), expected, given)
}

/// Converts an index that counts from 1, or backwards from the end if negative, to an index from 0.
fn resolve(digits: &[u8], count: usize) -> Result<u32> {
    let text = String::from_utf8_lossy(digits);
    let refuse = |expected: String| invalid("index", expected, &text);
    let index: i64 = text.parse().map_err(|_| refuse("a whole number".into()))?;
    let from_zero =
        if index < 0 { i64::try_from(count).ok().and_then(|count| count.checked_add(index)) } else { Some(index - 1) };
    let in_range = from_zero.and_then(|index| u32::try_from(index).ok()).filter(|index| *index != NO_INDEX);
    in_range.ok_or_else(|| refuse(format!("1 to {count} or -{count} to -1")))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

    #[test]
    fn negative_indices_count_back_from_the_last_line_so_far() {
        let text = format!("{TRIANGLE}vt 0.25 0.25\nvn 0 0 1\nf -3/-1/-1 -2/-1/-1 -1/-1/-1\nv 9 9 9\n");
        let obj = ObjFile::parse(text.as_bytes()).expect("good");
        let found: Vec<_> = obj.corners_of(0).iter().map(|corner| (corner.v, corner.vt, corner.vn)).collect();
        assert_eq!(found, [(0, 0, 0), (1, 0, 0), (2, 0, 0)]);
        assert_eq!(obj.uvs, [[0.25, 0.75]], "v is flipped");
        assert_eq!(obj.positions.len(), 4, "an unreferenced vertex stays");
    }

    #[test]
    fn comments_line_ends_continuations_and_names_with_blanks_are_read() {
        let text = "# head\r\nmtllib my file.mtl\r\nv 0 0 0 # first\r\nv 1 \\\r\n 0 0\r\nv 0 1 0 1 0 0\r\n\
                    usemtl dark bark\r\nf 1 2 \\\n 3\r\nl 1 2\r\nusemtl none\nusemtl light\nf 3 2 1 # back\n";
        let obj = ObjFile::parse(text.as_bytes()).expect("good");
        assert_eq!(obj.libraries, ["my file.mtl"]);
        assert_eq!(obj.materials, ["dark bark", "light"]);
        assert_eq!(obj.positions, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        assert_eq!((obj.faces[0].material, obj.faces[1].material), (0, 1));
        assert_eq!(obj.remarks, ["1 statements 'l' are not used"]);
    }

    #[test]
    fn bad_statements_are_refused_with_their_line() {
        for (statement, refusal) in [
            ("f 1 2 4", "line 4: f: index of v: expected 1 to 3, got 4"),
            ("f 1 2 0", "line 4: f: v: index: expected 1 to 3 or -3 to -1, got 0"),
            ("f 1 2 -4", "line 4: f: v: index: expected 1 to 3 or -3 to -1, got -4"),
            ("f 1 2 4294967296", "line 4: f: v: index: expected 1 to 3 or -3 to -1, got 4294967296"),
            ("f 1 2 2147483648", "line 4: f: index of v: expected 1 to 3, got 2147483648"),
            ("f 1 2 99999999999999999999", "line 4: f: v: index: expected a whole number, got 99999999999999999999"),
            ("f 1 2 3/1", "line 4: f: index of vt: expected 1 to 0, got 1"),
            ("f 1 2 3//7", "line 4: f: index of vn: expected 1 to 0, got 7"),
            ("f 1 2 3/1/1/1", "line 4: f: expected corners of the form v, v/vt, v//vn or v/vt/vn, got 3/1/1/1"),
            ("f 1 2 /1", "line 4: f: expected corners of the form v, v/vt, v//vn or v/vt/vn, got /1"),
            ("f 1 2", "line 4: f: expected at least 3 corners, got 2"),
            ("v 1 nan 2\nf 1 2 3", "line 4: v: expected three finite numbers, got nan"),
            ("v 1 1e39 2\nf 1 2 3", "line 4: v: expected three finite numbers, got 1e39"),
            ("v 1 2\nf 1 2 3", "line 4: v: expected three finite numbers, got the end of the line"),
            ("vt\nf 1 2 3", "line 4: vt: expected one to three finite numbers, got the end of the line"),
            ("vn 0 0 x\nf 1 2 3", "line 4: vn: expected three finite numbers, got x"),
            ("", "f: expected at least one face, got 0"),
        ] {
            let text = format!("{TRIANGLE}{statement}\n");
            assert_eq!(ObjFile::parse(text.as_bytes()).expect_err(statement).to_string(), refusal);
        }
    }

    #[test]
    fn no_bytes_make_the_parser_panic() {
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
            assert!(ObjFile::parse(text).is_err());
        }
    }
}
