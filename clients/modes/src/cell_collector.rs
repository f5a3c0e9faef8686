//! Collects the cells of a mesh file: tetrahedra become elements, points, edges and faces become sets of nodes for clamps,
//! and all other cells an error with a way out.

use std::collections::BTreeMap;

use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

use crate::tet10::NODES;
use crate::volume_mesh::{ElementGroup, NO_NODE, NodeGroup, VolumeCells};

/// A kind of cells of a file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CellKind {
    /// A linear tetrahedron.
    Tet4,
    /// A quadratic tetrahedron, and the place of each of its nodes in the file.
    Tet10([u8; NODES]),
    /// A cell without volume: 0 for points, 1 for edges, 2 for faces.
    Flat { name: &'static str, dimension: usize },
    /// A cell with a volume that is no tetrahedron of first or second order.
    Other { name: &'static str },
}

/// The cells of a file so far.
#[derive(Debug, Default)]
pub struct CellCollector {
    cells: VolumeCells,
    /// Numbers of cells that are not supported, by name.
    others: BTreeMap<&'static str, usize>,
    /// Numbers of cells without volume, by name.
    flat: BTreeMap<&'static str, usize>,
    /// Names and dimensions of node groups.
    node_group_keys: Vec<(String, usize)>,
}

/// Names of sets of nodes by the dimension of their cells.
const DIMENSIONS: [&str; 4] = ["points", "edges", "faces", "volumes"];

impl CellCollector {
    /// The positions of the nodes so far, in the units of the file.
    pub fn positions(&mut self) -> &mut Vec<Vector3<f64>> {
        &mut self.cells.positions
    }

    /// The index of the group of elements with this name.
    pub fn element_group(&mut self, name: &str) -> u32 {
        let groups = &mut self.cells.groups;
        let known = groups.iter().position(|group| group.name == name);
        known.unwrap_or_else(|| {
            groups.push(ElementGroup { name: name.to_owned(), material: None });
            groups.len() - 1
        }) as u32
    }

    /// Adds the nodes of a cell with fewer dimensions than 3 to a set of nodes.
    pub fn add_to_node_group(&mut self, name: &str, dimension: usize, nodes: &[u32]) {
        let keys = &mut self.node_group_keys;
        let is_same = |key: &(String, usize)| key.0 == name && key.1 == dimension;
        let index = keys.iter().position(is_same).unwrap_or_else(|| {
            keys.push((name.to_owned(), dimension));
            self.cells.node_groups.push(NodeGroup { name: name.to_owned(), nodes: Vec::new() });
            keys.len() - 1
        });
        self.cells.node_groups[index].nodes.extend(nodes);
    }

    /// Adds a cell. `groups` are the names of its groups; the first one decides about the material.
    ///
    /// # Errors
    /// `Invalid` for a tetrahedron with another number of nodes.
    pub fn add(&mut self, kind: CellKind, nodes: &[u32], groups: &[&str]) -> Result<()> {
        let mut element = [NO_NODE; NODES];
        let order: &[u8] = match &kind {
            CellKind::Flat { name, dimension } => {
                *self.flat.entry(name).or_default() += 1;
                groups.iter().for_each(|group| self.add_to_node_group(group, *dimension, nodes));
                return Ok(());
            }
            CellKind::Other { name } => {
                *self.others.entry(name).or_default() += 1;
                return Ok(());
            }
            CellKind::Tet4 => &[0, 1, 2, 3],
            CellKind::Tet10(order) => order,
        };
        if nodes.len() != order.len() {
            return Err(invalid("tetrahedron", format!("{} nodes", order.len()), nodes.len()));
        }
        element.iter_mut().zip(order).for_each(|(node, place)| *node = nodes[usize::from(*place)]);
        let group = self.element_group(groups.first().unwrap_or(&"default"));
        self.cells.elements.push(element);
        self.cells.element_groups.push(group);
        let others = groups.get(1..).unwrap_or_default();
        others.iter().for_each(|group| self.add_to_node_group(group, 3, nodes));
        Ok(())
    }

    /// The cells. `name` is that of the file.
    ///
    /// # Errors
    /// `Invalid` with the numbers of other cells, and if there are no tetrahedra.
    pub fn finish(mut self, name: &str) -> Result<VolumeCells> {
        let list = |counts: &BTreeMap<&str, usize>| {
            let listed = counts.iter().map(|(name, count)| format!("{count} {name}"));
            listed.collect::<Vec<_>>().join(", ")
        };
        let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
        let file = |ending: &str| shell_word(&format!("{stem}{ending}"));
        let from_geometry = format!("from the geometry: `gmsh {} -3 -order 2 -o {}`", file(".step"), file(".msh"));
        if !self.others.is_empty() {
            // pyvista does not read all files of Gmsh.
            let (convert, grid) = match name.ends_with(".msh") {
                true => (format!("gmsh {} -save -o {} && ", shell_word(name), file(".vtk")), file(".vtk")),
                false => (String::new(), shell_word(name)),
            };
            // Other shapes can be divided; a tetrahedron of higher order cannot.
            let divide = match self.others.keys().all(|name| name.starts_with("tetrahedra")) {
                true => String::new(),
                false => format!(
                    "; from cells: `{convert}python3 -c 'import pyvista, sys; \
                     pyvista.read(sys.argv[1]).triangulate().save(sys.argv[2])' {grid} {}` after `pip install pyvista`",
                    file("-tetrahedra.vtu")
                ),
            };
            let expected = format!("tetrahedra of first or second order ({from_geometry}{divide})");
            return Err(invalid("cells", expected, list(&self.others)));
        }
        if self.cells.elements.is_empty() {
            let surface = format!("python3 -m modalcast.surface {} {}", shell_word(name), file(".ply"));
            let expected = format!("tetrahedra ({from_geometry}; a surface: `{surface}`)");
            let given = if self.flat.is_empty() { "no cells".to_owned() } else { list(&self.flat) };
            return Err(invalid("cells", expected, given));
        }
        // A clamp names a group, so that names must differ.
        for (group, (_, dimension)) in self.cells.node_groups.iter_mut().zip(&self.node_group_keys) {
            let is_taken = self.cells.groups.iter().any(|other| other.name == group.name)
                || self.node_group_keys.iter().filter(|(name, _)| *name == group.name).count() > 1;
            if is_taken {
                group.name = format!("{} {}", group.name, DIMENSIONS[*dimension]);
            }
        }
        // Faces come first, because clamps mostly hold them and messages list the first groups only.
        let mut groups: Vec<(NodeGroup, usize)> = std::mem::take(&mut self.cells.node_groups)
            .into_iter()
            .zip(self.node_group_keys.iter().map(|(_, dimension)| *dimension))
            .collect();
        groups.sort_by_key(|(_, dimension)| std::cmp::Reverse(*dimension));
        self.cells.node_groups = groups.into_iter().map(|(group, _)| group).collect();
        Ok(self.cells)
    }
}

/// A file name as one word of a shell.
fn shell_word(name: &str) -> String {
    // A name has no NUL, which is the only character that cannot be quoted.
    shlex::try_quote(name).map_or_else(|_| name.to_owned(), Into::into)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FACE: CellKind = CellKind::Flat { name: "triangles", dimension: 2 };

    #[test]
    fn groups_of_cells_become_regions_and_sets_with_different_names() {
        let mut collector = CellCollector::default();
        collector.add(CellKind::Tet4, &[0, 1, 2, 3], &["a", "b"]).expect("a cell");
        let order = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8];
        collector.add(CellKind::Tet10(order), &[0, 1, 2, 4, 5, 6, 7, 8, 9, 10], &[]).expect("a cell");
        let point = CellKind::Flat { name: "points", dimension: 0 };
        collector.add(point, &[3], &["tip"]).expect("a cell");
        collector.add(FACE, &[0, 1, 2], &["a", "foot"]).expect("a cell");
        collector.add(FACE, &[1, 2, 3], &["foot"]).expect("a cell");
        assert!(collector.add(CellKind::Tet4, &[0, 1, 2], &[]).is_err());
        let cells = collector.finish("a.msh").expect("cells");
        assert_eq!(cells.elements[0][..5], [0, 1, 2, 3, NO_NODE]);
        assert_eq!(cells.elements[1], [0, 1, 2, 4, 5, 6, 7, 8, 10, 9]);
        assert_eq!(cells.element_groups, [0, 1]);
        let names: Vec<&str> = cells.groups.iter().map(|group| group.name.as_str()).collect();
        assert_eq!(names, ["a", "default"]);
        let sets: Vec<(&str, usize)> =
            cells.node_groups.iter().map(|group| (group.name.as_str(), group.nodes.len())).collect();
        assert_eq!(sets, [("b", 4), ("a faces", 3), ("foot", 6), ("tip", 1)]);
    }

    #[test]
    fn other_cells_are_counted_with_a_way_out() {
        let mut collector = CellCollector::default();
        collector.add(CellKind::Tet4, &[0, 1, 2, 3], &[]).expect("a cell");
        for _ in 0..2 {
            collector.add(CellKind::Other { name: "hexahedra" }, &[0; 8], &[]).expect("a cell");
        }
        let error = collector.finish("part.msh").expect_err("expected an error").to_string();
        assert!(error.contains("got 2 hexahedra") && error.contains("-3 -order 2 -o part.msh"), "{error}");
        assert!(error.contains("triangulate") && error.contains("part.vtk part-tetrahedra.vtu"), "{error}");
        let mut collector = CellCollector::default();
        collector.add(CellKind::Other { name: "tetrahedra of third order" }, &[0; 20], &[]).expect("a cell");
        let error = collector.finish("part.msh").expect_err("expected an error").to_string();
        assert!(error.contains("-order 2") && !error.contains("triangulate"), "{error}");
        let mut collector = CellCollector::default();
        collector.add(FACE, &[0, 1, 2], &[]).expect("a cell");
        let error = collector.finish("a part.vtu").expect_err("expected an error").to_string();
        assert!(
            error.contains("got 1 triangles") && error.contains("modalcast.surface 'a part.vtu' 'a part.ply'"),
            "{error}"
        );
    }
}
