//! Ways in which a client computes and encodes the transform T of each step.

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};

use modalcast_model::domain::Transform;
use modalcast_model::scene::TransformFormat;

/// Rotation of each step about [`AXIS`], radians.
const STEP_ANGLE: f64 = 0.1;
/// Unit vector.
const AXIS: Vector3<f64> = Vector3::new(2.0 / 7.0, 3.0 / 7.0, 6.0 / 7.0);

/// The exact rotation after a number of steps.
pub(super) fn exact_rotation(steps: u64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(AXIS * (STEP_ANGLE * steps as f64))
}

/// How a client computes T. Products hold the rotation of the previous step.
#[derive(Debug, Clone)]
pub(super) enum SentTransform {
    /// A quaternion in f32 and a translation in f64, both from the exact pose of the step.
    QuaternionF64,
    /// The matrix of the exact pose of the step, rounded to f32 as `clients/dynamics` does.
    MatrixF64,
    /// The rotation is multiplied by that of one step, in f32.
    ProductF32(Matrix3<f32>),
    /// As `ProductF32`, made orthonormal by the Gram-Schmidt process after each product.
    OrthonormalF32(Matrix3<f32>),
    /// The rotation is multiplied by that of one step in f64. A rounded copy is sent.
    ProductF64(Matrix3<f64>),
}

impl SentTransform {
    pub(super) const fn format(&self) -> TransformFormat {
        match self {
            Self::QuaternionF64 => TransformFormat::QuaternionXyzwF64,
            _ => TransformFormat::Affine,
        }
    }

    /// Advances by one step to the exact pose `pose`, and returns the encoded T.
    pub(super) fn advance(&mut self, pose: &Isometry3<f64>) -> Vec<u8> {
        let step_rotation = exact_rotation(1).to_rotation_matrix().into_inner();
        let linear: Matrix3<f64> = match self {
            Self::QuaternionF64 => {
                let (rotation, translation) = (pose.rotation.coords.cast::<f32>(), pose.translation.vector);
                let parts = [bytemuck::cast_slice(rotation.as_slice()), bytemuck::cast_slice(translation.as_slice())];
                return parts.concat();
            }
            Self::MatrixF64 => pose.rotation.to_rotation_matrix().into_inner(),
            Self::ProductF32(linear) => {
                *linear = step_rotation.cast::<f32>() * *linear;
                linear.cast()
            }
            Self::OrthonormalF32(linear) => {
                *linear = orthonormalize(&(step_rotation.cast::<f32>() * *linear));
                linear.cast()
            }
            Self::ProductF64(linear) => {
                *linear = step_rotation * *linear;
                *linear
            }
        };
        bytemuck::cast_slice(&Transform::from_parts(&linear, &pose.translation.vector).0).to_vec()
    }
}

/// The rotation whose first column is parallel to that of `matrix`, and whose second column lies in the plane of the
/// first two columns (Gram-Schmidt).
fn orthonormalize(matrix: &Matrix3<f32>) -> Matrix3<f32> {
    let x = matrix.column(0).normalize();
    let y = (matrix.column(1) - x * x.dot(&matrix.column(1))).normalize();
    Matrix3::from_columns(&[x, y, x.cross(&y)])
}
