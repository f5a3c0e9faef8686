//! The connected parts of a mesh. A part of a free body has six rigid motions: three translations and three rotations.

use std::collections::HashMap;

use modalcast_client::Shape;
use petgraph::unionfind::UnionFind;

/// The connected parts of a mesh, numbered from 0. Triangles that share a vertex, or have vertices at equal rest
/// positions, belong to one part. Each vertex without triangles is a part of its own.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ConnectedParts {
    /// Per vertex.
    part_of_vertex: Vec<usize>,
    /// Number of parts with triangles.
    pub(crate) count: usize,
}

impl ConnectedParts {
    /// Finds the parts of a shape by its rest positions, indices and corner vertices. There are none if these were not
    /// requested.
    pub(crate) fn of_shape(shape: &Shape) -> Self {
        if shape.indices.is_empty() {
            return Self::default();
        }
        let mut sets = UnionFind::<usize>::new(shape.vertex_count);
        let mut vertices_by_position = HashMap::with_capacity(shape.vertex_count);
        for (vertex, position) in shape.rest_positions.chunks_exact(3).enumerate() {
            // `+ 0.0` maps -0.0 to 0.0.
            let key = [position[0], position[1], position[2]].map(|coordinate| (coordinate + 0.0).to_bits());
            sets.union(vertex, *vertices_by_position.entry(key).or_insert(vertex));
        }
        let vertex_of = |corner: &u32| shape.corner_vertices[*corner as usize] as usize;
        for corners in shape.indices.chunks_exact(3) {
            sets.union(vertex_of(&corners[0]), vertex_of(&corners[1]));
            sets.union(vertex_of(&corners[0]), vertex_of(&corners[2]));
        }
        let representatives = sets.into_labeling();
        let mut part_of_representative = HashMap::new();
        for vertex in shape.indices.iter().map(vertex_of) {
            let next_part = part_of_representative.len();
            part_of_representative.entry(representatives[vertex]).or_insert(next_part);
        }
        let count = part_of_representative.len();
        let part = |representative: &usize| {
            let next_part = part_of_representative.len();
            *part_of_representative.entry(*representative).or_insert(next_part)
        };
        Self { part_of_vertex: representatives.iter().map(part).collect(), count }
    }

    /// The part of a vertex; 0 if no parts were found.
    pub(crate) fn part_of(&self, vertex: u32) -> usize {
        self.part_of_vertex.get(vertex as usize).copied().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A shape whose corners are its vertices.
    fn shape(rest_positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Shape {
        Shape {
            vertex_count: rest_positions.len(),
            rest_positions: rest_positions.concat(),
            indices: triangles.concat(),
            corner_vertices: (0..rest_positions.len() as u32).collect(),
            ..Shape::default()
        }
    }

    #[test]
    fn parts_are_joined_by_vertices_and_by_positions() {
        let square = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
        // Two triangles that share an edge, and a vertex without triangles.
        let one = shape(&[&square[..], &[[9.0; 3]]].concat(), &[[0, 1, 2], [1, 3, 2]]);
        let parts = ConnectedParts::of_shape(&one);
        assert_eq!((parts.count, parts.part_of(3), parts.part_of(4)), (1, 0, 1));
        // The same two triangles with vertices of their own, -0.0 in place of 0.0, and a distant third triangle.
        let [a, b, c, d] = square;
        let distant = [a, b, c].map(|position| position.map(|coordinate| coordinate + 5.0));
        let soup =
            [a, b, c, b, d, c.map(|coordinate| -coordinate + 2.0 * coordinate), distant[0], distant[1], distant[2]];
        let parts = ConnectedParts::of_shape(&shape(&soup, &[[0, 1, 2], [3, 4, 5], [6, 7, 8]]));
        assert_eq!((parts.count, parts.part_of(4), parts.part_of(8)), (2, 0, 1));
        assert_eq!(ConnectedParts::default().part_of(7), 0);
    }
}
