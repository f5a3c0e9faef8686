//! Tangents of a mesh at rest, after E. Lengyel, "Mathematics for 3D Game Programming and Computer Graphics".

use nalgebra::Vector3;

use super::Mesh;

/// Per corner, the unit tangent, orthogonal to the normal, and the sign of the bitangent.
///
/// Each triangle adds its uv gradients to its three corners; the sum is orthogonalized against the normal. A corner
/// without a usable gradient (no uv, zero area) gets an arbitrary unit vector orthogonal to its normal and a positive
/// sign.
pub(super) fn lengyel_tangents(mesh: &Mesh) -> Vec<[f32; 4]> {
    let corners = mesh.corners();
    let mut along_u = vec![Vector3::<f64>::zeros(); corners.vertices.len()];
    let mut along_v = along_u.clone();
    if !corners.uvs.is_empty() {
        for triangle in mesh.triangles() {
            if let Some((tangent, bitangent)) = gradients(mesh, *triangle) {
                for corner in triangle {
                    along_u[*corner as usize] += tangent;
                    along_v[*corner as usize] += bitangent;
                }
            }
        }
    }
    let frame = |((normal, tangent), bitangent): ((&[f32; 3], &Vector3<f64>), &Vector3<f64>)| {
        orthogonal(Vector3::from(*normal).cast(), *tangent, *bitangent)
    };
    corners.normals.iter().zip(&along_u).zip(&along_v).map(frame).collect()
}

/// Derivatives of the position along u and along v over one triangle. v points up here, as in normal maps.
fn gradients(mesh: &Mesh, triangle: [u32; 3]) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let corners = mesh.corners();
    let position =
        |corner: u32| Vector3::from(mesh.rest_positions()[corners.vertices[corner as usize] as usize]).cast::<f64>();
    let uv = |corner: u32| corners.uvs[corner as usize].map(f64::from);
    let [a, b, c] = triangle;
    let (edge1, edge2) = (position(b) - position(a), position(c) - position(a));
    // Corners store v downwards from the top of the image; the tangent frame of a normal map has v upwards.
    let (s1, t1) = (uv(b)[0] - uv(a)[0], uv(a)[1] - uv(b)[1]);
    let (s2, t2) = (uv(c)[0] - uv(a)[0], uv(a)[1] - uv(c)[1]);
    let area = s1 * t2 - s2 * t1;
    let inverse = 1.0 / area;
    inverse.is_finite().then(|| ((edge1 * t2 - edge2 * t1) * inverse, (edge2 * s1 - edge1 * s2) * inverse))
}

fn orthogonal(normal: Vector3<f64>, tangent: Vector3<f64>, bitangent: Vector3<f64>) -> [f32; 4] {
    let flat = (tangent - normal * normal.dot(&tangent)).try_normalize(1e-20);
    let (unit, sign) = match flat {
        Some(unit) if normal.cross(&unit).dot(&bitangent) < 0.0 => (unit, -1.0),
        Some(unit) => (unit, 1.0),
        None => (any_orthogonal(normal), 1.0),
    };
    [unit.x as f32, unit.y as f32, unit.z as f32, sign]
}

fn any_orthogonal(normal: Vector3<f64>) -> Vector3<f64> {
    let axis = if normal.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    normal.cross(&axis).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(uvs: Vec<[f32; 2]>) -> Mesh {
        let rest = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]).expect("a square")
    }

    #[test]
    fn the_tangent_of_an_upright_image_is_plus_x_and_a_mirrored_image_flips_the_sign() {
        let upright = square(vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]);
        assert_eq!(lengyel_tangents(&upright), [[1.0, 0.0, 0.0, 1.0]; 4]);
        let mirrored = square(vec![[1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [1.0, 0.0]]);
        assert_eq!(lengyel_tangents(&mirrored), [[-1.0, 0.0, 0.0, -1.0]; 4]);
    }

    #[test]
    fn missing_and_degenerate_uvs_give_finite_unit_tangents() {
        for mesh in [square(vec![]), square(vec![[0.5, 0.5]; 4])] {
            for [x, y, z, sign] in lengyel_tangents(&mesh) {
                let length = (x * x + y * y + z * z).sqrt();
                assert!((length - 1.0).abs() < 1e-6, "length {length}");
                assert!((z.abs() < 1e-6) && (sign == 1.0));
            }
        }
    }
}
