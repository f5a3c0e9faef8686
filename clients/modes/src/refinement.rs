//! Divides long edges of the drawn mesh, so that the large triangles of a CAD surface can bend.

use std::collections::HashMap;

use nalgebra::Vector3;

use crate::surface_file::DrawnMesh;

/// Limit on the triangles after refinement.
const MAX_TRIANGLES: usize = 400_000;

/// Halves all edges longer than `max_length` meters until there are none. Neighbors at an edge share its new vertex. Ends
/// early when the mesh has hundreds of thousands of triangles.
pub fn divide_long_edges(mesh: &mut DrawnMesh, max_length: f64) {
    // A round makes at most four triangles of one.
    while mesh.triangles.len() <= MAX_TRIANGLES / 4 {
        let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
        let mut refined = DrawnMesh {
            positions: std::mem::take(&mut mesh.positions),
            material_colors: std::mem::take(&mut mesh.material_colors),
            ..DrawnMesh::default()
        };
        for triangle in 0..mesh.triangles.len() {
            divide_triangle(mesh, triangle, max_length, &mut middles, &mut refined);
        }
        *mesh = refined;
        if middles.is_empty() {
            return;
        }
    }
}

/// A corner of a triangle while it is divided.
#[derive(Clone, Copy)]
struct Corner {
    vertex: u32,
    normal: [f32; 3],
}

/// Adds a triangle to the refined mesh, divided at the middles of its long edges.
fn divide_triangle(
    mesh: &DrawnMesh,
    triangle: usize,
    max_length: f64,
    middles: &mut HashMap<[u32; 2], u32>,
    refined: &mut DrawnMesh,
) {
    let corners: [Corner; 3] = std::array::from_fn(|index| Corner {
        vertex: mesh.triangles[triangle][index],
        normal: mesh.corner_normals[triangle][index],
    });
    let mut middle_of = |a: Corner, b: Corner| {
        let ends = [a, b].map(|corner| refined.positions[corner.vertex as usize]);
        if (ends[1] - ends[0]).norm() <= max_length {
            return None;
        }
        let edge = [a.vertex.min(b.vertex), a.vertex.max(b.vertex)];
        let vertex = *middles.entry(edge).or_insert_with(|| {
            refined.positions.push((ends[0] + ends[1]) / 2.0);
            refined.positions.len() as u32 - 1
        });
        let sum = Vector3::from(a.normal) + Vector3::from(b.normal);
        Some(Corner { vertex, normal: sum.try_normalize(0.0).map_or(a.normal, Into::into) })
    };
    let middles = [0, 1, 2].map(|index| middle_of(corners[index], corners[(index + 1) % 3]));
    let group = mesh.triangle_groups[triangle];
    let material = mesh.triangle_materials[triangle];
    let mut add = |corners: [Corner; 3]| {
        refined.triangles.push(corners.map(|corner| corner.vertex));
        refined.corner_normals.push(corners.map(|corner| corner.normal));
        refined.triangle_groups.push(group);
        refined.triangle_materials.push(material);
    };
    // Rotates the triangle, so that its divided edges come first.
    let start = match middles.map(|middle| middle.is_some()) {
        [false, true, false] | [false, true, true] => 1,
        [false, false, true] | [true, false, true] => 2,
        _ => 0,
    };
    let [a, b, c] = [0, 1, 2].map(|index| corners[(start + index) % 3]);
    match [0, 1, 2].map(|index| middles[(start + index) % 3]) {
        [Some(ab), Some(bc), Some(ca)] => {
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]].into_iter().for_each(add);
        }
        [Some(ab), Some(bc), None] => [[a, ab, c], [ab, bc, c], [ab, b, bc]].into_iter().for_each(add),
        [Some(ab), ..] => [[a, ab, c], [ab, b, c]].into_iter().for_each(add),
        _ => add([a, b, c]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::tests::box_surface;

    fn mesh(low: [f64; 3], high: [f64; 3]) -> DrawnMesh {
        let (positions, triangles) = box_surface(low, high);
        DrawnMesh {
            positions,
            corner_normals: vec![[[0.0, 0.0, 1.0]; 3]; triangles.len()],
            triangle_groups: vec![2; triangles.len()],
            triangle_materials: vec![0; triangles.len()],
            triangles,
            ..DrawnMesh::default()
        }
    }

    #[test]
    fn refined_mesh_is_closed_and_has_short_edges() {
        let mut mesh = mesh([0.0; 3], [1.0, 0.3, 0.05]);
        divide_long_edges(&mut mesh, 0.1);
        let surface = crate::surface::Surface::new(&mesh.positions, &mesh.triangles, &mesh.triangle_groups);
        assert!(surface.is_closed && mesh.triangles.len() > 200);
        for [a, b] in mesh.triangles.iter().flat_map(crate::surface::directed_edges) {
            assert!((mesh.positions[a as usize] - mesh.positions[b as usize]).norm() <= 0.1);
        }
        let volume = |index: usize| surface.area_vector(index).dot(&surface.corners(index)[0]) / 3.0;
        let total: f64 = (0..surface.triangles.len()).map(volume).sum();
        assert!((total - 0.015).abs() < 1e-12, "{total}");
    }

    #[test]
    fn mesh_with_short_edges_stays_as_it_is() {
        let original = mesh([0.0; 3], [1.0; 3]);
        let mut refined = original.clone();
        divide_long_edges(&mut refined, 2.0);
        assert_eq!(refined.triangles, original.triangles);
        assert_eq!(refined.positions, original.positions);
    }
}
