//! The surface of a volume mesh as triangles: each face of a quadratic element is drawn as four triangles, so that bent
//! faces look bent, and every vertex is a node, whose displacements are exact.

use modalcast_model::domain::{CreaseAngle, split_at_creases};
use nalgebra::Vector3;

use crate::surface_file::DrawnMesh;
use crate::volume_mesh::{NO_NODE, VolumeMesh};

/// The drawn mesh, and the node of each of its vertices. Normals are smooth except at creases.
pub fn surface_of(mesh: &VolumeMesh) -> (DrawnMesh, Vec<u32>) {
    let mut vertex_of_node = vec![NO_NODE; mesh.positions.len()];
    let mut nodes = Vec::new();
    let mut drawn = DrawnMesh::default();
    for face in &mesh.boundary_faces {
        let vertices = mesh.face_nodes(*face).map(|node| {
            let vertex = &mut vertex_of_node[node as usize];
            if *vertex == NO_NODE {
                *vertex = nodes.len() as u32;
                nodes.push(node);
            }
            *vertex
        });
        let [a, b, c, ab, bc, ca] = vertices;
        drawn.triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        drawn.triangle_groups.extend([mesh.element_groups[face.0 as usize]; 4]);
    }
    drawn.positions = nodes.iter().map(|node| mesh.positions[*node as usize]).collect();
    drawn.triangle_materials = vec![0; drawn.triangles.len()];
    drawn.corner_normals = normals(&drawn);
    (drawn, nodes)
}

/// The normal of each corner of each triangle.
fn normals(drawn: &DrawnMesh) -> Vec<[[f32; 3]; 3]> {
    // Relative to a vertex, because f32 would round positions far from the origin.
    let origin = drawn.positions.first().copied().unwrap_or_default();
    let positions: Vec<[f32; 3]> =
        drawn.positions.iter().map(|position| (position - origin).cast::<f32>().into()).collect();
    let vertices: Vec<u32> = (0..positions.len() as u32).collect();
    let corners = split_at_creases(&positions, &vertices, &drawn.triangles, &[], CreaseAngle::default());
    let normals = corners.triangles.iter().map(|triangle| triangle.map(|corner| corners.normals[corner as usize]));
    normals.collect()
}

/// The area of the triangles, square meters.
pub fn area_of(drawn: &DrawnMesh) -> f64 {
    let area = |triangle: &[u32; 3]| {
        let [a, b, c]: [Vector3<f64>; 3] = triangle.map(|vertex| drawn.positions[vertex as usize]);
        (b - a).cross(&(c - a)).norm() / 2.0
    };
    drawn.triangles.iter().map(area).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Surface;
    use crate::volume_mesh::tests::cube;

    #[test]
    fn surface_of_a_cube_is_closed_with_flat_normals() {
        let mesh = VolumeMesh::new(cube()).expect("a mesh");
        let (drawn, nodes) = surface_of(&mesh);
        // The middle of the cube's diagonal is inside.
        assert_eq!((drawn.positions.len(), drawn.triangles.len()), (26, 48));
        let surface = Surface::new(&drawn.positions, &drawn.triangles, &drawn.triangle_groups);
        assert!(surface.is_closed && (surface.volume() - 1.0).abs() < 1e-14);
        assert!((area_of(&drawn) - 6.0).abs() < 1e-14);
        for (position, node) in drawn.positions.iter().zip(&nodes) {
            assert_eq!(*position, mesh.positions[*node as usize]);
        }
        for (triangle, normals) in drawn.corner_normals.iter().enumerate() {
            let exact = surface.area_vector(triangle).normalize().cast::<f32>();
            assert!(normals.iter().all(|normal| (Vector3::from(*normal) - exact).norm() < 1e-6), "{normals:?}");
        }
    }
}
