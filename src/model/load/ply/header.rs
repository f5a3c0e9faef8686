//! The header of a PLY file, checked against the size of the file before any element is read.

use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{DefaultElement, ElementDef, Encoding, KeyMap, PropertyType, ScalarType};

use super::reader::quote;
use crate::error::{Result, invalid};
use crate::load::text::without_byte_order_mark;

/// The largest length of a header in bytes.
const MAX_HEADER_BYTES: usize = 64 << 10;
/// The largest number of names in a remark.
const MAX_LISTED_NAMES: usize = 8;

/// The properties that are read, of vertices and faces.
const VERTEX_PROPERTIES: [&str; 16] =
    ["x", "y", "z", "nx", "ny", "nz", "s", "t", "u", "v", "texture_u", "texture_v", "red", "green", "blue", "alpha"];
const FACE_PROPERTIES: [&str; 8] =
    ["vertex_indices", "vertex_index", "texcoord", "texnumber", "red", "green", "blue", "alpha"];

/// A valid header.
#[derive(Debug)]
pub(super) struct PlyHeader {
    pub(super) encoding: Encoding,
    pub(super) elements: KeyMap<ElementDef>,
    comments: Vec<String>,
}

impl PlyHeader {
    /// Parses the header. Returns it and the bytes after it.
    ///
    /// # Errors
    /// `Invalid` if the header is malformed or too long, lacks the position or the faces, names a property twice, or
    /// declares more elements than the file can contain.
    pub(super) fn parse(bytes: &[u8]) -> Result<(Self, &[u8])> {
        let Some((text, body)) = split_header(without_byte_order_mark(bytes)?) else {
            let expected = format!("ply, and end_header within {MAX_HEADER_BYTES} bytes");
            return Err(invalid("header", expected, format!("{} bytes without them", bytes.len())));
        };
        check_keywords(&text)?;
        let header = Parser::<DefaultElement>::new().read_header(&mut Reader::new(text.as_bytes()));
        let header = header.map_err(|error| invalid("header", "a PLY header", quote(error.to_string().as_bytes())))?;
        check_repetitions(text.as_bytes(), &header.elements)?;
        let header = Self { encoding: header.encoding, elements: header.elements, comments: header.comments };
        header.check_elements(body.len())?;
        Ok((header, body))
    }

    /// The images that comments `TextureFile` name, in any case, in their order.
    pub(super) fn texture_files(&self) -> Vec<String> {
        let name = |comment: &String| {
            let (key, name) = comment.trim().split_once(' ')?;
            let is_image = key.eq_ignore_ascii_case("TextureFile") && !name.trim().is_empty();
            is_image.then(|| name.trim().to_owned())
        };
        self.comments.iter().filter_map(name).collect()
    }

    /// Names the properties and elements that are not used.
    pub(super) fn remarks(&self) -> Vec<String> {
        let mut unused: Vec<String> = Vec::new();
        for (element, definition) in &self.elements {
            let used: &[&str] = match element.as_str() {
                "vertex" => &VERTEX_PROPERTIES,
                "face" => &FACE_PROPERTIES,
                _ => {
                    unused.push(format!("element {element}"));
                    continue;
                }
            };
            let names = definition.properties.keys().filter(|name| !used.contains(&name.as_str()));
            unused.extend(names.map(|name| format!("{element}.{name}")));
        }
        match unused.len() {
            0 => Vec::new(),
            count => {
                unused.truncate(MAX_LISTED_NAMES);
                let more = if count > unused.len() { " and others" } else { "" };
                vec![format!("properties that are not used: {}{more}", unused.join(", "))]
            }
        }
    }

    fn check_elements(&self, body_bytes: usize) -> Result<()> {
        let properties_of = |name: &str| self.elements.get(name).map(|element| &element.properties);
        let vertex = properties_of("vertex").ok_or_else(|| invalid("header", "the element vertex", "none"))?;
        if let Some(axis) = ["x", "y", "z"].into_iter().find(|axis| !vertex.contains_key(*axis)) {
            return Err(invalid("element vertex", "the properties x, y and z", format!("none named {axis}")));
        }
        if self.elements.contains_key("tristrips") {
            return Err(invalid("element tristrips", "faces with vertex_indices", "triangle strips"));
        }
        let order: Vec<&str> = self.elements.keys().map(String::as_str).collect();
        let place = |name: &str| order.iter().position(|other| *other == name);
        if place("face").is_some_and(|face| place("vertex").is_none_or(|vertex| face < vertex)) {
            return Err(invalid("header", "the element vertex before the element face", order.join(", ")));
        }
        let mut least_bytes: usize = 0;
        for element in self.elements.values() {
            let element_bytes = match self.encoding {
                // A line has at least a digit. The line break of the last line may be missing.
                Encoding::Ascii => 1,
                _ => element.properties.values().map(|property| least_size(&property.data_type)).sum(),
            };
            if element_bytes == 0 && element.count > 0 {
                return Err(invalid(format!("element {}", element.name), "properties", "none"));
            }
            least_bytes = least_bytes.saturating_add(element_bytes.saturating_mul(element.count));
            if least_bytes > body_bytes {
                let expected = format!("elements of at least {element_bytes} bytes that fit in {body_bytes} bytes");
                return Err(invalid(format!("element {}", element.name), expected, element.count));
            }
        }
        Ok(())
    }
}

/// Splits a file after its header. Returns the header as text with one blank between words and `\n` at the end of lines, and
/// the bytes after it. Lines can end with `\n`, `\r\n` or `\r`. Comments that are not UTF-8 are read as Latin-1.
fn split_header(bytes: &[u8]) -> Option<(String, &[u8])> {
    let (mut text, mut rest) = (String::new(), &bytes[..bytes.len().min(MAX_HEADER_BYTES)]);
    let mut has_cr_lf = false;
    loop {
        let length = rest.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
        let (line, line_end) = rest.split_at(length.unwrap_or(rest.len()));
        let decoded = std::str::from_utf8(line)
            .map_or_else(|_| line.iter().map(|byte| char::from(*byte)).collect(), str::to_owned);
        let is_comment = decoded.trim_start().starts_with("comment");
        let words = decoded.splitn(if is_comment { 2 } else { usize::MAX }, [' ', '\t']);
        let words = words.map(str::trim).filter(|word| !word.is_empty());
        let mut line = words.collect::<Vec<_>>().join(" ");
        if text.is_empty() {
            has_cr_lf = line_end.starts_with(b"\r\n");
            if !line.eq_ignore_ascii_case("ply") {
                return None;
            }
            line.make_ascii_lowercase();
        }
        text.push_str(&line);
        text.push('\n');
        // After a lone `\r`, a `\n` can be the first byte of the data.
        let line_end_length = if has_cr_lf && line_end.starts_with(b"\r\n") { 2 } else { line_end.len().min(1) };
        rest = &line_end[line_end_length..];
        if line == "end_header" {
            return Some((text, &bytes[bytes.len().min(MAX_HEADER_BYTES) - rest.len()..]));
        }
        length?;
    }
}

/// Rejects lines that are no statements. The parser would reject them with its debug text.
fn check_keywords(header: &str) -> Result<()> {
    const KEYWORDS: [&str; 7] = ["ply", "format", "comment", "obj_info", "element", "property", "end_header"];
    let is_statement = |line: &str| line.is_empty() || KEYWORDS.contains(&line.split(' ').next().unwrap_or_default());
    match header.lines().enumerate().find(|(_, line)| !is_statement(line)) {
        None => Ok(()),
        Some((index, line)) => Err(invalid(
            format!("header: line {}", index + 1),
            "format, comment, obj_info, element, property or end_header",
            quote(line.as_bytes()),
        )),
    }
}

/// Rejects elements and properties that are defined twice, because the parser keeps only the last definition, and a
/// binary file would be read at wrong places.
fn check_repetitions(header: &[u8], elements: &KeyMap<ElementDef>) -> Result<()> {
    let count_lines = |key: &[u8]| header.split(|byte| *byte == b'\n').filter(|line| line.starts_with(key)).count();
    let properties: usize = elements.values().map(|element| element.properties.len()).sum();
    for (key, defined, kept) in
        [("element", count_lines(b"element "), elements.len()), ("property", count_lines(b"property "), properties)]
    {
        if defined != kept {
            return Err(invalid(
                "header",
                format!("a different name in each {key} line"),
                format!("{defined} lines with {kept} different names"),
            ));
        }
    }
    Ok(())
}

/// The smallest size of a property in a binary file.
const fn least_size(data_type: &PropertyType) -> usize {
    match data_type {
        PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => match scalar {
            ScalarType::Char | ScalarType::UChar => 1,
            ScalarType::Short | ScalarType::UShort => 2,
            ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
            ScalarType::Double => 8,
        },
    }
}
