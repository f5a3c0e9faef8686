//! Flattens the node hierarchy: nodes with f64 matrices, parents before children. The node graph must be a forest. The
//! traversal uses an explicit stack, so that deep hierarchies cannot overflow the call stack.

use nalgebra::{Matrix4, Quaternion, Rotation3, Scale3, Translation3, UnitQuaternion};

use super::document::{Document, Node};
use super::get_element;
use super::warnings::ImportWarnings;
use crate::error::{Result, invalid};

/// A node of the loaded scene.
#[derive(Debug)]
pub(super) struct PlacedNode {
    /// Index in the document.
    pub(super) node: usize,
    /// Index of the parent in the list of placed nodes.
    pub(super) parent: Option<usize>,
    /// `parent_from_node`.
    pub(super) local: Matrix4<f64>,
    /// `world_from_node`.
    pub(super) world: Matrix4<f64>,
}

/// All nodes of the default scene; without a default, of the first scene; without scenes, of the document.
///
/// # Errors
/// `Invalid` with the node that has two parents, is its own ancestor or has an invalid transform.
pub(super) fn flatten_hierarchy(document: &Document, remarks: &mut ImportWarnings) -> Result<Vec<PlacedNode>> {
    let parents = parents(document)?;
    let roots: Vec<usize> = (0..parents.len()).filter(|node| parents[*node].is_none()).collect();
    let forest = preorder(&document.nodes, &roots);
    if forest.len() < parents.len() {
        let mut reached = vec![false; parents.len()];
        forest.iter().for_each(|(node, _)| reached[*node] = true);
        let lost = reached.iter().position(|reached| !reached).unwrap_or_default();
        return Err(invalid(format!("nodes[{lost}].children"), "a tree", "a cycle: the node is its own ancestor"));
    }
    let Some(scene) = document.scene.or((!document.scenes.is_empty()).then_some(0)) else {
        return with_matrices(document, &forest);
    };
    let nodes = &get_element(&document.scenes, scene, "scene")?.nodes;
    if document.scenes.len() > 1 {
        remarks.add(format!("of {} scenes only number {scene} is loaded", document.scenes.len()));
    }
    check_roots(nodes, &parents).map_err(|error| error.prefix_field(&format!("scenes[{scene}]")))?;
    with_matrices(document, &preorder(&document.nodes, nodes))
}

/// The parent of each node.
fn parents(document: &Document) -> Result<Vec<Option<usize>>> {
    let count = document.nodes.len();
    let mut parents = vec![None; count];
    for (parent, node) in document.nodes.iter().enumerate() {
        for (flatten_hierarchy, child) in node.children.iter().enumerate() {
            let field = || format!("nodes[{parent}].children[{flatten_hierarchy}]");
            match parents.get_mut(*child) {
                None => return Err(invalid(field(), format!("an index below {count}"), child)),
                Some(Some(other)) => {
                    let expected = format!("a node without another parent than {other}");
                    return Err(invalid(field(), expected, format!("node {child}")));
                }
                Some(free) => *free = Some(parent),
            }
        }
    }
    Ok(parents)
}

fn check_roots(nodes: &[usize], parents: &[Option<usize>]) -> Result<()> {
    let mut listed = vec![false; parents.len()];
    for (flatten_hierarchy, node) in nodes.iter().enumerate() {
        let field = || format!("nodes[{flatten_hierarchy}]");
        match parents.get(*node) {
            None => return Err(invalid(field(), format!("an index below {}", parents.len()), node)),
            Some(Some(parent)) => {
                return Err(invalid(field(), "a node without a parent", format!("{node}, a child of {parent}")));
            }
            Some(None) if listed[*node] => return Err(invalid(field(), "each node once", format!("{node} again"))),
            Some(None) => listed[*node] = true,
        }
    }
    Ok(())
}

/// Nodes with the position of their parent in the result. No node is visited twice, because each has at most one
/// parent.
fn preorder(nodes: &[Node], roots: &[usize]) -> Vec<(usize, Option<usize>)> {
    let mut order = Vec::new();
    let mut stack: Vec<(usize, Option<usize>)> = roots.iter().rev().map(|root| (*root, None)).collect();
    while let Some(next) = stack.pop() {
        let flatten_hierarchy = order.len();
        order.push(next);
        stack.extend(nodes[next.0].children.iter().rev().map(|child| (*child, Some(flatten_hierarchy))));
    }
    order
}

fn with_matrices(document: &Document, order: &[(usize, Option<usize>)]) -> Result<Vec<PlacedNode>> {
    let mut placed: Vec<PlacedNode> = Vec::with_capacity(order.len());
    for (node, parent) in order.iter().copied() {
        let local = local(&document.nodes[node]).map_err(|error| error.prefix_field(&format!("nodes[{node}]")))?;
        let world = parent.map_or(local, |parent| placed[parent].world * local);
        placed.push(PlacedNode { node, parent, local, world });
    }
    Ok(placed)
}

/// `parent_from_node`: the matrix, or translation x rotation x scale.
fn local(node: &Node) -> Result<Matrix4<f64>> {
    if let Some(matrix) = node.matrix {
        let matrix = Matrix4::from_column_slice(&matrix);
        let below = matrix.row(3).into_owned();
        if (below - nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0)).amax() > 1e-5 {
            let given: Vec<f64> = below.iter().copied().collect();
            return Err(invalid("matrix", "a last row of 0, 0, 0, 1", format!("{given:?}")));
        }
        return Ok(matrix);
    }
    let [x, y, z, w] = node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
    let rotation = Quaternion::new(w, x, y, z);
    if !(0.9..=1.1).contains(&rotation.norm()) {
        return Err(invalid("rotation", "a quaternion of length 1", format!("one of length {}", rotation.norm())));
    }
    let rotation = Rotation3::from(UnitQuaternion::from_quaternion(rotation)).to_homogeneous();
    let translation = Translation3::from(node.translation.unwrap_or_default()).to_homogeneous();
    let scale = Scale3::from(node.scale.unwrap_or([1.0; 3])).to_homogeneous();
    Ok(translation * rotation * scale)
}
