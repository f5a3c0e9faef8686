//! Flattens the node hierarchy to a list of nodes with f64 matrices, parents before children. The node graph must be a
//! forest. The traversal uses an explicit stack, so that deep hierarchies cannot overflow the call stack.

use nalgebra::{Matrix4, Quaternion, Rotation3, Scale3, Translation3, UnitQuaternion};

use super::document::{Document, Node};
use super::get_element;
use super::remarks::ImportRemarks;
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

/// Lists all nodes of the default scene. Without a default scene, these are the nodes of the first scene; without
/// scenes, all nodes of the document.
///
/// # Errors
/// `Invalid` with the node that has two parents, is its own ancestor or has an invalid transform.
pub(super) fn flatten_hierarchy(document: &Document, remarks: &mut ImportRemarks) -> Result<Vec<PlacedNode>> {
    let parents = find_parents(document)?;
    let roots: Vec<usize> = (0..parents.len()).filter(|node| parents[*node].is_none()).collect();
    let all_nodes = preorder(&document.nodes, &roots);
    if all_nodes.len() < parents.len() {
        let mut is_reachable = vec![false; parents.len()];
        all_nodes.iter().for_each(|(node, _)| is_reachable[*node] = true);
        let unreachable = is_reachable.iter().position(|reachable| !reachable).unwrap_or_default();
        return Err(invalid(format!("nodes[{unreachable}].children"), "a tree", "a cycle"));
    }
    let Some(scene) = document.scene.or((!document.scenes.is_empty()).then_some(0)) else {
        return compute_matrices(document, &all_nodes);
    };
    let root_nodes = &get_element(&document.scenes, scene, "scene")?.nodes;
    if document.scenes.len() > 1 {
        remarks.add(format!("only scene {scene} of {} scenes is loaded", document.scenes.len()));
    }
    check_roots(root_nodes, &parents).map_err(|error| error.prefix_field(&format!("scenes[{scene}]")))?;
    compute_matrices(document, &preorder(&document.nodes, root_nodes))
}

/// The parent of each node.
fn find_parents(document: &Document) -> Result<Vec<Option<usize>>> {
    let count = document.nodes.len();
    let mut parents = vec![None; count];
    for (parent, node) in document.nodes.iter().enumerate() {
        for (child_index, child) in node.children.iter().enumerate() {
            let field = || format!("nodes[{parent}].children[{child_index}]");
            match parents.get_mut(*child) {
                None => return Err(invalid(field(), format!("an index below {count}"), child)),
                Some(Some(other_parent)) => {
                    let given = format!("node {child}, a child of node {other_parent}");
                    return Err(invalid(field(), "a node without another parent", given));
                }
                Some(child_parent) => *child_parent = Some(parent),
            }
        }
    }
    Ok(parents)
}

/// Checks that the root nodes of a scene exist, have no parent and are different.
fn check_roots(root_nodes: &[usize], parents: &[Option<usize>]) -> Result<()> {
    let mut is_listed = vec![false; parents.len()];
    for (root_index, node) in root_nodes.iter().enumerate() {
        let field = || format!("nodes[{root_index}]");
        match parents.get(*node) {
            None => return Err(invalid(field(), format!("an index below {}", parents.len()), node)),
            Some(Some(parent)) => {
                return Err(invalid(
                    field(),
                    "a node without a parent",
                    format!("node {node}, a child of node {parent}"),
                ));
            }
            Some(None) if is_listed[*node] => {
                return Err(invalid(field(), "different nodes", format!("node {node} twice")));
            }
            Some(None) => is_listed[*node] = true,
        }
    }
    Ok(())
}

/// Indices of nodes in depth-first order, parents before children, with the position of the parent in this list. No
/// node is listed twice, because each has at most one parent.
fn preorder(nodes: &[Node], roots: &[usize]) -> Vec<(usize, Option<usize>)> {
    let mut order = Vec::new();
    let mut stack: Vec<(usize, Option<usize>)> = roots.iter().rev().map(|root| (*root, None)).collect();
    while let Some(node_and_parent) = stack.pop() {
        let position = order.len();
        order.push(node_and_parent);
        stack.extend(nodes[node_and_parent.0].children.iter().rev().map(|child| (*child, Some(position))));
    }
    order
}

fn compute_matrices(document: &Document, order: &[(usize, Option<usize>)]) -> Result<Vec<PlacedNode>> {
    let mut placed_nodes: Vec<PlacedNode> = Vec::with_capacity(order.len());
    for (node, parent) in order.iter().copied() {
        let local =
            local_matrix(&document.nodes[node]).map_err(|error| error.prefix_field(&format!("nodes[{node}]")))?;
        let world = parent.map_or(local, |parent| placed_nodes[parent].world * local);
        placed_nodes.push(PlacedNode { node, parent, local, world });
    }
    Ok(placed_nodes)
}

/// `parent_from_node`: the matrix, or translation x rotation x scale.
fn local_matrix(node: &Node) -> Result<Matrix4<f64>> {
    if let Some(matrix) = node.matrix {
        let matrix = Matrix4::from_column_slice(&matrix);
        let last_row = matrix.row(3).into_owned();
        // The tolerance accepts the f32 rounding of exporters and rejects perspective matrices.
        if (last_row - nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0)).amax() > 1e-5 {
            let given: Vec<f64> = last_row.iter().copied().collect();
            return Err(invalid("matrix", "a last row of 0, 0, 0, 1", format!("{given:?}")));
        }
        return Ok(matrix);
    }
    let [x, y, z, w] = node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
    let rotation = Quaternion::new(w, x, y, z);
    // The quaternion is normalized below. The tolerance accepts the rounding of all exporters and rejects zeros.
    if !(0.9..=1.1).contains(&rotation.norm()) {
        return Err(invalid("rotation", "a quaternion of length 1", format!("length {}", rotation.norm())));
    }
    let rotation = Rotation3::from(UnitQuaternion::from_quaternion(rotation)).to_homogeneous();
    let translation = Translation3::from(node.translation.unwrap_or_default()).to_homogeneous();
    let scale = Scale3::from(node.scale.unwrap_or([1.0; 3])).to_homogeneous();
    Ok(translation * rotation * scale)
}
