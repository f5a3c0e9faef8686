//! The pose of a skinned mesh: each vertex is moved by the weighted sum of the matrices of its joints. The transform of the
//! node with the mesh has no effect, as the specification says.

use nalgebra::{Matrix3, Matrix4, Vector3};

use super::accessor::{AccessorReader, AttributeFormat, ComponentTypes};
use super::document::Primitive;
use super::get_element;
use crate::error::{Result, invalid};

/// The matrices of a skin in the pose of the file: world from joint, times the inverse bind matrix.
pub(super) fn joint_matrices(
    reader: AccessorReader<'_>,
    skin: usize,
    world_of_node: impl Fn(usize) -> Option<Matrix4<f64>>,
) -> Result<Vec<Matrix4<f64>>> {
    let skin_field = |error: crate::error::Error| error.prefix_field(&format!("skins[{skin}]"));
    let skin = get_element(&reader.document.skins, skin, "skin")?;
    let joint_count = skin.joints.len();
    let inverse_bind_matrices = match skin.inverse_bind_matrices {
        Some(accessor) => {
            let format = AttributeFormat { components: ComponentTypes::Floats, count: Some(joint_count) };
            let columns = reader.decode_vectors::<16>(accessor, format).map_err(skin_field)?;
            columns.iter().map(|columns| Matrix4::from_column_slice(columns).cast::<f64>()).collect()
        }
        None => vec![Matrix4::identity(); joint_count],
    };
    let joints = skin.joints.iter().zip(inverse_bind_matrices).enumerate();
    joints
        .map(|(index, (node, inverse_bind))| {
            let world = world_of_node(*node);
            let field = || invalid(format!("joints[{index}]"), "a node of the scene", node);
            Ok(world.ok_or_else(field).map_err(skin_field)? * inverse_bind)
        })
        .collect()
}

/// The blended matrix of each vertex of a primitive.
#[derive(Debug)]
pub(super) struct Pose {
    matrices: Vec<Matrix4<f64>>,
}

impl Pose {
    /// Blends the matrices of the joints by the weights of the vertices. Weights are normalized. A vertex without weights is
    /// not moved.
    ///
    /// # Errors
    /// `Invalid` with the attribute for a joint that does not exist.
    pub(super) fn read(
        reader: AccessorReader<'_>,
        primitive: &Primitive,
        joint_matrices: &[Matrix4<f64>],
        vertex_count: usize,
    ) -> Result<Self> {
        // 16 f64 and a sum of weights.
        reader.buffers.charge_budget(136 * vertex_count as u64)?;
        let mut matrices = vec![Matrix4::zeros(); vertex_count];
        let mut weight_sums = vec![0.0; vertex_count];
        for set in 0.. {
            let names = [format!("JOINTS_{set}"), format!("WEIGHTS_{set}")];
            let [Some(joints), Some(weights)] = names.each_ref().map(|name| primitive.attributes.get(name)) else {
                break;
            };
            let format = |components| AttributeFormat { components, count: Some(vertex_count) };
            let in_attribute = |name: &str| {
                let field = format!("attributes.{name}");
                move |error: crate::error::Error| error.prefix_field(&field)
            };
            let joints = reader.decode_vectors::<4>(*joints, format(ComponentTypes::Indices));
            let joints = joints.map_err(in_attribute(&names[0]))?;
            let weights = reader.decode_vectors::<4>(*weights, format(ComponentTypes::UnitInterval));
            let weights = weights.map_err(in_attribute(&names[1]))?;
            for (vertex, (joints, weights)) in joints.iter().zip(weights).enumerate() {
                for (joint, weight) in joints.iter().zip(weights) {
                    let weight = f64::from(weight);
                    if !(weight.is_finite() && weight > 0.0) {
                        continue;
                    }
                    let matrix = joint_matrices.get(*joint as usize).ok_or_else(|| {
                        let field = format!("attributes.{}: element {vertex}", names[0]);
                        invalid(field, format!("a joint below {}", joint_matrices.len()), joint)
                    })?;
                    matrices[vertex] += matrix * weight;
                    weight_sums[vertex] += weight;
                }
            }
        }
        for (matrix, sum) in matrices.iter_mut().zip(weight_sums) {
            *matrix = if sum > 0.0 { *matrix / sum } else { Matrix4::identity() };
        }
        Ok(Self { matrices })
    }

    fn linear(&self, vertex: usize) -> Matrix3<f64> {
        self.matrices[vertex].fixed_view::<3, 3>(0, 0).into_owned()
    }

    /// Moves the positions of all vertices.
    pub(super) fn move_positions(&self, positions: &mut [[f32; 3]]) {
        for (vertex, position) in positions.iter_mut().enumerate() {
            let translation = self.matrices[vertex].fixed_view::<3, 1>(0, 3).into_owned();
            *position = (self.linear(vertex) * Vector3::from(*position).cast() + translation).cast::<f32>().into();
        }
    }

    /// Moves displacements of all vertices.
    pub(super) fn move_displacements(&self, displacements: &mut [[f32; 3]]) {
        for (vertex, displacement) in displacements.iter_mut().enumerate() {
            *displacement = (self.linear(vertex) * Vector3::from(*displacement).cast()).cast::<f32>().into();
        }
    }

    /// Moves normals of all vertices by the cofactors of the matrices, so that they remain perpendicular to the surface.
    pub(super) fn move_normals(&self, normals: &mut [[f32; 3]]) {
        for (vertex, normal) in normals.iter_mut().enumerate() {
            let linear = self.linear(vertex);
            let [x, y, z] = [0, 1, 2].map(|column| linear.column(column).into_owned());
            let cofactors = Matrix3::from_columns(&[y.cross(&z), z.cross(&x), x.cross(&y)]);
            let moved = cofactors * Vector3::from(*normal).cast();
            *normal = moved.try_normalize(0.0).unwrap_or_default().cast::<f32>().into();
        }
    }
}
