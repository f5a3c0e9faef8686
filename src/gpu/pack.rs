//! A scene to the tables that the kernels read: slots, blocks, columns (x0 and U), rest normals and tangents. Pure.
//!
//! A shape's part of `columns` is [1 + r][3][stride] f32: x0 and then each mode, a plane per axis, so that consecutive
//! vertices lie at consecutive addresses. Domains that are instances of one shape share it.

use super::layout::{BLOCK, CornerSlot, NO_TANGENTS, VertexSlot};
use crate::domain::Shape;
use crate::scene::Scene;

/// Planes begin at whole sectors of 32 bytes.
const SECTOR: usize = 8;

/// Where a shape's planes begin, and floats from one to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Placement {
    pub first_entry: u64,
    pub stride: usize,
}

/// The place of each shape in `columns`, and the floats of all.
pub(super) fn placements(scene: &Scene) -> (Vec<Placement>, u64) {
    let mut total = 0;
    let place = |shape: &Shape| {
        let stride = shape.mesh.rest().len().next_multiple_of(SECTOR);
        let placement = Placement { first_entry: total, stride };
        total += 3 * (1 + shape.modes.rank() as u64) * stride as u64;
        placement
    };
    let list = scene.shapes.iter().map(place).collect();
    (list, total)
}

/// Appends a shape's planes: x0, then each column of U.
pub(super) fn push_columns(shape: &Shape, stride: usize, out: &mut Vec<f32>) {
    let columns = (0..shape.modes.rank()).map(|mode| shape.modes.column(mode));
    for column in std::iter::once(shape.mesh.rest().as_flattened()).chain(columns) {
        for axis in 0..3 {
            let begin = out.len();
            out.extend(column.iter().skip(axis).step_by(3));
            out.resize(begin + stride, 0.0);
        }
    }
}

/// One slot per domain, for `deform`.
pub(super) fn vertex_slots(scene: &Scene) -> Vec<VertexSlot> {
    let (places, _) = placements(scene);
    let slot = |(domain, slot): (&crate::domain::Domain, &crate::scene::Slot)| VertexSlot {
        first_entry: places[domain.shape].first_entry,
        first: slot.first_vertex as u32,
        stride: places[domain.shape].stride as u32,
        rank: slot.rank as u32,
        first_q: slot.first_q as u32,
    };
    scene.domains.iter().zip(&scene.layout.slots).map(slot).collect()
}

/// One slot per domain, for `orient`.
pub(super) fn corner_slots(scene: &Scene) -> Vec<CornerSlot> {
    let (mut normals, mut tangents) = (0, 0);
    let mut places = Vec::with_capacity(scene.shapes.len());
    for shape in &scene.shapes {
        places.push((normals, if shape.tangents().is_empty() { NO_TANGENTS } else { tangents }));
        normals += shape.mesh.corners().vertices.len() as u32;
        tangents += shape.tangents().len() as u32;
    }
    let slot = |(domain, slot): (&crate::domain::Domain, &crate::scene::Slot)| {
        let (first_normal, first_tangent) = places[domain.shape];
        CornerSlot { first: slot.first_corner as u32, first_normal, first_tangent }
    };
    scene.domains.iter().zip(&scene.layout.slots).map(slot).collect()
}

/// The domain of the first item of each block, and one more entry: the last domain. `firsts` are the first items of all
/// domains in order, `items` how many there are.
pub(super) fn first_domains(firsts: impl Iterator<Item = u32>, items: usize) -> Vec<u32> {
    let mut blocks: Vec<u32> = Vec::with_capacity(items.div_ceil(BLOCK as usize) + 1);
    let mut last = 0;
    for (domain, first) in firsts.enumerate() {
        // All blocks that begin before this domain does begin in the one before it.
        while (blocks.len() as u64) * u64::from(BLOCK) < u64::from(first) {
            blocks.push(last);
        }
        last = domain as u32;
    }
    while blocks.len() * (BLOCK as usize) < items {
        blocks.push(last);
    }
    blocks.push(last);
    blocks
}

/// Rest normals of all shapes, a plane per axis.
pub(super) fn rest_normals(scene: &Scene) -> Vec<f32> {
    let all = |axis: usize| {
        scene.shapes.iter().flat_map(move |shape| shape.mesh.corners().normals.iter().map(move |normal| normal[axis]))
    };
    (0..3).flat_map(all).collect()
}

/// Corners of all shapes: the length of one plane of [`rest_normals`].
pub(super) fn rest_corners(scene: &Scene) -> usize {
    scene.shapes.iter().map(|shape| shape.mesh.corners().vertices.len()).sum()
}

/// Tangents of all shapes that have them.
pub(super) fn rest_tangents(scene: &Scene) -> Vec<[f32; 4]> {
    scene.shapes.iter().flat_map(|shape| shape.tangents()).copied().collect()
}

/// The length of [`rest_tangents`].
pub(super) fn tangent_count(scene: &Scene) -> usize {
    scene.shapes.iter().map(|shape| shape.tangents().len()).sum()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::domain::{Attachment, Corners, Domain, Material, Mesh, Metadata, Modes, Texture, Transform};
    use crate::scene::Parts;
    use std::sync::Arc;

    fn shape(vertices: usize, rank: usize) -> Shape {
        let rest = (0..vertices).map(|vertex| [vertex as f32, 0.5, -1.0]).collect();
        let count = vertices + 2;
        let corners = Corners {
            vertices: (0..count).map(|corner| (corner % vertices) as u32).collect(),
            normals: (0..count).map(|corner| [1.0, corner as f32, 0.0]).collect(),
            uvs: vec![[0.0, 1.0]; count],
        };
        let mesh = Mesh::new(rest, corners, vec![[0, 1, 2]]).expect("a mesh");
        let entries = (0..3 * vertices * rank).map(|entry| 0.25 * entry as f32).collect();
        Shape::new(mesh, Modes::from_columns(3 * vertices, rank, entries).expect("modes")).expect("a shape")
    }

    fn domain(shape: usize, material: usize) -> Domain {
        Domain {
            name: String::new(),
            shape,
            material,
            placement: Transform::IDENTITY,
            attachment: None::<Attachment>,
            runs: vec![],
            rest_q: Vec::new(),
            shares_q_with: None,
            metadata: Metadata::default(),
        }
    }

    /// A scene whose shapes have these vertices and ranks, each used by two domains.
    pub(in super::super) fn scene(shapes: &[(usize, usize)], normal_maps: bool, rigid: bool) -> Arc<Scene> {
        let mut parts = Parts::named("test");
        parts.rigid_transforms = rigid;
        parts.shapes = shapes.iter().map(|(vertices, rank)| shape(*vertices, *rank)).collect();
        let mapped = Material { normal_texture: normal_maps.then_some(0), ..Material::default() };
        parts.materials = vec![Material::default(), mapped];
        parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("a texture")];
        let last = shapes.len() - 1;
        parts.domains = (0..2 * shapes.len()).map(|index| domain(index / 2, usize::from(index / 2 == last))).collect();
        Scene::new(parts).expect("a scene")
    }

    const SHAPES: [(usize, usize); 4] = [(7, 2), (300, 0), (8, 5), (513, 1)];

    #[test]
    fn every_rest_position_and_entry_of_u_lies_where_its_slot_says() {
        let scene = scene(&SHAPES, false, false);
        let (places, total) = placements(&scene);
        let mut columns = Vec::new();
        for (shape, place) in scene.shapes.iter().zip(&places) {
            assert_eq!(columns.len() as u64, place.first_entry);
            push_columns(shape, place.stride, &mut columns);
        }
        assert_eq!(columns.len() as u64, total);
        for (domain, slot) in vertex_slots(&scene).iter().enumerate() {
            let shape = scene.shape_of(domain);
            assert_eq!(slot.rank as usize, shape.modes.rank());
            for (vertex, rest) in shape.mesh.rest().iter().enumerate() {
                for axis in 0..3 {
                    let at = |plane: usize| {
                        columns[slot.first_entry as usize + (3 * plane + axis) * slot.stride as usize + vertex]
                    };
                    assert_eq!(at(0), rest[axis]);
                    for mode in 0..shape.modes.rank() {
                        assert_eq!(at(1 + mode), shape.modes.at(vertex, axis, mode));
                    }
                }
            }
        }
    }

    #[test]
    fn instances_share_columns_and_normals_but_not_vertices() {
        let scene = scene(&SHAPES, true, false);
        let (vertices, corners) = (vertex_slots(&scene), corner_slots(&scene));
        assert_eq!(vertices[0].first_entry, vertices[1].first_entry);
        assert_eq!(vertices[1].first, 7);
        assert_eq!((vertices[0].first_q, vertices[1].first_q), (0, 2));
        assert_eq!(corners[0].first_normal, corners[1].first_normal);
        assert_ne!(corners[0].first, corners[1].first);
        assert_eq!(corners[0].first_tangent, NO_TANGENTS, "only the last shape has a normal map");
        assert_eq!((corners[6].first_tangent, corners[7].first_tangent), (0, 0));
        let normals = rest_normals(&scene);
        let plane = rest_corners(&scene);
        for (domain, slot) in corners.iter().enumerate() {
            for (corner, normal) in scene.shape_of(domain).mesh.corners().normals.iter().enumerate() {
                let at = |axis: usize| normals[axis * plane + slot.first_normal as usize + corner];
                assert_eq!([at(0), at(1), at(2)], *normal);
            }
        }
    }

    #[test]
    fn the_first_domain_of_each_block_brackets_the_domains_of_all_its_vertices() {
        let sizes: [&[u32]; 5] = [&[1], &[256], &[255, 1, 1], &[7; 1000], &[1000, 3, 256, 512, 1, 700]];
        for sizes in sizes {
            let firsts: Vec<u32> =
                sizes.iter().scan(0, |sum, size| Some(std::mem::replace(sum, *sum + size))).collect();
            let items: u32 = sizes.iter().sum();
            let blocks = first_domains(firsts.iter().copied(), items as usize);
            assert_eq!(blocks.len(), items.div_ceil(BLOCK) as usize + 1);
            for item in 0..items {
                let domain = firsts.partition_point(|first| *first <= item) as u32 - 1;
                let block = (item / BLOCK) as usize;
                assert!((blocks[block]..=blocks[block + 1]).contains(&domain), "item {item} of {sizes:?}");
                if item % BLOCK == 0 {
                    assert_eq!(blocks[block], domain);
                }
            }
        }
    }
}
