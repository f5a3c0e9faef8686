//! Tangents of a mesh at rest, after E. Lengyel, "Mathematics for 3D Game Programming and Computer Graphics".

use nalgebra::Vector3;

use super::Mesh;

/// Per corner, the unit tangent, orthogonal to the normal, and the sign of the bitangent.
///
/// Each triangle adds the derivatives of its position along u and v to its three corners. The sum along u is
/// orthogonalized against the normal. A corner without usable derivatives (no texture coordinates, or no area) has an
/// arbitrary unit tangent orthogonal to its normal, and a positive sign.
pub(super) fn lengyel_tangents(mesh: &Mesh) -> Vec<[f32; 4]> {
    let corners = mesh.corners();
    let mut tangent_sums = vec![Vector3::<f64>::zeros(); corners.vertices.len()];
    let mut bitangent_sums = tangent_sums.clone();
    if !corners.uvs.is_empty() {
        for triangle in mesh.triangles() {
            if let Some((tangent, bitangent)) = uv_gradients(mesh, *triangle) {
                for corner in triangle {
                    tangent_sums[*corner as usize] += tangent;
                    bitangent_sums[*corner as usize] += bitangent;
                }
            }
        }
    }
    let tangent_of = |corner: usize| {
        let normal = Vector3::from(corners.normals[corner]).cast();
        orthogonalize(normal, tangent_sums[corner], bitangent_sums[corner])
    };
    (0..corners.vertices.len()).map(tangent_of).collect()
}

/// Derivatives of the position along u and along v over one triangle. `None` if the triangle has no area in (u, v).
fn uv_gradients(mesh: &Mesh, triangle: [u32; 3]) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let corners = mesh.corners();
    let position =
        |corner: u32| Vector3::from(mesh.rest_positions()[corners.vertices[corner as usize] as usize]).cast::<f64>();
    let uv = |corner: u32| corners.uvs[corner as usize].map(f64::from);
    let [a, b, c] = triangle;
    let (edge1, edge2) = (position(b) - position(a), position(c) - position(a));
    // (s, t): each edge in texture coordinates, in Lengyel's notation. t has the opposite sign of v, because v of a
    // corner points downwards in the image, and the tangent frame of a normal map has v upwards.
    let (s1, t1) = (uv(b)[0] - uv(a)[0], uv(a)[1] - uv(b)[1]);
    let (s2, t2) = (uv(c)[0] - uv(a)[0], uv(a)[1] - uv(c)[1]);
    let uv_area = s1 * t2 - s2 * t1;
    let inverse_area = 1.0 / uv_area;
    inverse_area
        .is_finite()
        .then(|| ((edge1 * t2 - edge2 * t1) * inverse_area, (edge2 * s1 - edge1 * s2) * inverse_area))
}

/// The tangent, orthogonalized against the normal, and the sign of the bitangent.
fn orthogonalize(normal: Vector3<f64>, tangent: Vector3<f64>, bitangent: Vector3<f64>) -> [f32; 4] {
    // A tangent shorter than 1e-20 counts as zero.
    let projected = (tangent - normal * normal.dot(&tangent)).try_normalize(1e-20);
    let (unit_tangent, sign) = match projected {
        Some(unit_tangent) if normal.cross(&unit_tangent).dot(&bitangent) < 0.0 => (unit_tangent, -1.0),
        Some(unit_tangent) => (unit_tangent, 1.0),
        None => (any_orthogonal(normal), 1.0),
    };
    [unit_tangent.x as f32, unit_tangent.y as f32, unit_tangent.z as f32, sign]
}

/// A unit vector orthogonal to the unit vector `normal`.
fn any_orthogonal(normal: Vector3<f64>) -> Vector3<f64> {
    // An axis that is not nearly parallel to `normal`.
    let axis = if normal.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    normal.cross(&axis).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(uvs: Vec<[f32; 2]>) -> Mesh {
        let rest_positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, 1.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]).expect("a square")
    }

    #[test]
    fn mirrored_texture_coordinates_flip_tangent_and_sign() {
        let upright = square(vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]);
        assert_eq!(lengyel_tangents(&upright), [[1.0, 0.0, 0.0, 1.0]; 4]);
        let mirrored = square(vec![[1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [1.0, 0.0]]);
        assert_eq!(lengyel_tangents(&mirrored), [[-1.0, 0.0, 0.0, -1.0]; 4]);
    }

    #[test]
    fn missing_and_degenerate_uvs_give_unit_tangents() {
        for mesh in [square(vec![]), square(vec![[0.5, 0.5]; 4])] {
            for [x, y, z, sign] in lengyel_tangents(&mesh) {
                let length = (x * x + y * y + z * z).sqrt();
                assert!((length - 1.0).abs() < 1e-6, "length {length}");
                assert!((z.abs() < 1e-6) && (sign == 1.0), "expected z = 0 and sign 1, got z = {z} and sign {sign}");
            }
        }
    }
}
