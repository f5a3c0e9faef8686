//! A mesh of quadratic tetrahedra: checks the elements of a file, raises linear ones to quadratic, and finds faces of the
//! surface and connected parts.

use std::collections::{BTreeMap, HashMap, HashSet};

use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

use crate::disjoint_sets::DisjointSets;
use crate::materials::Material;
use crate::tet10::{self, EDGES, FACES, NODES, Nodes};

/// The place of a middle node that a linear element does not have.
pub const NO_NODE: u32 = u32::MAX;

/// Elements with a smaller volume are flat, as a share of the cube of their longest edge.
const MIN_VOLUME: f64 = 1e-10;

/// Swaps the second and the third corner, and the middles of their edges.
const MIRRORED: [usize; NODES] = [0, 2, 1, 3, 6, 5, 4, 7, 9, 8];

/// A set of elements with one material.
#[derive(Debug, Clone, PartialEq)]
pub struct ElementGroup {
    pub name: String,
    /// That of the file, if the file has materials.
    pub material: Option<Material>,
}

/// A set of nodes that a clamp can hold.
#[derive(Debug, Clone, PartialEq)]
pub struct NodeGroup {
    pub name: String,
    pub nodes: Vec<u32>,
}

/// Elements and groups as a file has them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VolumeCells {
    /// Positions of the nodes, meters, in the axes of the file.
    pub positions: Vec<Vector3<f64>>,
    /// Nodes of each element in the order of [`crate::tet10`]. [`NO_NODE`] for the middles of linear elements.
    pub elements: Vec<[u32; NODES]>,
    /// The index of the group of each element.
    pub element_groups: Vec<u32>,
    pub groups: Vec<ElementGroup>,
    pub node_groups: Vec<NodeGroup>,
    pub remarks: Vec<String>,
}

/// A valid mesh of quadratic tetrahedra.
#[derive(Debug, Clone, Default)]
pub struct VolumeMesh {
    /// Positions of the nodes, meters, in the axes of the file. Every node belongs to an element.
    pub positions: Vec<Vector3<f64>>,
    /// Nodes of each element in the order of [`crate::tet10`]. Every element has a positive Jacobian determinant.
    pub elements: Vec<[u32; NODES]>,
    /// The index of the group of each element.
    pub element_groups: Vec<u32>,
    pub groups: Vec<ElementGroup>,
    pub node_groups: Vec<NodeGroup>,
    /// Faces with one element: the element, and the index of the face in [`FACES`].
    pub boundary_faces: Vec<(u32, u8)>,
    /// The part of each node. Parts are connected by common nodes.
    pub node_parts: Vec<u32>,
    pub part_count: usize,
    /// Pieces of parts that other elements touch only at points and edges, so that they can swing.
    pub hinged_pieces: usize,
    /// Linear elements that were raised to quadratic.
    pub raised_elements: usize,
    pub remarks: Vec<String>,
}

impl VolumeMesh {
    /// Checks and completes the elements of a file. Elements of any orientation are accepted; repeated elements, those with
    /// repeated corners, and nodes without elements are left out with a remark.
    ///
    /// # Errors
    /// `Invalid` with counts for flat, inverted and overlapping elements, and nodes that do not exist.
    pub fn new(mut cells: VolumeCells) -> Result<Self> {
        check_nodes(&cells)?;
        remove_repeated_elements(&mut cells);
        if cells.elements.is_empty() {
            return Err(invalid("mesh", "at least one tetrahedron", "none"));
        }
        let mirrored = orient(&mut cells)?;
        let elements_of_face = match_faces(&cells.elements, mirrored)?;
        let mut mesh = Self { boundary_faces: boundary_of(&elements_of_face), ..Self::default() };
        mesh.raised_elements = add_middle_nodes(&mut cells);
        remove_unused_nodes(&mut cells);
        let VolumeCells { positions, elements, element_groups, groups, node_groups, remarks } = cells;
        mesh = Self { positions, elements, element_groups, groups, node_groups, remarks, ..mesh };
        mesh.check_curved_elements()?;
        mesh.find_parts(&elements_of_face);
        mesh.name_parts();
        mesh.remark_coincident_nodes();
        Ok(mesh)
    }

    /// Positions of the nodes of an element.
    pub fn nodes_of(&self, element: usize) -> Nodes {
        self.elements[element].map(|node| self.positions[node as usize])
    }

    /// Nodes of a face: its three corners, then the middles of the edges between corners 0 and 1, 1 and 2, 2 and 0.
    pub fn face_nodes(&self, (element, face): (u32, u8)) -> [u32; 6] {
        let nodes = self.elements[element as usize];
        let corners = FACES[usize::from(face)];
        let middle = |a: usize, b: usize| {
            let edge = EDGES.iter().position(|edge| edge.contains(&a) && edge.contains(&b));
            nodes[4 + edge.unwrap_or(0)]
        };
        let [a, b, c] = corners;
        [nodes[a], nodes[b], nodes[c], middle(a, b), middle(b, c), middle(c, a)]
    }

    /// The corners of the bounding box of the nodes.
    pub fn bounds(&self) -> (Vector3<f64>, Vector3<f64>) {
        bounds_of(self.positions.iter())
    }

    /// The volume, cubic meters.
    pub fn volume(&self) -> f64 {
        let points = (0..self.elements.len()).filter_map(|element| tet10::shape_points(&self.nodes_of(element)));
        points.flatten().map(|point| point.volume).sum()
    }

    /// Fails for curved elements whose map is not invertible.
    fn check_curved_elements(&self) -> Result<()> {
        let is_folded = |element: &usize| tet10::shape_points(&self.nodes_of(*element)).is_none();
        let folded: Vec<usize> = (0..self.elements.len()).filter(is_folded).collect();
        let Some(first) = folded.first() else { return Ok(()) };
        let expected =
            "quadratic elements whose middle nodes are near the middles of their edges, in the order of the format";
        let center = self.nodes_of(*first).iter().sum::<Vector3<f64>>() / NODES as f64;
        let given = format!("{} inverted ones, the first at {}", folded.len(), format_position(center));
        Err(invalid("mesh", expected, given))
    }

    /// Numbers the parts, and counts the pieces that only points and edges connect.
    fn find_parts(&mut self, elements_of_face: &FaceMap) {
        let mut nodes = DisjointSets::new(self.positions.len());
        for element in &self.elements {
            element.iter().for_each(|node| nodes.merge(element[0] as usize, *node as usize));
        }
        (self.node_parts, self.part_count) = nodes.into_numbers();
        let mut pieces = DisjointSets::new(self.elements.len());
        for sides in elements_of_face.values() {
            sides.windows(2).for_each(|pair| pieces.merge(pair[0].element as usize, pair[1].element as usize));
        }
        let (_, piece_count) = pieces.into_numbers();
        self.hinged_pieces = piece_count - self.part_count;
        if self.hinged_pieces > 0 {
            self.remarks.push(format!(
                "{} of the mesh only at edges or points of the rest, where swinging is possible",
                counted(self.hinged_pieces, "piece")
            ));
        }
    }

    /// Makes each part a group if the file has only one group: those with more elements first. A mesh with very many parts
    /// keeps its group.
    fn name_parts(&mut self) {
        const MAX_PARTS: usize = 32;
        if self.groups.len() != 1 || !(2..=MAX_PARTS).contains(&self.part_count) {
            return;
        }
        let part_of = |element: &[u32; NODES]| self.node_parts[element[0] as usize] as usize;
        let mut sizes = vec![0; self.part_count];
        self.elements.iter().for_each(|element| sizes[part_of(element)] += 1);
        let mut order: Vec<usize> = (0..self.part_count).collect();
        order.sort_by_key(|part| std::cmp::Reverse(sizes[*part]));
        let mut number_of = vec![0; self.part_count];
        order.iter().zip(0..).for_each(|(part, number)| number_of[*part] = number);
        self.element_groups = self.elements.iter().map(|element| number_of[part_of(element)]).collect();
        let material = self.groups[0].material.clone();
        let group = |number: usize| ElementGroup { name: format!("part {number}"), material: material.clone() };
        self.groups = (1..=self.part_count).map(group).collect();
    }

    fn remark_coincident_nodes(&mut self) {
        let mut known = HashSet::new();
        let on_surface: HashSet<u32> = self.boundary_faces.iter().flat_map(|face| self.face_nodes(*face)).collect();
        let key = |node: &u32| <[f64; 3]>::from(self.positions[*node as usize]).map(|x| (x + 0.0).to_bits());
        let count = on_surface.iter().filter(|node| !known.insert(key(node))).count();
        if count > 0 {
            self.remarks.push(format!(
                "{} at the position of another one: the elements there touch, but are not connected",
                counted(count, "node")
            ));
        }
    }
}

/// A number with a noun in singular or plural.
fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// A position for messages.
pub fn format_position(position: Vector3<f64>) -> String {
    let [x, y, z]: [f64; 3] = position.into();
    format!("({x:.4}, {y:.4}, {z:.4}) m")
}

/// The corners of the bounding box of positions.
pub fn bounds_of<'a>(positions: impl Iterator<Item = &'a Vector3<f64>>) -> (Vector3<f64>, Vector3<f64>) {
    positions.fold((Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)), |(low, high), position| {
        (low.inf(position), high.sup(position))
    })
}

/// An element at a face.
#[derive(Debug, Clone, Copy)]
struct FaceSide {
    element: u32,
    face: u8,
    /// Whether the sorted corners of the face are an even permutation of the face of the element.
    is_even: bool,
}

/// The elements at each face, by its sorted corners.
type FaceMap = BTreeMap<[u32; 3], Vec<FaceSide>>;

/// Fails unless all nodes exist and are finite.
fn check_nodes(cells: &VolumeCells) -> Result<()> {
    let count = cells.positions.len();
    if let Some(index) = cells.positions.iter().position(|position| !position.iter().all(|x| x.is_finite())) {
        return Err(invalid(format!("node {}", index + 1), "finite coordinates", "others"));
    }
    for (index, element) in cells.elements.iter().enumerate() {
        let is_missing = |(place, node): (usize, u32)| node as usize >= count && (place < 4 || node != NO_NODE);
        if let Some((_, node)) = (0..NODES).zip(*element).find(|pair| is_missing(*pair)) {
            return Err(invalid(format!("element {}", index + 1), format!("one of {count} nodes"), node));
        }
        let middles = element[4..].iter().filter(|node| **node != NO_NODE).count();
        if middles != 0 && middles != EDGES.len() {
            return Err(invalid(format!("element {}", index + 1), "4 or 10 nodes", 4 + middles));
        }
    }
    Ok(())
}

/// Removes elements that occur twice, and those with a corner that occurs twice, which have no volume and whose two other
/// faces are one.
fn remove_repeated_elements(cells: &mut VolumeCells) {
    let mut known = HashSet::new();
    let (mut repeated, mut collapsed) = (0, 0);
    let keep: Vec<bool> = cells
        .elements
        .iter()
        .map(|element| {
            let mut corners = [element[0], element[1], element[2], element[3]];
            corners.sort_unstable();
            let is_collapsed = corners.windows(2).any(|pair| pair[0] == pair[1]);
            let is_new = known.insert(corners);
            collapsed += usize::from(is_collapsed);
            repeated += usize::from(!is_collapsed && !is_new);
            !is_collapsed && is_new
        })
        .collect();
    let mut flags = keep.iter();
    cells.elements.retain(|_| flags.next() == Some(&true));
    let mut flags = keep.iter();
    cells.element_groups.retain(|_| flags.next() == Some(&true));
    if repeated > 0 {
        cells.remarks.push(format!("{} left out, because others have the same corners", counted(repeated, "element")));
    }
    if collapsed > 0 {
        cells
            .remarks
            .push(format!("{} with a repeated corner left out, without volume", counted(collapsed, "element")));
    }
}

/// Mirrors the numbering of elements with a negative volume. Returns their number.
///
/// # Errors
/// `Invalid` for flat elements.
fn orient(cells: &mut VolumeCells) -> Result<usize> {
    let (mut mirrored, mut flat) = (0, Vec::new());
    for element in &mut cells.elements {
        let corners: [Vector3<f64>; 4] = std::array::from_fn(|corner| cells.positions[element[corner] as usize]);
        let volume = tet10::signed_volume(corners);
        let longest = EDGES.map(|[a, b]| (corners[b] - corners[a]).norm()).into_iter().fold(0.0, f64::max);
        if volume.abs() <= MIN_VOLUME * longest.powi(3) {
            flat.push(corners[0]);
        } else if volume < 0.0 {
            *element = MIRRORED.map(|node| element[node]);
            mirrored += 1;
        }
    }
    match flat.first() {
        None => Ok(mirrored),
        Some(first) => {
            let given = format!("{} flat ones, the first at {}", flat.len(), format_position(*first));
            let expected =
                "elements with a volume (`gmsh part.step -3 -order 2 -optimize_netgen -o part.msh` makes good ones)";
            Err(invalid("mesh", expected, given))
        }
    }
}

/// The elements at each face. `mirrored` is the number of elements that had the other orientation.
///
/// # Errors
/// `Invalid` for faces with more than two elements, or with two on the same side.
fn match_faces(elements: &[[u32; NODES]], mirrored: usize) -> Result<FaceMap> {
    let mut map = FaceMap::new();
    for (index, element) in elements.iter().enumerate() {
        for (face, corners) in FACES.iter().enumerate() {
            let nodes = corners.map(|corner| element[corner]);
            let mut sorted = nodes;
            sorted.sort_unstable();
            let [a, b, c] = sorted;
            let is_even = [[a, b, c], [b, c, a], [c, a, b]].contains(&nodes);
            map.entry(sorted).or_default().push(FaceSide { element: index as u32, face: face as u8, is_even });
        }
    }
    let crowded = map.values().filter(|sides| sides.len() > 2).count();
    if crowded > 0 {
        return Err(invalid("mesh", "at most two elements at a face", format!("{crowded} faces with more")));
    }
    // Neighbors see their common face from opposite sides.
    let folded = map.values().filter(|sides| matches!(sides[..], [a, b] if a.is_even == b.is_even)).count();
    if folded > 0 {
        let inverted = mirrored.min(elements.len() - mirrored);
        let expected = "elements on both sides of their common faces";
        let given = format!("{folded} faces with both on one side: elements overlap, or are inverted ({inverted})");
        return Err(invalid("mesh", expected, given));
    }
    Ok(map)
}

/// Faces with one element, in the order of the elements.
fn boundary_of(elements_of_face: &FaceMap) -> Vec<(u32, u8)> {
    let single = elements_of_face.values().filter(|sides| sides.len() == 1);
    let mut faces: Vec<(u32, u8)> = single.map(|sides| (sides[0].element, sides[0].face)).collect();
    faces.sort_unstable();
    faces
}

/// Gives linear elements nodes in the middles of their edges. Returns the number of these elements.
fn add_middle_nodes(cells: &mut VolumeCells) -> usize {
    let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
    let mut different = 0;
    let edge_of = |element: &[u32; NODES], edge: usize| {
        let [a, b] = EDGES[edge].map(|corner| element[corner]);
        [a.min(b), a.max(b)]
    };
    let is_linear = |element: &[u32; NODES]| element[4] == NO_NODE;
    for element in cells.elements.iter_mut().filter(|element| !is_linear(element)) {
        for edge in 0..EDGES.len() {
            let middle = *middles.entry(edge_of(element, edge)).or_insert(element[4 + edge]);
            different += usize::from(middle != element[4 + edge]);
            element[4 + edge] = middle;
        }
    }
    let mut raised = 0;
    let mut new_middles = Vec::new();
    for element in cells.elements.iter_mut().filter(|element| is_linear(element)) {
        raised += 1;
        for edge in 0..EDGES.len() {
            let [a, b] = edge_of(element, edge);
            element[4 + edge] = *middles.entry([a, b]).or_insert_with(|| {
                cells.positions.push((cells.positions[a as usize] + cells.positions[b as usize]) / 2.0);
                new_middles.push(([a, b], cells.positions.len() as u32 - 1));
                cells.positions.len() as u32 - 1
            });
        }
    }
    // A linear edge is at rest if both of its ends are.
    for group in &mut cells.node_groups {
        let ends: HashSet<u32> = group.nodes.iter().copied().collect();
        let has_ends = |edge: &[u32; 2]| edge.iter().all(|end| ends.contains(end));
        group.nodes.extend(new_middles.iter().filter(|(edge, _)| has_ends(edge)).map(|(_, middle)| *middle));
    }
    if different > 0 {
        cells.remarks.push(format!("{} with several middle nodes; one of each is used", counted(different, "edge")));
    }
    raised
}

/// Removes nodes without elements, and numbers the others in their order.
fn remove_unused_nodes(cells: &mut VolumeCells) {
    let mut number = vec![NO_NODE; cells.positions.len()];
    cells.elements.as_flattened().iter().for_each(|node| number[*node as usize] = 0);
    let mut positions = Vec::new();
    for (number, position) in number.iter_mut().zip(&cells.positions).filter(|(number, _)| **number == 0) {
        *number = positions.len() as u32;
        positions.push(*position);
    }
    let unused = number.len() - positions.len();
    if unused > 0 {
        cells.remarks.push(format!("{} without elements left out", counted(unused, "node")));
    }
    cells.positions = positions;
    cells.elements.iter_mut().flatten().for_each(|node| *node = number[*node as usize]);
    for group in &mut cells.node_groups {
        group.nodes = group.nodes.iter().filter_map(|node| number.get(*node as usize).copied()).collect();
        group.nodes.retain(|node| *node != NO_NODE);
        group.nodes.sort_unstable();
        group.nodes.dedup();
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Six tetrahedra of a unit cube around its diagonal, with corners of 0 and 1 per axis.
    pub(crate) fn cube() -> VolumeCells {
        let positions = (0..8).map(|corner| Vector3::from_fn(|axis, _| f64::from(corner >> axis & 1_i32))).collect();
        let paths = [[1, 2, 4], [2, 1, 4], [2, 4, 1], [4, 2, 1], [4, 1, 2], [1, 4, 2]];
        let element = |path: &[u32; 3]| {
            let mut element = [NO_NODE; NODES];
            element[..4].copy_from_slice(&[0, path[0], path[0] + path[1], 7]);
            element
        };
        VolumeCells {
            positions,
            elements: paths.iter().map(element).collect(),
            element_groups: vec![0; 6],
            groups: vec![ElementGroup { name: "cube".into(), material: None }],
            ..VolumeCells::default()
        }
    }

    /// Both meshes in one, the second one moved.
    pub(crate) fn joined(first: &VolumeCells, second: &VolumeCells, offset: [f64; 3]) -> VolumeCells {
        let mut cells = first.clone();
        let start = cells.positions.len() as u32;
        cells.positions.extend(second.positions.iter().map(|position| position + Vector3::from(offset)));
        let shifted = |node: u32| if node == NO_NODE { node } else { node + start };
        cells.elements.extend(second.elements.iter().map(|element| element.map(shifted)));
        cells.element_groups.extend(&second.element_groups);
        cells
    }

    fn error_of(cells: VolumeCells) -> String {
        VolumeMesh::new(cells).expect_err("expected an error").to_string()
    }

    #[test]
    fn linear_elements_are_raised_and_have_a_closed_surface() {
        let mut cells = cube();
        // A node that no element uses, before the others.
        cells.positions.insert(0, Vector3::repeat(9.0));
        cells.elements.iter_mut().flatten().filter(|node| **node != NO_NODE).for_each(|node| *node += 1);
        cells.node_groups.push(NodeGroup { name: "edge".into(), nodes: vec![0, 1, 2] });
        let mesh = VolumeMesh::new(cells).expect("a mesh");
        assert_eq!((mesh.raised_elements, mesh.part_count, mesh.hinged_pieces), (6, 1, 0));
        // 8 corners, 12 edges, 6 diagonals of faces and one of the cube.
        assert_eq!((mesh.positions.len(), mesh.boundary_faces.len()), (27, 12));
        assert!((mesh.volume() - 1.0).abs() < 1e-14);
        assert_eq!(mesh.remarks, ["1 node without elements left out"]);
        let held: Vec<[f64; 3]> =
            mesh.node_groups[0].nodes.iter().map(|node| mesh.positions[*node as usize].into()).collect();
        assert_eq!(held, [[0.0; 3], [1.0, 0.0, 0.0], [0.5, 0.0, 0.0]], "both ends and the middle of an edge");
        let area_sum: Vector3<f64> = mesh
            .boundary_faces
            .iter()
            .map(|face| {
                let [a, b, c, ab, ..] = mesh.face_nodes(*face).map(|node| mesh.positions[node as usize]);
                assert!((f64::midpoint(1.0, 0.0) * (a + b) - ab).norm() < 1e-15);
                let area = (b - a).cross(&(c - a));
                assert!(area.dot(&(a - Vector3::repeat(0.5))) > 0.0, "outward");
                area
            })
            .sum();
        assert!(area_sum.norm() < 1e-14);
    }

    #[test]
    fn elements_of_either_orientation_give_the_same_mesh() {
        let expected = VolumeMesh::new(cube()).expect("a mesh");
        let mut mirrored = cube();
        mirrored.elements.iter_mut().for_each(|element| *element = MIRRORED.map(|node| element[node]));
        let mesh = VolumeMesh::new(mirrored).expect("a mesh");
        assert_eq!(mesh.elements, expected.elements);
        // Quadratic elements: their middles move with the corners.
        let quadratic = |elements: Vec<[u32; NODES]>| VolumeCells {
            positions: expected.positions.clone(),
            elements,
            element_groups: vec![0; 6],
            groups: expected.groups.clone(),
            ..VolumeCells::default()
        };
        let other: Vec<[u32; NODES]> =
            expected.elements.iter().map(|element| MIRRORED.map(|node| element[node])).collect();
        let mesh = VolumeMesh::new(quadratic(other)).expect("a mesh");
        assert_eq!((mesh.elements, mesh.raised_elements), (expected.elements.clone(), 0));
        let mut wrong = expected.elements.clone();
        wrong.iter_mut().for_each(|element| element.swap(4, 9));
        let error = error_of(quadratic(wrong));
        assert!(error.contains("6 inverted ones"), "{error}");
    }

    #[test]
    fn repeated_and_collapsed_elements_are_left_out_with_a_remark() {
        let mut cells = cube();
        let mut turned = cells.elements[2];
        turned[..4].rotate_left(1);
        let mut collapsed = cells.elements[3];
        collapsed[1] = collapsed[0];
        cells.elements.extend([turned, collapsed]);
        cells.element_groups.extend([0, 0]);
        let mesh = VolumeMesh::new(cells).expect("a mesh");
        assert_eq!(mesh.elements.len(), 6);
        assert_eq!(mesh.remarks.len(), 2, "{:?}", mesh.remarks);
        assert!(
            mesh.remarks[0].starts_with("1 element left out")
                && mesh.remarks[1].starts_with("1 element with a repeated")
        );
    }

    #[test]
    fn invalid_elements_are_counted_in_errors() {
        let mut flat = cube();
        flat.positions[7] = Vector3::new(1.0, 1.0, 0.0);
        assert!(error_of(flat).contains("2 flat ones"));
        // Node 7 on the other side of the faces of two elements.
        let mut inverted = cube();
        inverted.positions[1] = Vector3::new(-0.2, 1.2, 1.2);
        let error = error_of(inverted);
        assert!(error.contains("with both on one side"), "{error}");
        let mut crowded = cube();
        let mut extra = crowded.elements[0];
        crowded.positions.push(Vector3::new(2.0, 3.0, -4.0));
        extra[0] = 8;
        crowded.elements.push(extra);
        // A third element at an inner face.
        let mut third = crowded.elements[0];
        third[1] = 8;
        crowded.elements.push(third);
        crowded.element_groups.extend([0, 0]);
        assert!(error_of(crowded).contains("faces with more"));
        let mut missing = cube();
        missing.elements[4][2] = 8;
        assert_eq!(error_of(missing), "element 5: expected one of 8 nodes, got 8");
        let mut partly_quadratic = cube();
        partly_quadratic.elements[0][6] = 3;
        assert!(error_of(partly_quadratic).contains("4 or 10 nodes, got 5"));
        let mut infinite = cube();
        infinite.positions[3].y = f64::INFINITY;
        assert!(error_of(infinite).contains("node 4"));
        assert!(error_of(VolumeCells::default()).contains("at least one tetrahedron"));
    }

    #[test]
    fn parts_hinges_and_coincident_nodes_are_found() {
        let apart = VolumeMesh::new(joined(&cube(), &cube(), [3.0, 0.0, 0.0])).expect("a mesh");
        assert_eq!((apart.part_count, apart.hinged_pieces, apart.remarks.len()), (2, 0, 0));
        let touching = VolumeMesh::new(joined(&cube(), &cube(), [1.0, 0.0, 0.0])).expect("a mesh");
        assert_eq!(touching.part_count, 2);
        assert!(touching.remarks[0].starts_with("9 nodes at the position"), "{:?}", touching.remarks);
        // The cubes share one corner.
        let mut hinged = joined(&cube(), &cube(), [1.0; 3]);
        hinged.elements.iter_mut().flatten().filter(|node| **node == 8).for_each(|node| *node = 7);
        let hinged = VolumeMesh::new(hinged).expect("a mesh");
        assert_eq!((hinged.part_count, hinged.hinged_pieces), (1, 1));
        assert!(hinged.remarks.iter().any(|remark| remark.contains("swinging is possible")), "{:?}", hinged.remarks);
    }
}
