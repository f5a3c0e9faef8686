//! Reads volume meshes of the library Vega FEM (`.veg`), and lists of fixed vertices beside them (`.bou`). Format: the
//! documentation of Vega FEM, "Vega mesh file format".

use std::collections::HashMap;
use std::path::Path;

use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

use crate::cell_collector::{CellCollector, CellKind};
use crate::materials::Material;
use crate::region::list_names;
use crate::volume_mesh::VolumeCells;

/// The set of all elements.
const ALL_ELEMENTS: &str = "allElements";

/// Limit on files that include each other.
const MAX_INCLUDES: usize = 64;

/// The sections of a file.
#[derive(Debug, Default)]
struct VegaFile {
    cells: CellCollector,
    /// The index of each vertex, by its number.
    vertices: HashMap<i64, u32>,
    /// The numbers and vertices of the elements.
    elements: Vec<(i64, Vec<u32>)>,
    /// The kind of the elements.
    kind: Option<CellKind>,
    materials: Vec<(String, Material)>,
    /// Names of sets, and the numbers of their elements.
    sets: Vec<(String, Vec<i64>)>,
    /// Names of sets and materials.
    regions: Vec<(String, String)>,
}

/// Reads a file. Files that it includes, and lists of fixed vertices, are in the same folder.
///
/// # Errors
/// `Invalid` with the section for wrong content, materials other than ENU, and elements without a material.
pub fn read(path: &Path) -> Result<VolumeCells> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut lines = Vec::new();
    let mut includes = 0;
    add_lines(folder, &name, &mut includes, &mut lines)?;
    let mut file = VegaFile::default();
    let mut rest = &lines[..];
    while let [header, tail @ ..] = rest {
        let count = tail.iter().position(|line| line.starts_with('*')).unwrap_or(tail.len());
        let (section, after) = tail.split_at(count);
        let read = file.read_section(header, section);
        read.map_err(|error| error.prefix_field(header))?;
        rest = after;
    }
    let mut cells = file.into_cells(&name)?;
    cells.node_groups.extend(fixed_vertices(path, cells.positions.len())?);
    Ok(cells)
}

/// Adds the lines of a file without comments and empty lines, and those of the files that it includes.
fn add_lines(folder: &Path, name: &str, includes: &mut usize, lines: &mut Vec<String>) -> Result<()> {
    let is_plain = !name.is_empty() && !name.contains(['/', '\\']) && name != "..";
    let bytes = if is_plain { std::fs::read(folder.join(name)).ok() } else { None };
    let Some(bytes) = bytes else {
        return Err(invalid("*INCLUDE", "a readable file in the folder of the mesh", format!("'{name}'")));
    };
    for line in String::from_utf8_lossy(&bytes).lines().map(str::trim) {
        if let Some(included) = line.strip_prefix("*INCLUDE") {
            *includes += 1;
            if *includes > MAX_INCLUDES {
                return Err(invalid("*INCLUDE", format!("at most {MAX_INCLUDES}"), "more"));
            }
            add_lines(folder, included.trim(), includes, lines)?;
        } else if !line.is_empty() && !line.starts_with('#') {
            lines.push(line.to_owned());
        }
    }
    Ok(())
}

/// Words of a line, which spaces or commas separate.
fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split(|character: char| character == ',' || character.is_whitespace()).filter(|word| !word.is_empty())
}

fn number<T: std::str::FromStr>(word: Option<&str>) -> Result<T> {
    let given = word.unwrap_or("the end of the line");
    given.parse().map_err(|_| invalid("line", "a number", format!("'{given}'")))
}

impl VegaFile {
    fn read_section(&mut self, header: &str, lines: &[String]) -> Result<()> {
        let (section, name) = header.split_once(char::is_whitespace).unwrap_or((header, ""));
        let name = name.trim().to_owned();
        match section {
            "*VERTICES" => self.read_vertices(lines),
            "*ELEMENTS" => self.read_elements(lines),
            "*MATERIAL" => {
                let material = Material { name: name.clone(), ..parse_material(lines)? };
                self.materials.push((name, material));
                Ok(())
            }
            "*SET" => {
                let members = lines.iter().flat_map(|line| words(line));
                let members = members.map(|word| number(Some(word))).collect::<Result<_>>()?;
                self.sets.push((name, members));
                Ok(())
            }
            "*REGION" => {
                let line = lines.first().map_or("", String::as_str);
                let (set, material) =
                    line.split_once(',').ok_or_else(|| invalid("line", "SET, MATERIAL", format!("'{line}'")))?;
                self.regions.push((set.trim().into(), material.trim().into()));
                Ok(())
            }
            _ => Err(invalid("section", "*VERTICES, *ELEMENTS, *MATERIAL, *SET or *REGION", section)),
        }
    }

    /// A line with the number of vertices, then lines with a number and three coordinates.
    fn read_vertices(&mut self, lines: &[String]) -> Result<()> {
        let [header, rows @ ..] = lines else { return Err(invalid("section", "the number of vertices", "nothing")) };
        let count: usize = number(words(header).next())?;
        if rows.len() != count {
            return Err(invalid("section", format!("{count} vertices"), rows.len()));
        }
        for row in rows {
            let mut words = words(row);
            let vertex: i64 = number(words.next())?;
            let position = Vector3::new(number(words.next())?, number(words.next())?, number(words.next())?);
            self.vertices.insert(vertex, self.cells.positions().len() as u32);
            self.cells.positions().push(position);
        }
        Ok(())
    }

    /// A line with the kind, one with the number of elements and of their vertices, then lines with a number and vertices.
    fn read_elements(&mut self, lines: &[String]) -> Result<()> {
        let [kind, header, rows @ ..] = lines else {
            return Err(invalid("section", "the kind and the number of elements", "nothing"));
        };
        self.kind = Some(match kind.as_str() {
            "TET" | "TETS" => CellKind::Tet4,
            "CUBIC" => CellKind::Other { name: "cubes (CUBIC)" },
            other => return Err(invalid("kind of elements", "TET", other)),
        });
        let count: usize = number(words(header).next())?;
        if rows.len() != count {
            return Err(invalid("section", format!("{count} elements"), rows.len()));
        }
        for row in rows {
            let mut words = words(row);
            let element = number(words.next())?;
            let vertex = |word| {
                let vertex: i64 = number(Some(word))?;
                let known = self.vertices.get(&vertex).copied();
                known.ok_or_else(|| invalid(format!("element {element}"), "existing vertices", vertex))
            };
            self.elements.push((element, words.map(vertex).collect::<Result<_>>()?));
        }
        Ok(())
    }

    /// The cells. Each region with a set of its own is a group with the name of the set; a region of all elements has the name
    /// of its material. Other sets become sets of nodes.
    fn into_cells(mut self, name: &str) -> Result<VolumeCells> {
        let Some(kind) = self.kind else { return Err(invalid("file", "a section *ELEMENTS", "none")) };
        let set_names: Vec<String> = self.sets.iter().map(|(name, _)| name.clone()).collect();
        let mut region_of_element: HashMap<i64, usize> = HashMap::new();
        let mut groups = Vec::new();
        for (index, (set, material)) in self.regions.iter().enumerate() {
            let Some((_, constants)) = self.materials.iter().find(|(name, _)| name == material) else {
                let names: Vec<String> = self.materials.iter().map(|(name, _)| name.clone()).collect();
                return Err(invalid("*REGION", format!("one of the materials {}", list_names(&names)), material));
            };
            let is_whole = set == ALL_ELEMENTS;
            let Some(members) = self.sets.iter().find(|(name, _)| name == set).map(|(_, members)| members) else {
                if !is_whole {
                    let expected = format!("{ALL_ELEMENTS} or one of the sets {}", list_names(&set_names));
                    return Err(invalid("*REGION", expected, set));
                }
                region_of_element.extend(self.elements.iter().map(|(element, _)| (*element, index)));
                groups.push((material.clone(), constants.clone()));
                continue;
            };
            region_of_element.extend(members.iter().map(|element| (*element, index)));
            groups.push((set.clone(), constants.clone()));
        }
        for (element, vertices) in &self.elements {
            let group = match region_of_element.get(element) {
                Some(region) => groups[*region].0.as_str(),
                None if groups.is_empty() => "default",
                None => return Err(invalid(format!("element {element}"), "a *REGION with a material", "none")),
            };
            self.cells.add(kind, vertices, &[group])?;
        }
        let vertices_of: HashMap<i64, &Vec<u32>> =
            self.elements.iter().map(|(element, vertices)| (*element, vertices)).collect();
        for (set, members) in self.sets.iter().filter(|(set, _)| groups.iter().all(|(name, _)| name != set)) {
            let vertices = members.iter().filter_map(|element| vertices_of.get(element)).flat_map(|list| list.iter());
            self.cells.add_to_node_group(set, 3, &vertices.copied().collect::<Vec<_>>());
        }
        let mut cells = self.cells.finish(name)?;
        for group in &mut cells.groups {
            group.material = groups.iter().find(|(name, _)| *name == group.name).map(|(_, material)| material.clone());
        }
        Ok(cells)
    }
}

/// Reads `ENU, DENSITY, E, NU`.
fn parse_material(lines: &[String]) -> Result<Material> {
    let line = lines.first().map_or("", String::as_str);
    let mut words = words(line);
    match words.next() {
        Some("ENU") => {}
        other => {
            let expected = "ENU, DENSITY, E, NU (another material has no linear constants: replace it in the file, or by \
                            --material after its removal)";
            return Err(invalid("material", expected, other.unwrap_or("nothing")));
        }
    }
    let [density, youngs_modulus, poissons_ratio] =
        [number(words.next())?, number(words.next())?, number(words.next())?];
    Material::new(youngs_modulus, poissons_ratio, density)
}

/// The files with fixed vertices that belong to a mesh: those in its folder whose name, without `.bou`, begins its name.
pub fn fixed_vertex_files(path: &Path) -> Vec<std::path::PathBuf> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let belongs = |file: &std::path::PathBuf| {
        let begins = file.file_stem().is_some_and(|name| stem.starts_with(&*name.to_string_lossy()));
        begins && file.extension().is_some_and(|extension| extension == "bou") && file.is_file()
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<std::path::PathBuf> = entries.map(|entry| entry.path()).filter(belongs).collect();
    files.sort();
    files
}

/// The sets of fixed vertices beside a mesh, with the names of their files. Vertices count from 1.
fn fixed_vertices(path: &Path, count: usize) -> Result<Vec<crate::volume_mesh::NodeGroup>> {
    let group_of = |file: std::path::PathBuf| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let text = std::fs::read_to_string(&file).map_err(|error| invalid(&name, "a readable text", error))?;
        let vertex = |word| match number::<u32>(Some(word)) {
            Ok(vertex) if (1..=count).contains(&(vertex as usize)) => Ok(vertex - 1),
            _ => Err(invalid(&name, format!("vertices from 1 to {count}"), format!("'{word}'"))),
        };
        let nodes = words(&text).map(vertex).collect::<Result<_>>()?;
        Ok(crate::volume_mesh::NodeGroup { name, nodes })
    };
    fixed_vertex_files(path).into_iter().map(group_of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# a comment\n*VERTICES\n5 3 0 0\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n5 1 1 1\n\n*ELEMENTS\nTET\n\
        2 4 0\n1 1 2 3 4\n2 2 3 4 5\n*SET hard\n2,\n*SET pair\n*INCLUDE pair.txt\n*MATERIAL bone\nENU, 1000, 2e7, 0.4\n\
        *MATERIAL skin\nENU, 900, 1e5, 0.45\n*REGION\nallElements, skin\n*REGION\nhard, bone\n";

    fn folder_with(text: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("part-fine.veg"), text).expect("a file");
        std::fs::write(folder.path().join("pair.txt"), "1, 2\n").expect("a file");
        folder
    }

    #[test]
    fn regions_sets_and_fixed_vertices_are_read() {
        let folder = folder_with(TEXT);
        std::fs::write(folder.path().join("part.bou"), "1,2,\n5\n").expect("a file");
        std::fs::write(folder.path().join("other.bou"), "3").expect("a file");
        let cells = read(&folder.path().join("part-fine.veg")).expect("cells");
        assert_eq!((cells.positions.len(), cells.elements.len()), (5, 2));
        assert_eq!(cells.elements[1][..4], [1, 2, 3, 4]);
        let groups: Vec<(&str, f64)> = cells
            .groups
            .iter()
            .map(|group| (group.name.as_str(), group.material.as_ref().map_or(0.0, |material| material.density)))
            .collect();
        assert_eq!(groups, [("skin", 900.0), ("hard", 1000.0)]);
        assert_eq!(cells.groups[1].material.as_ref().map(|material| material.name.as_str()), Some("bone"));
        assert_eq!(cells.element_groups, [0, 1]);
        let sets: Vec<(&str, &[u32])> =
            cells.node_groups.iter().map(|group| (group.name.as_str(), &group.nodes[..])).collect();
        assert_eq!(sets, [("pair", &[0, 1, 2, 3, 1, 2, 3, 4][..]), ("part.bou", &[0, 1, 4][..])]);
    }

    #[test]
    fn wrong_files_are_errors_with_the_section() {
        for (from, to, message) in [
            ("ENU, 1000", "MOONEYRIVLIN, 1000", "*MATERIAL bone: material: expected ENU, DENSITY, E, NU"),
            ("ENU, 1000, 2e7, 0.4", "ENU, 1000, 2e7, 0.5", "below 0.5, got 0.5"),
            ("TET", "CUBIC", "2 cubes (CUBIC)"),
            ("TET", "WEDGE", "expected TET, got WEDGE"),
            ("pair.txt", "missing.txt", "in the folder of the mesh, got 'missing.txt'"),
            ("pair.txt", "../part.veg", "in the folder of the mesh"),
            ("pair.txt", "part-fine.veg", "at most 64"),
            ("hard, bone", "soft, bone", "one of the sets 'hard', 'pair', got soft"),
            ("hard, bone", "hard, wood", "one of the materials 'bone', 'skin', got wood"),
            ("allElements, skin", "hard, skin", "element 1: expected a *REGION"),
            ("5 3 0 0", "6 3 0 0", "*VERTICES: section: expected 6 vertices, got 5"),
            ("2 2 3 4 5", "2 2 3 4 6", "element 2: expected existing vertices, got 6"),
            ("2 2 3 4 5", "2 2 3 4", "4 nodes, got 3"),
            ("*VERTICES", "*NODES", "section"),
        ] {
            let text = TEXT.replacen(from, to, 1);
            assert_ne!(text, TEXT);
            let folder = folder_with(&text);
            let error = read(&folder.path().join("part-fine.veg")).expect_err("expected an error").to_string();
            assert!(error.contains(message), "{message}: {error}");
        }
        let folder = folder_with(TEXT);
        std::fs::write(folder.path().join("part.bou"), "1,6").expect("a file");
        let error = read(&folder.path().join("part-fine.veg")).expect_err("expected an error").to_string();
        assert_eq!(error, "part.bou: expected vertices from 1 to 5, got '6'");
    }
}
