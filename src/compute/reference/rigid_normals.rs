//! Rigid normals, transformed by the inverse transpose of A, and tangents, transformed by A. A is the linear part of T.
//! Normals and tangents have unit length.
//! Twin of `kernels/rigid_normals.cuh`.

use nalgebra::{Matrix3, Vector3};

use modalcast_model::scene::{Scene, SceneState};

/// World unit normals, one per corner. If A is singular, the cofactors of A still give the direction. A normal that the
/// cofactors map to zero becomes +Z.
pub fn rigid_normals(scene: &Scene, state: &SceneState) -> Vec<[f64; 3]> {
    let mut normals = Vec::with_capacity(scene.layout.corners);
    for domain in 0..scene.domains.len() {
        let linear = state.composed_transform(scene, domain).linear();
        // The inverse transpose is the cofactor matrix over the determinant; only the determinant's sign survives
        // normalization.
        let normal_transform = cofactors(&linear) * linear.determinant().signum();
        for normal in &scene.shape_of(domain).mesh.corners().normals {
            normals.push(normalize_or_z(normal_transform * Vector3::from(*normal).cast::<f64>()).into());
        }
    }
    normals
}

/// World unit tangents and bitangent signs, one per corner; empty when the scene has no normal map. A shape without
/// tangents gives zeros. A mirroring A flips the sign.
pub fn rigid_tangents(scene: &Scene, state: &SceneState) -> Vec<[f64; 4]> {
    if !scene.features.normal_maps {
        return Vec::new();
    }
    let mut tangents = Vec::with_capacity(scene.layout.corners);
    for domain in 0..scene.domains.len() {
        let shape = scene.shape_of(domain);
        let linear = state.composed_transform(scene, domain).linear();
        let determinant_sign = linear.determinant().signum();
        for corner in 0..shape.mesh.corners().vertices.len() {
            let Some([x, y, z, sign]) = shape.tangents().get(corner) else {
                tangents.push([0.0; 4]);
                continue;
            };
            let tangent = normalize_or_z(linear * Vector3::new(*x, *y, *z).cast::<f64>());
            tangents.push([tangent.x, tangent.y, tangent.z, f64::from(*sign) * determinant_sign]);
        }
    }
    tangents
}

/// The cofactors of A: its determinant times its inverse transpose.
pub(super) fn cofactors(linear: &Matrix3<f64>) -> Matrix3<f64> {
    let [a, b, c] = [0, 1, 2].map(|row| linear.row(row).transpose());
    Matrix3::from_rows(&[b.cross(&c).transpose(), c.cross(&a).transpose(), a.cross(&b).transpose()])
}

/// A vector divided by its length; +Z if the length is at most 1e-300, so that no division overflows.
fn normalize_or_z(vector: Vector3<f64>) -> Vector3<f64> {
    vector.try_normalize(1e-300).unwrap_or_else(Vector3::z)
}
