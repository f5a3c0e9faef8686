//! Reads VTK's legacy files (`.vtk`), as text and binary. Format: "VTK file formats", section "Simple legacy formats".

use modalcast_model::error::{Result, invalid};

use crate::cell_collector::CellCollector;
use crate::file_cursor::{Encoding, FileCursor, NumberType, Numbers};
use crate::vtk_cells::VtkCells;

/// Reads the cells of a file.
///
/// # Errors
/// `Invalid` with the section for wrong content, and for data that are no unstructured grid.
pub fn read(bytes: &[u8]) -> Result<CellCollector> {
    let mut cursor = FileCursor::new(bytes);
    let header = String::from_utf8_lossy(cursor.line().unwrap_or_default()).into_owned();
    if !header.starts_with("# vtk DataFile") {
        return Err(invalid(
            "line 1",
            "'# vtk DataFile'",
            format!("'{}'", header.chars().take(40).collect::<String>()),
        ));
    }
    cursor.line();
    let encoding = match cursor.word() {
        Some("ASCII") => Encoding::Text,
        Some("BINARY") => Encoding::BigEndian,
        other => return Err(invalid("line 3", "ASCII or BINARY", other.unwrap_or("the end of the file"))),
    };
    let mut file = VtkFile { cursor, encoding, grid: VtkCells::default(), has_cell_data: false };
    while let Some(keyword) = file.cursor.word() {
        let goes_on = file.read_section(keyword).map_err(|error| error.prefix_field(keyword))?;
        if !goes_on {
            break;
        }
    }
    let mut cells = CellCollector::default();
    file.grid.add_to(&mut cells)?;
    Ok(cells)
}

/// The type with a name.
fn type_of(name: Option<&str>) -> Result<NumberType> {
    Ok(match name {
        Some("char") => NumberType::Signed { bytes: 1 },
        Some("unsigned_char") => NumberType::Unsigned { bytes: 1 },
        Some("short") => NumberType::Signed { bytes: 2 },
        Some("unsigned_short") => NumberType::Unsigned { bytes: 2 },
        Some("int") => NumberType::Signed { bytes: 4 },
        Some("unsigned_int") => NumberType::Unsigned { bytes: 4 },
        Some("long" | "vtktypeint64" | "vtkIdType") => NumberType::Signed { bytes: 8 },
        Some("unsigned_long" | "vtktypeuint64") => NumberType::Unsigned { bytes: 8 },
        Some("float") => NumberType::Float { bytes: 4 },
        Some("double") => NumberType::Float { bytes: 8 },
        other => return Err(invalid("type", "a type of integers, float or double", other.unwrap_or("none"))),
    })
}

const INT: NumberType = NumberType::Signed { bytes: 4 };

/// A file while it is read.
struct VtkFile<'a> {
    cursor: FileCursor<'a>,
    encoding: Encoding,
    grid: VtkCells,
    /// Whether the arrays that follow have values for cells.
    has_cell_data: bool,
}

impl VtkFile<'_> {
    /// Reads a section. False if the rest of the file is not needed or not understood.
    fn read_section(&mut self, keyword: &str) -> Result<bool> {
        match keyword {
            "DATASET" => match self.cursor.word() {
                Some("UNSTRUCTURED_GRID") => {}
                other => return Err(invalid("data", "UNSTRUCTURED_GRID", other.unwrap_or("none"))),
            },
            "POINTS" => {
                let count = self.count()?;
                let number_type = type_of(self.cursor.word())?;
                self.grid.points = self.numbers(number_type, count, 3)?.into_floats();
            }
            "CELLS" => {
                let [cells, size] = [self.count()?, self.count()?];
                self.read_cells(cells, size)?;
            }
            "CELL_TYPES" => {
                let count = self.count()?;
                self.grid.types = self.numbers(INT, count, 1)?.into_integers("CELL_TYPES")?;
            }
            "CELL_DATA" | "POINT_DATA" => {
                self.count()?;
                self.has_cell_data = keyword == "CELL_DATA";
            }
            "SCALARS" => self.read_attribute(1)?,
            "VECTORS" | "NORMALS" => self.read_attribute(3)?,
            "TENSORS" => self.read_attribute(9)?,
            "FIELD" => return self.read_field(),
            // Its lines end with an empty one.
            "METADATA" => {
                self.cursor.line();
                while self.cursor.line().is_some_and(|line| !line.is_empty()) {}
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    fn count(&mut self) -> Result<usize> {
        self.cursor.number::<u64>(Encoding::Text).map(|count| count as usize)
    }

    /// Numbers that follow in the file. Binary ones begin on the next line.
    fn numbers(&mut self, number_type: NumberType, count: usize, components: usize) -> Result<Numbers> {
        let total = count.checked_mul(components).ok_or_else(|| invalid("count", "fewer", count))?;
        if self.encoding != Encoding::Text {
            self.cursor.line();
            let bytes = total.checked_mul(number_type.bytes()).ok_or_else(|| invalid("count", "fewer", count))?;
            return Ok(number_type.decode(self.cursor.take(bytes)?, self.encoding));
        }
        let mut missing = 0;
        let words = (0..total).map_while(|index| {
            missing = total - index;
            self.cursor.word()
        });
        let numbers = number_type.parse(words)?;
        let length = match &numbers {
            Numbers::Integers(numbers) => numbers.len(),
            Numbers::Floats(numbers) => numbers.len(),
        };
        match length == total {
            true => Ok(numbers),
            false => Err(invalid("numbers", format!("{missing} more"), "the end of the file")),
        }
    }

    /// Cells as lists of a count and points, or, from version 5 on, as two arrays. `cells` is then one more.
    fn read_cells(&mut self, cells: usize, size: usize) -> Result<()> {
        let mut ahead = self.cursor.clone();
        if ahead.word() == Some("OFFSETS") {
            self.cursor = ahead;
            let number_type = type_of(self.cursor.word())?;
            let offsets = self.numbers(number_type, cells, 1)?.into_integers("OFFSETS")?;
            self.grid.ends = offsets.into_iter().skip(1).collect();
            match self.cursor.word() {
                Some("CONNECTIVITY") => {}
                other => return Err(invalid("cells", "CONNECTIVITY", other.unwrap_or("the end of the file"))),
            }
            let number_type = type_of(self.cursor.word())?;
            self.grid.connectivity = self.numbers(number_type, size, 1)?.into_integers("CONNECTIVITY")?;
            return Ok(());
        }
        let numbers = self.numbers(INT, size, 1)?.into_integers("cells")?;
        let mut rest = &numbers[..];
        for _ in 0..cells {
            let points =
                rest.split_first().and_then(|(count, tail)| tail.split_at_checked(usize::try_from(*count).ok()?));
            let Some((points, tail)) = points else {
                return Err(invalid("cells", format!("{cells} cells with their points"), "fewer numbers"));
            };
            self.grid.connectivity.extend(points);
            self.grid.ends.push(self.grid.connectivity.len() as i64);
            rest = tail;
        }
        Ok(())
    }

    /// `name type`, for scalars also the number of components, and a line with a table of colors.
    fn read_attribute(&mut self, components: usize) -> Result<()> {
        let name = self.cursor.word().unwrap_or_default();
        let number_type = type_of(self.cursor.word())?;
        // The rest of the line.
        let mut ahead = self.cursor.clone();
        let line = String::from_utf8_lossy(ahead.line().unwrap_or_default()).into_owned();
        let components = match line.trim().parse() {
            Ok(components) => {
                self.cursor.word();
                components
            }
            Err(_) => components,
        };
        let mut ahead = self.cursor.clone();
        if ahead.word() == Some("LOOKUP_TABLE") {
            ahead.word();
            self.cursor = ahead;
        }
        let tuples = if self.has_cell_data { self.grid.types.len() } else { self.grid.points.len() / 3 };
        let numbers = self.numbers(number_type, tuples, components)?;
        self.keep(name, components, numbers);
        Ok(())
    }

    /// `FIELD name arrays`, then for each array a line `name components tuples type`.
    fn read_field(&mut self) -> Result<bool> {
        self.cursor.word();
        for _ in 0..self.count()? {
            let mut name = self.cursor.word().unwrap_or_default();
            if name == "METADATA" {
                self.read_section(name)?;
                name = self.cursor.word().unwrap_or_default();
            }
            let [components, tuples] = [self.count()?, self.count()?];
            // Texts and the like are not needed, and their length is unknown.
            let Ok(number_type) = type_of(self.cursor.word()) else { return Ok(false) };
            let numbers = self.numbers(number_type, tuples, components)?;
            self.keep(name, components, numbers);
        }
        Ok(true)
    }

    /// Keeps an array that may have regions.
    fn keep(&mut self, name: &str, components: usize, numbers: Numbers) {
        if let (true, 1, Numbers::Integers(values)) = (self.has_cell_data, components, numbers) {
            self.grid.cell_data.push((name.to_owned(), values));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume_mesh::{NO_NODE, VolumeCells};

    /// A linear and a quadratic tetrahedron and a triangle, as text with one word per number.
    const TEXT: &str = "# vtk DataFile Version 2.0\ntitle\nASCII\nDATASET UNSTRUCTURED_GRID\n\
        POINTS 11 double\n0 0 0 1 0 0 0 1 0 0 0 1 0.5 0 0 0.5 0.5 0 0 0.5 0 0 0 0.5 0.5 0 0.5 0 0.5 0.5 1 1 1\n\n\
        CELLS 3 20\n4 1 2 3 10\n10 0 1 2 3 4 5 6 7 8 9\n3 0 1 2\n\nCELL_TYPES 3\n10 24 5\n\n\
        POINT_DATA 11\nVECTORS v float\n0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0\n\
        CELL_DATA 3\nSCALARS temperature double 1\nLOOKUP_TABLE default\n1.5 2 2.5\n\
        FIELD FieldData 1\nmaterial 1 3 int\n7 9 7\n";

    fn cells(bytes: &[u8]) -> VolumeCells {
        read(bytes).expect("cells").finish("a.vtk").expect("tetrahedra")
    }

    /// The same file with binary numbers.
    fn binary() -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut put_type = "";
        for line in TEXT.replace("ASCII", "BINARY").lines() {
            let is_data = bytes.len() > 60 && line.starts_with(|first: char| first.is_ascii_digit());
            if is_data {
                for word in line.split_whitespace() {
                    match put_type {
                        "double" => bytes.extend(word.parse::<f64>().expect("a number").to_be_bytes()),
                        "float" => bytes.extend(word.parse::<f32>().expect("a number").to_be_bytes()),
                        _ => bytes.extend(word.parse::<i32>().expect("a number").to_be_bytes()),
                    }
                }
            } else {
                let types = ["double", "float", "int", "CELLS", "CELL_TYPES"];
                let named = line.split_whitespace().find(|word| types.contains(word));
                put_type = named.unwrap_or(put_type);
                bytes.extend(line.as_bytes());
                bytes.push(b'\n');
            }
        }
        bytes
    }

    #[test]
    fn text_and_binary_files_give_the_same_cells() {
        let expected = cells(TEXT.as_bytes());
        assert_eq!(expected.positions[10], nalgebra::Vector3::repeat(1.0));
        assert_eq!(expected.elements[0][..5], [1, 2, 3, 10, NO_NODE]);
        assert_eq!(expected.elements[1], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
        let names: Vec<&str> = expected.groups.iter().map(|group| group.name.as_str()).collect();
        assert_eq!((names, &expected.element_groups[..]), (vec!["material 7", "material 9"], &[0, 1][..]));
        assert_eq!(expected.node_groups[0].name, "material 7 faces");
        assert_eq!(expected.node_groups[0].nodes, [0, 1, 2]);
        assert_eq!(cells(&binary()), expected);
        let version_5 = TEXT.replace(
            "CELLS 3 20\n4 1 2 3 10\n10 0 1 2 3 4 5 6 7 8 9\n3 0 1 2\n",
            "CELLS 4 17\nOFFSETS vtktypeint64\n0 4 14 17\nCONNECTIVITY vtktypeint64\n1 2 3 10 0 1 2 3 4 5 6 7 8 9 0 1 2\n",
        );
        assert_ne!(version_5, TEXT);
        assert_eq!(cells(version_5.as_bytes()), expected);
    }

    #[test]
    fn wrong_files_are_errors_with_the_section() {
        for (from, to, message) in [
            ("# vtk", "# foo", "line 1"),
            ("ASCII", "OTHER", "ASCII or BINARY, got OTHER"),
            ("UNSTRUCTURED_GRID", "POLYDATA", "UNSTRUCTURED_GRID, got POLYDATA"),
            ("4 1 2 3 10", "4 1 2 3 11", "cell 0: expected one of 11 points, got 11"),
            ("4 1 2 3 10", "9 1 2 3 10", "CELLS"),
            ("4 1 2 3 10", "-4 1 2 3 10", "CELLS"),
            ("10 24 5\n", "10 24 99\n", "cell type"),
            ("10 24 5\n", "10 10 5\n", "4 nodes, got 10"),
            ("CELL_TYPES 3", "CELL_TYPES 2", "3 types, got 2"),
            ("POINTS 11 double", "POINTS 99999999999 double", "POINTS"),
        ] {
            let text = TEXT.replacen(from, to, 1);
            let error = read(text.as_bytes()).expect_err("expected an error").to_string();
            assert!(error.contains(message), "{message}: {error}");
        }
    }

    #[test]
    fn damaged_files_do_not_panic() {
        crate::file_cursor::tests::damage(TEXT.as_bytes(), |bytes| drop(read(bytes)));
        crate::file_cursor::tests::damage(&binary(), |bytes| drop(read(bytes)));
    }
}
