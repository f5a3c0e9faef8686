//! Reads VTK's XML files of unstructured grids (`.vtu`): text, base64 and appended data, with and without zlib. Format:
//! "VTK file formats", section "XML file formats".

use std::io::Read as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use flate2::read::ZlibDecoder;
use modalcast_model::error::{Result, invalid};
use roxmltree::{Document, Node};

use crate::cell_collector::CellCollector;
use crate::file_cursor::{Encoding, NumberType, Numbers};
use crate::vtk_cells::VtkCells;

/// Limit on an array, which a small compressed file could exceed.
const MAX_ARRAY_BYTES: u64 = 4 << 30;

/// Reads the cells of a file.
///
/// # Errors
/// `Invalid` with the array for wrong content, and for data that are no unstructured grid.
pub fn read(bytes: &[u8]) -> Result<CellCollector> {
    let (xml, appended) = split_appended_data(bytes)?;
    let document = Document::parse(&xml).map_err(|error| invalid("XML", "a VTKFile", error))?;
    let root = document.root_element();
    let unknown =
        || invalid("XML", "a VTKFile of the type UnstructuredGrid", root.attribute("type").unwrap_or("another"));
    if root.tag_name().name() != "VTKFile" || root.attribute("type") != Some("UnstructuredGrid") {
        return Err(unknown());
    }
    let file = VtuFile {
        encoding: match root.attribute("byte_order") {
            Some("BigEndian") => Encoding::BigEndian,
            _ => Encoding::LittleEndian,
        },
        header_bytes: if root.attribute("header_type") == Some("UInt64") { 8 } else { 4 },
        is_compressed: match root.attribute("compressor") {
            None => false,
            Some("vtkZLibDataCompressor") => true,
            Some(other) => {
                let expected = "no compression or vtkZLibDataCompressor (`python3 -c 'import pyvista, sys; \
                                pyvista.read(sys.argv[1]).save(sys.argv[2])' OLD.vtu NEW.vtu` after `pip install pyvista`)";
                return Err(invalid("compressor", expected, other));
            }
        },
        appended,
    };
    let grid = child(root, "UnstructuredGrid").ok_or_else(unknown)?;
    let mut cells = CellCollector::default();
    for piece in grid.children().filter(|node| node.has_tag_name("Piece")) {
        file.read_piece(piece)?.add_to(&mut cells)?;
    }
    Ok(cells)
}

/// Data after the XML part.
enum Appended<'a> {
    Raw(&'a [u8]),
    Base64(Vec<u8>),
}

/// Separates appended data, which may be no text, from the rest of the file.
fn split_appended_data(bytes: &[u8]) -> Result<(String, Appended<'_>)> {
    const TAG: &[u8] = b"<AppendedData";
    let text = |bytes: &[u8]| {
        let text = std::str::from_utf8(bytes).map_err(|error| invalid("XML", "text in UTF-8", error))?;
        Ok(text.trim_start_matches('\u{feff}').to_owned())
    };
    let Some(start) = bytes.windows(TAG.len()).position(|window| window == TAG) else {
        return Ok((text(bytes)?, Appended::Raw(&[])));
    };
    let rest = &bytes[start..];
    let mark =
        rest.iter().position(|byte| *byte == b'_').ok_or_else(|| invalid("AppendedData", "the sign _", "none"))?;
    let (tag, data) = (&rest[..mark], &rest[mark + 1..]);
    let is_base64 = String::from_utf8_lossy(tag).contains("base64");
    let appended = match is_base64 {
        true => Appended::Base64(data.iter().copied().filter(|byte| !byte.is_ascii_whitespace()).collect()),
        false => Appended::Raw(data),
    };
    Ok((format!("{}</VTKFile>", text(&bytes[..start])?), appended))
}

fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|node| node.has_tag_name(name))
}

/// Attributes of the file, and its appended data.
struct VtuFile<'a> {
    encoding: Encoding,
    /// The size of the numbers before binary data.
    header_bytes: usize,
    is_compressed: bool,
    appended: Appended<'a>,
}

impl VtuFile<'_> {
    fn read_piece(&self, piece: Node<'_, '_>) -> Result<VtkCells> {
        let missing = |name: &str| invalid("Piece", format!("an array {name}"), "none");
        let section = |name: &'static str| {
            let node = piece.children().find(|node| node.has_tag_name(name));
            node.into_iter().flat_map(|node| node.children()).filter(|node| node.has_tag_name("DataArray"))
        };
        let points = section("Points").next().ok_or_else(|| missing("of points"))?;
        let cell_array = |name: &str| {
            let array = section("Cells").find(|array| array.attribute("Name") == Some(name));
            self.read_array(array.ok_or_else(|| missing(name))?)?.into_integers(name)
        };
        let mut grid = VtkCells {
            points: self.read_array(points)?.into_floats(),
            connectivity: cell_array("connectivity")?,
            ends: cell_array("offsets")?,
            types: cell_array("types")?,
            cell_data: Vec::new(),
        };
        for array in section("CellData") {
            let components = array.attribute("NumberOfComponents").unwrap_or("1");
            let is_integer = array.attribute("type").is_some_and(|name| name.contains("Int"));
            if let (Some(name), "1" | "", true) = (array.attribute("Name"), components, is_integer) {
                grid.cell_data.push((name.to_owned(), self.read_array(array)?.into_integers(name)?));
            }
        }
        Ok(grid)
    }

    fn read_array(&self, array: Node<'_, '_>) -> Result<Numbers> {
        let name = array.attribute("Name").unwrap_or("Points");
        self.array_numbers(array).map_err(|error| error.prefix_field(&format!("DataArray '{name}'")))
    }

    fn array_numbers(&self, array: Node<'_, '_>) -> Result<Numbers> {
        let number_type = match array.attribute("type").unwrap_or_default() {
            "Int8" => NumberType::Signed { bytes: 1 },
            "Int16" => NumberType::Signed { bytes: 2 },
            "Int32" => NumberType::Signed { bytes: 4 },
            "Int64" => NumberType::Signed { bytes: 8 },
            "UInt8" => NumberType::Unsigned { bytes: 1 },
            "UInt16" => NumberType::Unsigned { bytes: 2 },
            "UInt32" => NumberType::Unsigned { bytes: 4 },
            "UInt64" => NumberType::Unsigned { bytes: 8 },
            "Float32" => NumberType::Float { bytes: 4 },
            "Float64" => NumberType::Float { bytes: 8 },
            other => return Err(invalid("type", "Int8 to UInt64, Float32 or Float64", format!("'{other}'"))),
        };
        let text = array.text().unwrap_or_default();
        let data = match array.attribute("format").unwrap_or("ascii") {
            "ascii" => return number_type.parse(text.split_ascii_whitespace()),
            "binary" => {
                let letters: Vec<u8> = text.bytes().filter(|byte| !byte.is_ascii_whitespace()).collect();
                self.decode(&mut Base64Bytes::new(&letters))?
            }
            "appended" => {
                let offset: usize =
                    array.attribute("offset").and_then(|offset| offset.trim().parse().ok()).unwrap_or(usize::MAX);
                let outside =
                    || invalid("offset", "a place in the appended data", array.attribute("offset").unwrap_or("none"));
                match &self.appended {
                    Appended::Raw(bytes) => self.decode(&mut bytes.get(offset..).ok_or_else(outside)?)?,
                    Appended::Base64(letters) => {
                        self.decode(&mut Base64Bytes::new(letters.get(offset..).ok_or_else(outside)?))?
                    }
                }
            }
            other => return Err(invalid("format", "ascii, binary or appended", other)),
        };
        Ok(number_type.decode(&data, self.encoding))
    }

    /// Reads an array: its length and its bytes or, if compressed, the number of blocks, the size of a block and of the last
    /// one, the compressed size of each block, and the blocks.
    fn decode(&self, source: &mut impl ByteSource) -> Result<Vec<u8>> {
        let header_type = NumberType::Unsigned { bytes: self.header_bytes };
        let header = |count: usize, source: &mut dyn ByteSource| -> Result<Vec<u64>> {
            let bytes = source.take(count.saturating_mul(self.header_bytes))?;
            let numbers = header_type.decode(&bytes, self.encoding).into_integers("header")?;
            Ok(numbers.into_iter().map(|number| number as u64).collect())
        };
        if !self.is_compressed {
            let length = header(1, source)?[0];
            return source.take(usize::try_from(length).unwrap_or(usize::MAX));
        }
        let blocks = header(1, source)?[0];
        let sizes = header(2, source)?;
        let compressed_sizes = header(usize::try_from(blocks).unwrap_or(usize::MAX), source)?;
        source.finish_header();
        let limit = sizes[0].max(sizes[1]).saturating_mul(blocks.max(1));
        if limit > MAX_ARRAY_BYTES {
            return Err(invalid("size", format!("at most {MAX_ARRAY_BYTES} bytes"), limit));
        }
        let mut data = Vec::new();
        for size in compressed_sizes {
            let block = source.take(usize::try_from(size).unwrap_or(usize::MAX))?;
            let block_limit = limit.saturating_sub(data.len() as u64);
            let decoder = ZlibDecoder::new(&block[..]);
            decoder.take(block_limit).read_to_end(&mut data).map_err(|error| invalid("data", "zlib", error))?;
        }
        Ok(data)
    }
}

/// Bytes in the order of the file.
trait ByteSource {
    /// The next bytes.
    ///
    /// # Errors
    /// `Invalid` if there are fewer.
    fn take(&mut self, count: usize) -> Result<Vec<u8>>;

    /// Skips to the data of a compressed array, whose header is encoded separately.
    fn finish_header(&mut self) {}
}

fn too_few(count: usize) -> modalcast_model::error::Error {
    invalid("data", format!("{count} bytes"), "fewer")
}

impl ByteSource for &[u8] {
    fn take(&mut self, count: usize) -> Result<Vec<u8>> {
        let (taken, rest) = self.split_at_checked(count).ok_or_else(|| too_few(count))?;
        *self = rest;
        Ok(taken.to_vec())
    }
}

/// The bytes that base64 letters encode. Some writers encode a header and its data together, others separately, so that
/// padding may occur in the middle.
struct Base64Bytes<'a> {
    letters: &'a [u8],
    /// Decoded bytes that were not taken yet.
    pending: Vec<u8>,
}

impl<'a> Base64Bytes<'a> {
    const fn new(letters: &'a [u8]) -> Self {
        Self { letters, pending: Vec::new() }
    }
}

impl ByteSource for Base64Bytes<'_> {
    fn take(&mut self, count: usize) -> Result<Vec<u8>> {
        while self.pending.len() < count {
            // Whole quanta of four letters, up to the next padding.
            let padding = self.letters.iter().position(|letter| *letter == b'=').unwrap_or(self.letters.len());
            let wanted = (count - self.pending.len()).div_ceil(3).saturating_mul(4);
            let length = wanted.min(padding.div_ceil(4) * 4).min(self.letters.len());
            if length == 0 {
                return Err(too_few(count));
            }
            let (quanta, rest) = self.letters.split_at(length);
            STANDARD.decode_vec(quanta, &mut self.pending).map_err(|error| invalid("data", "base64", error))?;
            self.letters = rest;
        }
        let rest = self.pending.split_off(count);
        Ok(std::mem::replace(&mut self.pending, rest))
    }

    fn finish_header(&mut self) {
        self.pending.clear();
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use flate2::Compression;
    use flate2::write::ZlibEncoder;

    use super::*;
    use crate::volume_mesh::VolumeCells;

    /// How the arrays of a file are stored.
    #[derive(Debug, Clone, Copy)]
    struct Style {
        /// `ascii`, `binary`, or the encoding of appended data: `raw` or `base64`.
        format: &'static str,
        is_compressed: bool,
        header_bytes: usize,
        is_big_endian: bool,
        /// Whether the header is encoded separately from uncompressed data.
        has_separate_header: bool,
    }

    const PLAIN: Style = Style {
        format: "ascii",
        is_compressed: false,
        header_bytes: 4,
        is_big_endian: false,
        has_separate_header: false,
    };

    /// Numbers of a type with 4 or 8 bytes.
    fn encode(words: &str, type_name: &str, style: Style) -> Vec<u8> {
        let little_endian = words.split(' ').flat_map(|word| {
            let mut bytes = match type_name {
                "Float64" => word.parse::<f64>().expect("a number").to_le_bytes().to_vec(),
                "Int64" => word.parse::<i64>().expect("a number").to_le_bytes().to_vec(),
                _ => word.parse::<i32>().expect("a number").to_le_bytes().to_vec(),
            };
            if style.is_big_endian {
                bytes.reverse();
            }
            bytes
        });
        little_endian.collect()
    }

    /// The header and the data of an array.
    fn packed(data: &[u8], style: Style) -> [Vec<u8>; 2] {
        let header = |numbers: &[usize]| {
            let number = |number: &usize| {
                let mut bytes = number.to_le_bytes()[..style.header_bytes].to_vec();
                if style.is_big_endian {
                    bytes.reverse();
                }
                bytes
            };
            numbers.iter().flat_map(number).collect::<Vec<u8>>()
        };
        if !style.is_compressed {
            return [header(&[data.len()]), data.to_vec()];
        }
        // Blocks of 32 bytes.
        let blocks: Vec<Vec<u8>> = data
            .chunks(32)
            .map(|block| {
                let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
                encoder.write_all(block).expect("a buffer");
                encoder.finish().expect("a buffer")
            })
            .collect();
        let sizes = [blocks.len(), 32, data.len() % 32];
        let sizes: Vec<usize> = sizes.into_iter().chain(blocks.iter().map(Vec::len)).collect();
        [header(&sizes), blocks.concat()]
    }

    fn file(style: Style) -> Vec<u8> {
        let mut appended: Vec<u8> = Vec::new();
        let mut array = |name: &str, type_name: &str, components: usize, words: &str| {
            let [header, data] = packed(&encode(words, type_name, style), style);
            let base64 = match style.is_compressed || style.has_separate_header {
                true => STANDARD.encode(&header) + &STANDARD.encode(&data),
                false => STANDARD.encode([header.clone(), data.clone()].concat()),
            };
            let (format, place, text) = match style.format {
                "ascii" => ("ascii", String::new(), words.to_owned()),
                "binary" => ("binary", String::new(), format!("\n  {base64}\n")),
                _ => ("appended", format!(" offset=\"{}\"", appended.len()), String::new()),
            };
            match style.format {
                "raw" => appended.extend([header, data].concat()),
                _ => appended.extend(base64.as_bytes()),
            }
            format!(
                "<DataArray type=\"{type_name}\" Name=\"{name}\" NumberOfComponents=\"{components}\" \
                 format=\"{format}\"{place}>{text}</DataArray>\n"
            )
        };
        let points = array("Points", "Float64", 3, "0 0 0 1 0 0 0 1 0 0 0 1 1.5 1 1");
        let connectivity = array("connectivity", "Int64", 1, "0 1 2 3 1 2 3 4 0 1 2");
        let ends = array("offsets", "Int64", 1, "4 8 11");
        let types = array("types", "Int32", 1, "10 10 5");
        let first = array("numbers", "Int32", 1, "1 2 3");
        let regions = array("MaterialIds", "Int32", 1, "4 5 4");
        let order = if style.is_big_endian { "BigEndian" } else { "LittleEndian" };
        let compressor = if style.is_compressed { " compressor=\"vtkZLibDataCompressor\"" } else { "" };
        let mut bytes = format!(
            "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"{order}\" \
             header_type=\"UInt{}\"{compressor}>\n<UnstructuredGrid>\n\
             <Piece NumberOfPoints=\"5\" NumberOfCells=\"3\">\n<PointData></PointData>\n\
             <CellData>{first}{regions}</CellData>\n<Points>{points}</Points>\n\
             <Cells>{connectivity}{ends}{types}</Cells>\n</Piece>\n</UnstructuredGrid>\n",
            8 * style.header_bytes
        )
        .into_bytes();
        if let "raw" | "base64" = style.format {
            bytes.extend(format!("<AppendedData encoding=\"{}\">\n_", style.format).as_bytes());
            bytes.extend(&appended);
            bytes.extend(b"\n</AppendedData>\n");
        }
        bytes.extend(b"</VTKFile>\n");
        bytes
    }

    fn styles() -> impl Iterator<Item = Style> {
        let formats = ["ascii", "binary", "raw", "base64"];
        (0..64).map(move |index| Style {
            format: formats[index / 16],
            is_compressed: index & 1 == 1,
            header_bytes: if index & 2 == 2 { 8 } else { 4 },
            is_big_endian: index & 4 == 4,
            has_separate_header: index & 8 == 8,
        })
    }

    fn cells(bytes: &[u8]) -> VolumeCells {
        read(bytes).unwrap_or_else(|error| panic!("{error}")).finish("a.vtu").expect("tetrahedra")
    }

    #[test]
    fn all_styles_of_arrays_give_the_same_cells() {
        let expected = cells(&file(PLAIN));
        assert_eq!((expected.positions.len(), expected.elements.len()), (5, 2));
        assert_eq!(expected.positions[4], nalgebra::Vector3::new(1.5, 1.0, 1.0));
        let names: Vec<&str> = expected.groups.iter().map(|group| group.name.as_str()).collect();
        assert_eq!((names, expected.node_groups.len()), (vec!["MaterialIds 4", "MaterialIds 5"], 1));
        for style in styles() {
            assert_eq!(cells(&file(style)), expected, "{style:?}");
        }
    }

    #[test]
    fn wrong_files_are_errors_with_the_array() {
        let text = String::from_utf8(file(PLAIN)).expect("a text");
        for (from, to, message) in [
            ("UnstructuredGrid\" version", "PolyData\" version", "got PolyData"),
            ("byte_order", "compressor=\"vtkLZ4DataCompressor\" byte_order", "vtkLZ4DataCompressor"),
            ("0 1 2 3 1 2 3 4", "0 1 2 3 1 2 3 9", "cell 1: expected one of 5 points, got 9"),
            ("4 8 11", "4 8 12", "cell 2: expected an ascending end"),
            ("4 8 11", "4 2 11", "cell 1"),
            ("Name=\"types\"", "Name=\"kinds\"", "an array types"),
            ("0 1 2 3 1 2 3 4", "0 1 2 3 1 2 3 x", "DataArray 'connectivity': number: expected a number, got 'x'"),
            ("</Piece>", "", "XML"),
        ] {
            let damaged = text.replacen(from, to, 1);
            assert_ne!(damaged, text);
            let error = read(damaged.as_bytes()).expect_err("expected an error").to_string();
            assert!(error.contains(message), "{message}: {error}");
        }
    }

    #[test]
    fn damaged_files_do_not_panic() {
        for format in ["ascii", "binary", "raw", "base64"] {
            let bytes = file(Style { format, is_compressed: format != "ascii", ..PLAIN });
            crate::file_cursor::tests::damage(&bytes, |bytes| drop(read(bytes)));
        }
    }
}
