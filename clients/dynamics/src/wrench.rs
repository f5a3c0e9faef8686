//! Vectors of six numbers: a force and its moment, or a translation and a rotation vector.

use nalgebra::{Vector3, Vector6};

/// Stacks two vectors.
pub(crate) fn stack(upper: &Vector3<f64>, lower: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(upper.x, upper.y, upper.z, lower.x, lower.y, lower.z)
}

/// Splits a vector of six numbers into two.
pub(crate) fn split(vector: &Vector6<f64>) -> (Vector3<f64>, Vector3<f64>) {
    (vector.fixed_rows::<3>(0).into_owned(), vector.fixed_rows::<3>(3).into_owned())
}
