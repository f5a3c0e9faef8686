//! Affine transforms between coordinate frames. The name of a transform states its target and its source:
//! `world_from_domain` maps coordinates of a domain to the world.

use nalgebra::{Matrix3, Matrix4, Vector3};

use crate::error::{Result, invalid};

/// A 3x4 row-major affine transform. The left 3x3 block is the linear part A, the last column the translation.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Transform(pub [f32; 12]);

// The kernels read transforms as three float4 rows.
const _: () = assert!(size_of::<Transform>() == 48, "Transform differs from kernels/layout.cuh");

impl Default for Transform {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Transform {
    pub const IDENTITY: Self = Self([1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);

    /// A transform from its twelve entries.
    ///
    /// # Errors
    /// `Invalid` with the entry that is not finite.
    pub fn new(entries: [f32; 12]) -> Result<Self> {
        // Without an early exit, the compiler vectorizes the check.
        if entries.iter().fold(true, |are_finite, entry| are_finite & entry.is_finite()) {
            return Ok(Self(entries));
        }
        let index = entries.iter().position(|entry| !entry.is_finite()).unwrap_or_default();
        Err(invalid(format!("transform[{index}]"), "a finite number", entries[index]))
    }

    /// A transform from its linear part and translation, rounded to f32.
    pub fn from_parts(linear: &Matrix3<f64>, translation: &Vector3<f64>) -> Self {
        let mut entries = [0.0; 12];
        for row in 0..3 {
            for column in 0..3 {
                entries[4 * row + column] = linear[(row, column)] as f32;
            }
            entries[4 * row + 3] = translation[row] as f32;
        }
        Self(entries)
    }

    /// Rounds the upper three rows of a homogeneous matrix.
    pub fn from_matrix(matrix: &Matrix4<f64>) -> Self {
        Self::from_parts(&matrix.fixed_view::<3, 3>(0, 0).into_owned(), &matrix.fixed_view::<3, 1>(0, 3).into_owned())
    }

    /// Converts to a homogeneous 4x4 matrix.
    pub fn to_matrix(self) -> Matrix4<f64> {
        let mut matrix = Matrix4::identity();
        for row in 0..3 {
            for column in 0..4 {
                matrix[(row, column)] = f64::from(self.0[4 * row + column]);
            }
        }
        matrix
    }

    /// The linear part A.
    pub fn linear(self) -> Matrix3<f64> {
        Matrix3::from_fn(|row, column| f64::from(self.0[4 * row + column]))
    }

    /// The last column, in scene units.
    pub fn translation(self) -> Vector3<f64> {
        Vector3::from_fn(|row, _| f64::from(self.0[4 * row + 3]))
    }

    /// `a_from_c = a_from_b * b_from_c`, computed in f64 and rounded once.
    pub fn compose(self, b_from_c: Self) -> Self {
        Self::from_matrix(&(self.to_matrix() * b_from_c.to_matrix()))
    }

    /// The inverse, or `None` if the linear part is singular.
    pub fn inverse(self) -> Option<Self> {
        self.to_matrix().try_inverse().map(|matrix| Self::from_matrix(&matrix))
    }

    /// Whether A is a rotation or reflection times a uniform scale s: A^T A deviates from s^2 I by at most 1e-4 s^2 per
    /// entry. Rounding A to f32 causes deviations of about 1e-7 s^2. Normals of such a domain transform like
    /// directions.
    pub fn is_similarity(self) -> bool {
        let column = |index: usize| [0, 4, 8].map(|row| f64::from(self.0[row + index]));
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let [a, b, c] = [column(0), column(1), column(2)];
        let squared_lengths = [dot(a, a), dot(b, b), dot(c, c)];
        let squared_scale = squared_lengths.iter().sum::<f64>() / 3.0;
        let limit = 1e-4 * squared_scale.max(f64::MIN_POSITIVE);
        let has_equal_scales = squared_lengths.iter().all(|length| (length - squared_scale).abs() <= limit);
        has_equal_scales && [dot(a, b), dot(a, c), dot(b, c)].iter().all(|product| product.abs() <= limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transform_times_its_inverse_is_the_identity() {
        let rotation = nalgebra::Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
        let transform = Transform::from_parts(&(rotation * 2.0), &Vector3::new(1.0, -2.0, 3.0));
        let product = transform.compose(transform.inverse().expect("an invertible transform"));
        for (actual, expected) in product.0.iter().zip(Transform::IDENTITY.0) {
            assert!((actual - expected).abs() <= 1e-6, "expected {expected}, got {actual}");
        }
        assert!(transform.is_similarity());
    }

    #[test]
    fn shear_is_no_similarity_and_zero_transform_has_no_inverse() {
        let mut entries = Transform::IDENTITY.0;
        entries[1] = 0.1;
        assert!(!Transform(entries).is_similarity());
        assert!(Transform([0.0; 12]).inverse().is_none());
    }

    #[test]
    fn infinite_entry_is_rejected_with_its_index() {
        let mut entries = Transform::IDENTITY.0;
        entries[7] = f32::INFINITY;
        let message = Transform::new(entries).expect_err("an infinite entry").to_string();
        assert!(message.starts_with("transform[7]"), "expected an error about transform[7], got {message}");
    }
}
