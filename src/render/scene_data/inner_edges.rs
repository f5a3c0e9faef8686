//! The edges of triangles that are inside of polygons, for the lines along mesh edges.

use super::geometry::{TriangleSpan, is_drawn_reversed};
use modalcast_model::scene::Scene;

/// Triangles per word of [`pack_inner_edges`].
const TRIANGLES_PER_WORD: usize = 8;

/// Whether some mesh of the scene has inner edges.
pub(crate) fn has_inner_edges(scene: &Scene) -> bool {
    scene.shapes.iter().any(|shape| !shape.mesh.inner_edges().is_empty())
}

/// Four bits per triangle in the draw order, eight triangles per word, the first one in the lowest bits. Bit i of a
/// triangle is 1 if the edge opposite to its corner i is inside of a polygon. `spans` are those of the draw order.
pub(crate) fn pack_inner_edges(scene: &Scene, spans: &[TriangleSpan]) -> Vec<u32> {
    let count = scene.layout.triangles;
    let mut words = vec![0; count.div_ceil(TRIANGLES_PER_WORD)];
    let ends = spans.iter().skip(1).map(|span| span.first).chain([count]);
    for (span, end) in spans.iter().zip(ends) {
        let domain = &scene.domains[span.domain];
        let mesh = &scene.shapes[domain.shape].mesh;
        let is_mirrored = domain.placement.linear().determinant() < 0.0;
        // A span has one material.
        let range = domain.material_ranges.iter().rfind(|range| range.first_triangle <= span.triangle);
        let material = &scene.materials[range.map_or(domain.material, |range| range.material)];
        for (draw_index, triangle) in (span.first..end).zip(span.triangle..) {
            let Some(edges) = mesh.inner_edges().get(triangle) else { break };
            let edges = match is_drawn_reversed(mesh, mesh.triangles()[triangle], material, is_mirrored) {
                // The second and the third corner are exchanged.
                true => edges & 1 | (edges & 2) << 1 | (edges & 4) >> 1,
                false => *edges,
            };
            words[draw_index / TRIANGLES_PER_WORD] |= u32::from(edges) << (4 * (draw_index % TRIANGLES_PER_WORD));
        }
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::Geometry;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::{Material, Transform};

    /// Squares of two triangles, whose diagonal is their only inner edge. Mirrored domains and double-sided triangles
    /// with opposite winding are drawn with exchanged corners.
    #[test]
    fn marks_follow_the_drawn_corners() {
        let mut parts =
            squares((0..9).map(|index| Material { double_sided: index % 2 == 0, ..Material::default() }).collect());
        let shape = &mut parts.shapes[0];
        // Triangles [0, 1, 2] and [0, 2, 3]: the diagonal from 0 to 2 is opposite to corner 1 and to corner 2.
        shape.mesh = shape.mesh.clone().with_inner_edges(vec![2, 4]).expect("one entry per triangle");
        let mirror = nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, -1.0));
        for domain in parts.domains.iter_mut().skip(5) {
            domain.placement = Transform::from_parts(&mirror, &nalgebra::Vector3::zeros());
        }
        let scene = Scene::new(parts).expect("a valid scene");
        assert!(has_inner_edges(&scene));
        let geometry = Geometry::new(&scene);
        let words = pack_inner_edges(&scene, &geometry.spans);
        assert_eq!(words.len(), 3, "expected 18 triangles in words of 8");
        for (index, vertices) in geometry.triangle_vertices.iter().enumerate() {
            let marks = words[index / 8] >> (4 * (index % 8)) & 7;
            let is_diagonal = |corner: usize| {
                let ends = [1, 2].map(|offset| vertices[(corner + offset) % 3] % 4);
                u32::from(ends == [0, 2] || ends == [2, 0]) << corner
            };
            assert_eq!(marks, (0..3).map(is_diagonal).sum::<u32>(), "triangle {index}: {vertices:?}");
        }
    }
}
