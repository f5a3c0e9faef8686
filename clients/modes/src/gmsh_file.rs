//! Reads Gmsh's MSH files, versions 2.2 and 4.1, as text and binary. Format: the Gmsh reference manual, section "Gmsh file
//! formats".

use std::collections::{BTreeMap, HashMap};

use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

use crate::cell_collector::{CellCollector, CellKind};
use crate::file_cursor::{Encoding, FileCursor};

/// The order of nodes in a quadratic tetrahedron: the middles of the last two edges are exchanged.
const TET10: CellKind = CellKind::Tet10([0, 1, 2, 3, 4, 5, 6, 7, 9, 8]);

/// Dimensions of entities and physical groups.
const ENTITY_NAMES: [&str; 4] = ["point", "curve", "surface", "volume"];

/// Reads the cells of a file.
///
/// # Errors
/// `Invalid` for other versions, and with the section for wrong content.
pub fn read(bytes: &[u8]) -> Result<CellCollector> {
    let mut cursor = FileCursor::new(bytes);
    let mut file = GmshFile::default();
    let mut format = None;
    while let Some(line) = cursor.text_line() {
        let Some(section) = line.strip_prefix('$') else { continue };
        if section == "MeshFormat" {
            format = Some(read_format(&mut cursor)?);
        }
        let (is_version_4, encoding) = format.ok_or_else(|| invalid("text", "$MeshFormat", format!("'{line}'")))?;
        let result = match (section, is_version_4) {
            ("PhysicalNames", _) => file.read_names(&mut cursor),
            ("Entities", true) => file.read_entities(&mut cursor, encoding),
            ("Nodes", false) => file.read_nodes_2(&mut cursor, encoding),
            ("Nodes", true) => file.read_nodes_4(&mut cursor, encoding),
            ("Elements", false) => file.read_elements_2(&mut cursor, encoding),
            ("Elements", true) => file.read_elements_4(&mut cursor, encoding),
            _ => Ok(()),
        };
        result.map_err(|error| error.prefix_field(&format!("${section}")))?;
        cursor.skip_past(&format!("$End{section}"))?;
    }
    match format {
        Some(_) => Ok(file.cells),
        None => Err(invalid("text", "$MeshFormat", "the end of the file")),
    }
}

/// Whether the file has version 4.1, and how numbers are stored.
fn read_format(cursor: &mut FileCursor<'_>) -> Result<(bool, Encoding)> {
    let line = cursor.text_line().unwrap_or_default();
    let words: Vec<&str> = line.split_whitespace().collect();
    let is_version_4 = match words.first() {
        Some(&"2.2" | &"2.1" | &"2") => false,
        Some(&"4.1") => true,
        other => {
            let expected = "version 2.2 or 4.1 (`gmsh OLD.msh -save -format msh41 -o NEW.msh` converts others)";
            return Err(invalid("$MeshFormat", expected, other.unwrap_or(&"none")));
        }
    };
    let encoding = match words.get(1) {
        Some(&"0") => Encoding::Text,
        Some(&"1") => match cursor.number(Encoding::LittleEndian)? {
            1_i32 => Encoding::LittleEndian,
            0x0100_0000 => Encoding::BigEndian,
            other => return Err(invalid("$MeshFormat", "the number 1", other)),
        },
        other => return Err(invalid("$MeshFormat", "0 for text or 1 for binary", other.unwrap_or(&"none"))),
    };
    // Version 4 has integers of this size.
    match words.get(2) {
        Some(&"8") => Ok((is_version_4, encoding)),
        other => Err(invalid("$MeshFormat", "numbers of 8 bytes", other.unwrap_or(&"none"))),
    }
}

/// The sections of the file that have been read.
#[derive(Debug, Default)]
struct GmshFile {
    cells: CellCollector,
    /// The names of physical groups, by dimension and number.
    names: HashMap<(i32, i32), String>,
    /// The physical groups of entities, by dimension and number.
    physical_groups: HashMap<(i32, i32), Vec<i32>>,
    /// The index of each node, by its number.
    nodes: HashMap<u64, u32>,
    /// Names of the groups of an entity and a physical group, which many elements share.
    group_names: BTreeMap<(i32, i32, i32), Vec<String>>,
}

impl GmshFile {
    fn read_names(&mut self, cursor: &mut FileCursor<'_>) -> Result<()> {
        let count: i32 = cursor.number(Encoding::Text)?;
        for _ in 0..count {
            let [dimension, number] = [cursor.number(Encoding::Text)?, cursor.number(Encoding::Text)?];
            let line = cursor.line().unwrap_or_default();
            let name = String::from_utf8_lossy(line).trim().trim_matches('"').to_owned();
            self.names.insert((dimension, number), name);
        }
        Ok(())
    }

    fn read_entities(&mut self, cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<()> {
        let mut counts = [0_u64; 4];
        for count in &mut counts {
            *count = cursor.number(encoding)?;
        }
        for (dimension, count) in (0..).zip(counts) {
            for _ in 0..count {
                let entity: i32 = cursor.number(encoding)?;
                // A point has a position, others have bounds.
                for _ in 0..if dimension == 0 { 3 } else { 6 } {
                    cursor.number::<f64>(encoding)?;
                }
                let group_count: u64 = cursor.number(encoding)?;
                for _ in 0..group_count {
                    let group: i32 = cursor.number(encoding)?;
                    self.physical_groups.entry((dimension, entity)).or_default().push(group);
                }
                let boundary_count: u64 = if dimension == 0 { 0 } else { cursor.number(encoding)? };
                for _ in 0..boundary_count {
                    cursor.number::<i32>(encoding)?;
                }
            }
        }
        Ok(())
    }

    fn add_node(&mut self, number: u64, position: [f64; 3]) {
        let positions = self.cells.positions();
        self.nodes.insert(number, positions.len() as u32);
        positions.push(Vector3::from(position));
    }

    fn read_nodes_2(&mut self, cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<()> {
        let count: u64 = cursor.number(Encoding::Text)?;
        skip_line_before_data(cursor, encoding);
        for _ in 0..count {
            let number: i32 = cursor.number(encoding)?;
            let position = [cursor.number(encoding)?, cursor.number(encoding)?, cursor.number(encoding)?];
            self.add_node(number as u64, position);
        }
        Ok(())
    }

    fn read_nodes_4(&mut self, cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<()> {
        let [blocks, ..] = read_header(cursor, encoding)?;
        for _ in 0..blocks {
            let [dimension, _, is_parametric] = read_integers(cursor, encoding)?;
            let count: u64 = cursor.number(encoding)?;
            let mut numbers: Vec<u64> = Vec::new();
            for _ in 0..count {
                numbers.push(cursor.number(encoding)?);
            }
            for number in numbers {
                let position = [cursor.number(encoding)?, cursor.number(encoding)?, cursor.number(encoding)?];
                for _ in 0..if is_parametric == 0 { 0 } else { dimension } {
                    cursor.number::<f64>(encoding)?;
                }
                self.add_node(number, position);
            }
        }
        Ok(())
    }

    fn read_elements_2(&mut self, cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<()> {
        let count: u64 = cursor.number(Encoding::Text)?;
        skip_line_before_data(cursor, encoding);
        let mut done = 0;
        while done < count {
            // A binary file has a header for several elements. In a text, the number of an element comes first.
            let (element_type, repeats, tag_count): (i32, i32, i32) = match encoding {
                Encoding::Text => {
                    cursor.number::<u64>(encoding)?;
                    (cursor.number(encoding)?, 1, cursor.number(encoding)?)
                }
                _ => (cursor.number(encoding)?, cursor.number(encoding)?, cursor.number(encoding)?),
            };
            let (dimension, node_count, kind) = kind_of(element_type)?;
            if repeats < 1 {
                return Err(invalid("elements of a block", "at least 1", repeats));
            }
            for _ in 0..repeats {
                if encoding != Encoding::Text {
                    cursor.number::<i32>(encoding)?;
                }
                let (mut physical, mut entity) = (0, 0);
                for tag in 0..tag_count {
                    let value = cursor.number(encoding)?;
                    match tag {
                        0 => physical = value,
                        1 => entity = value,
                        _ => {}
                    }
                }
                let mut numbers = Vec::new();
                for _ in 0..node_count {
                    numbers.push(cursor.number::<i32>(encoding)? as u64);
                }
                self.add_element(kind, dimension, [physical, entity], &numbers)?;
            }
            done += repeats as u64;
        }
        Ok(())
    }

    fn read_elements_4(&mut self, cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<()> {
        let [blocks, ..] = read_header(cursor, encoding)?;
        for _ in 0..blocks {
            let [_, entity, element_type] = read_integers(cursor, encoding)?;
            let count: u64 = cursor.number(encoding)?;
            let (dimension, node_count, kind) = kind_of(element_type)?;
            for _ in 0..count {
                cursor.number::<u64>(encoding)?;
                let mut numbers = Vec::new();
                for _ in 0..node_count {
                    numbers.push(cursor.number(encoding)?);
                }
                self.add_element(kind, dimension, [0, entity], &numbers)?;
            }
        }
        Ok(())
    }

    /// Adds an element. A physical group of 0 stands for those of the entity.
    fn add_element(
        &mut self,
        kind: CellKind,
        dimension: i32,
        [physical, entity]: [i32; 2],
        numbers: &[u64],
    ) -> Result<()> {
        let index_of = |number: &u64| {
            self.nodes.get(number).copied().ok_or_else(|| invalid("element", "an existing node", number))
        };
        let nodes: Vec<u32> = numbers.iter().map(index_of).collect::<Result<_>>()?;
        let (names, physical_groups) = (&self.names, &self.physical_groups);
        let groups = self.group_names.entry((dimension, physical, entity)).or_insert_with(|| {
            let physical = match physical {
                0 => physical_groups.get(&(dimension, entity)).cloned().unwrap_or_default(),
                _ => vec![physical],
            };
            let kind = ENTITY_NAMES[dimension as usize];
            let name_of = |group: &i32| {
                let named = names.get(&(dimension, group.abs())).cloned();
                named.unwrap_or_else(|| format!("physical {kind} {}", group.abs()))
            };
            match physical.is_empty() {
                true => vec![format!("{kind} {entity}")],
                false => physical.iter().map(name_of).collect(),
            }
        });
        let groups: Vec<&str> = groups.iter().map(String::as_str).collect();
        self.cells.add(kind, &nodes, &groups)
    }
}

/// In a binary file, numbers begin after the line with their count.
fn skip_line_before_data(cursor: &mut FileCursor<'_>, encoding: Encoding) {
    if encoding != Encoding::Text {
        cursor.line();
    }
}

/// Blocks, entries, smallest and largest number.
fn read_header(cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<[u64; 4]> {
    let mut header = [0; 4];
    for number in &mut header {
        *number = cursor.number(encoding)?;
    }
    Ok(header)
}

fn read_integers(cursor: &mut FileCursor<'_>, encoding: Encoding) -> Result<[i32; 3]> {
    Ok([cursor.number(encoding)?, cursor.number(encoding)?, cursor.number(encoding)?])
}

/// The dimension, the number of nodes and the kind of an element type.
fn kind_of(element_type: i32) -> Result<(i32, usize, CellKind)> {
    let flat = |name, dimension, nodes| (dimension as i32, nodes, CellKind::Flat { name, dimension });
    let solid = |name, nodes| (3, nodes, CellKind::Other { name });
    Ok(match element_type {
        15 => flat("points", 0, 1),
        1 => flat("lines", 1, 2),
        8 => flat("lines", 1, 3),
        26 => flat("lines", 1, 4),
        27 => flat("lines", 1, 5),
        28 => flat("lines", 1, 6),
        2 => flat("triangles", 2, 3),
        9 => flat("triangles", 2, 6),
        20 => flat("triangles", 2, 9),
        21 => flat("triangles", 2, 10),
        22 => flat("triangles", 2, 12),
        23 | 24 => flat("triangles", 2, 15),
        25 => flat("triangles", 2, 21),
        3 => flat("quadrangles", 2, 4),
        10 => flat("quadrangles", 2, 9),
        16 => flat("quadrangles", 2, 8),
        4 => (3, 4, CellKind::Tet4),
        11 => (3, 10, TET10),
        29 => solid("tetrahedra of third order", 20),
        30 => solid("tetrahedra of fourth order", 35),
        31 => solid("tetrahedra of fifth order", 56),
        5 => solid("hexahedra", 8),
        12 => solid("hexahedra", 27),
        17 => solid("hexahedra", 20),
        6 => solid("prisms", 6),
        13 => solid("prisms", 18),
        18 => solid("prisms", 15),
        7 => solid("pyramids", 5),
        14 => solid("pyramids", 14),
        19 => solid("pyramids", 13),
        _ => return Err(invalid("element type", "a type of first or second order", element_type)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume_mesh::{NO_NODE, VolumeCells};

    /// Writes the same numbers as text or binary.
    struct Writer {
        bytes: Vec<u8>,
        encoding: Encoding,
    }

    impl Writer {
        fn text(&mut self, text: &str) {
            self.bytes.extend(text.as_bytes());
        }

        fn put(&mut self, text: &str, little_endian: &[u8]) {
            match self.encoding {
                Encoding::Text => self.text(&format!("{text} ")),
                Encoding::LittleEndian => self.bytes.extend(little_endian),
                Encoding::BigEndian => self.bytes.extend(little_endian.iter().rev()),
            }
        }

        fn int(&mut self, number: i32) {
            self.put(&number.to_string(), &number.to_le_bytes());
        }

        fn sizes(&mut self, numbers: &[u64]) {
            numbers.iter().for_each(|number| self.put(&number.to_string(), &number.to_le_bytes()));
        }

        fn floats(&mut self, numbers: &[f64]) {
            numbers.iter().for_each(|number| self.put(&number.to_string(), &number.to_le_bytes()));
        }

        fn new(version: &str, encoding: Encoding) -> Self {
            let mut writer = Self { bytes: Vec::new(), encoding };
            writer.text(&format!("$MeshFormat\n{version} {} 8\n", u8::from(encoding != Encoding::Text)));
            if encoding != Encoding::Text {
                writer.int(1);
            }
            writer.text("\n$EndMeshFormat\n$Comments\nfree text\n$EndComments\n");
            writer.text("$PhysicalNames\n2\n3 5 \"the body\"\n2 6 \"foot\"\n$EndPhysicalNames\n");
            writer
        }
    }

    const POSITIONS: [[f64; 3]; 11] = [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0],
        [0.5, 0.0, 0.0],
        [0.5, 0.5, 0.0],
        [0.0, 0.5, 0.0],
        [0.0, 0.0, 0.5],
        [0.0, 0.5, 0.5],
        [0.5, 0.0, 0.5],
        [1.0, 1.0, 1.0],
    ];

    /// A linear tetrahedron without a group, a quadratic one in the body, and a triangle in the foot and in group 8. Node
    /// numbers are 10 times the index, plus 10.
    fn version_2(encoding: Encoding) -> Vec<u8> {
        let mut writer = Writer::new("2.2", encoding);
        writer.text("$Nodes\n11\n");
        for (index, position) in (1..).zip(POSITIONS) {
            writer.int(10 * index);
            writer.floats(&position);
        }
        writer.text("\n$EndNodes\n$Elements\n4\n");
        let elements: [(i32, [i32; 2], &[i32]); 4] = [
            (4, [0, 2], &[20, 30, 40, 110]),
            (11, [5, 1], &[10, 20, 30, 40, 50, 60, 70, 80, 90, 100]),
            (2, [6, 3], &[10, 20, 30]),
            (2, [8, 3], &[10, 20, 30]),
        ];
        for (index, (element_type, tags, nodes)) in (1..).zip(elements) {
            match encoding {
                Encoding::Text => [index, element_type, 2].into_iter().for_each(|number| writer.int(number)),
                _ => [element_type, 1, 2, index].into_iter().for_each(|number| writer.int(number)),
            }
            tags.iter().chain(nodes).for_each(|number| writer.int(*number));
        }
        writer.text("\n$EndElements\n");
        writer.bytes
    }

    fn version_4(encoding: Encoding) -> Vec<u8> {
        let mut writer = Writer::new("4.1", encoding);
        writer.text("$Entities\n");
        writer.sizes(&[1, 0, 1, 2]);
        writer.int(1);
        writer.floats(&[0.0; 3]);
        writer.sizes(&[0]);
        writer.int(3);
        writer.floats(&[0.0; 6]);
        writer.sizes(&[2]);
        [6, 8].into_iter().for_each(|group| writer.int(group));
        writer.sizes(&[1]);
        writer.int(-1);
        for (entity, groups) in [(1, &[5][..]), (2, &[][..])] {
            writer.int(entity);
            writer.floats(&[0.0; 6]);
            writer.sizes(&[groups.len() as u64]);
            groups.iter().for_each(|group| writer.int(*group));
            writer.sizes(&[1]);
            writer.int(3);
        }
        writer.text("\n$EndEntities\n$Nodes\n");
        writer.sizes(&[2, 11, 10, 110]);
        for (parametric, range) in [(0, 0..4), (1, 4..11)] {
            [2, 3, parametric].into_iter().for_each(|number| writer.int(number));
            writer.sizes(&[range.len() as u64]);
            range.clone().for_each(|index| writer.sizes(&[10 * index as u64 + 10]));
            for index in range {
                writer.floats(&POSITIONS[index]);
                writer.floats(if parametric == 1 { &[0.1, 0.2] } else { &[] });
            }
        }
        writer.text("\n$EndNodes\n$Elements\n");
        writer.sizes(&[3, 3, 1, 3]);
        let blocks: [([i32; 3], &[u64]); 3] = [
            ([3, 2, 4], &[20, 30, 40, 110]),
            ([3, 1, 11], &[10, 20, 30, 40, 50, 60, 70, 80, 90, 100]),
            ([2, 3, 2], &[10, 20, 30]),
        ];
        for (header, nodes) in blocks {
            header.into_iter().for_each(|number| writer.int(number));
            writer.sizes(&[1, 7]);
            writer.sizes(nodes);
        }
        writer.text("\n$EndElements\n");
        writer.bytes
    }

    fn cells(bytes: &[u8]) -> VolumeCells {
        read(bytes).unwrap_or_else(|error| panic!("{error}")).finish("a.msh").expect("tetrahedra")
    }

    #[test]
    fn both_versions_give_the_same_cells_as_text_and_binary() {
        let expected = cells(&version_2(Encoding::Text));
        assert_eq!(expected.positions.len(), 11);
        assert_eq!(expected.elements[0][..5], [1, 2, 3, 10, NO_NODE]);
        // The last two middles are exchanged.
        assert_eq!(expected.elements[1], [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]);
        let names: Vec<&str> = expected.groups.iter().map(|group| group.name.as_str()).collect();
        assert_eq!((names, &expected.element_groups[..]), (vec!["volume 2", "the body"], &[0, 1][..]));
        let names: Vec<&str> = expected.node_groups.iter().map(|group| group.name.as_str()).collect();
        assert_eq!(names, ["foot", "physical surface 8"]);
        assert_eq!(expected.node_groups[1].nodes, [0, 1, 2]);
        for encoding in [Encoding::Text, Encoding::LittleEndian, Encoding::BigEndian] {
            assert_eq!(cells(&version_2(encoding)), expected, "{encoding:?}");
            assert_eq!(cells(&version_4(encoding)), expected, "{encoding:?}");
        }
    }

    #[test]
    fn wrong_files_are_errors_with_the_section() {
        let text = String::from_utf8(version_2(Encoding::Text)).expect("a text");
        for (from, to, message) in [
            ("$MeshFormat", "$Mesh", "$MeshFormat"),
            ("2.2 0 8", "4.0 0 8", "version 2.2 or 4.1"),
            ("2.2 0 8", "2.2 0 4", "numbers of 8 bytes"),
            ("$Nodes\n11", "$Nodes\n12", "$Nodes: text: expected a number, got '$EndNodes'"),
            ("20 30 40 110", "20 30 40 111", "$Elements: element: expected an existing node, got 111"),
            ("1 4 2 0", "1 77 2 0", "$Elements: element type"),
            ("$EndElements", "$End", "expected $EndElements"),
        ] {
            let damaged = text.replacen(from, to, 1);
            assert_ne!(damaged, text);
            let error = read(damaged.as_bytes()).expect_err("expected an error").to_string();
            assert!(error.contains(message), "{message}: {error}");
        }
        assert!(read(b"").is_err() && read(b"solid part\n").is_err());
    }

    #[test]
    fn damaged_files_do_not_panic() {
        for encoding in [Encoding::Text, Encoding::LittleEndian] {
            crate::file_cursor::tests::damage(&version_2(encoding), |bytes| drop(read(bytes)));
            crate::file_cursor::tests::damage(&version_4(encoding), |bytes| drop(read(bytes)));
        }
    }
}
