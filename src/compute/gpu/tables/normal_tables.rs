//! Tables of `normals`, derived from a scene: the offsets of each domain (its slot), the domains of each block of the
//! kernel, rest normals and tangents.

use super::layout::{BLOCK, NO_TANGENTS};
use modalcast_model::domain::Domain;
use modalcast_model::scene::{DomainLayout, Scene};

/// Offsets of the corners of one domain. Instances (domains of one shape) share `first_normal` and `first_tangent`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CornerSlot {
    pub first_corner: u32,
    pub first_normal: u32,
    pub first_tangent: u32,
}

/// One slot per domain.
pub(crate) fn corner_slots(scene: &Scene) -> Vec<CornerSlot> {
    let (mut normal_count, mut tangent_count) = (0, 0);
    // Per shape, its first normal and its first tangent.
    let mut shape_offsets = Vec::with_capacity(scene.shapes.len());
    for shape in &scene.shapes {
        let first_tangent = if shape.tangents().is_empty() { NO_TANGENTS } else { tangent_count };
        shape_offsets.push((normal_count, first_tangent));
        normal_count += shape.mesh.corners().vertices.len() as u32;
        tangent_count += shape.tangents().len() as u32;
    }
    let corner_slot = |(domain, layout): (&Domain, &DomainLayout)| {
        let (first_normal, first_tangent) = shape_offsets[domain.shape];
        CornerSlot { first_corner: layout.first_corner as u32, first_normal, first_tangent }
    };
    scene.domains.iter().zip(&scene.layout.domains).map(corner_slot).collect()
}

/// Per block of [`BLOCK`] corners, the domain of its first corner; the last entry is the last domain. `first_corners`
/// has the first corner of each domain, in ascending order.
pub(crate) fn first_domains(first_corners: impl Iterator<Item = u32>, corner_count: usize) -> Vec<u32> {
    let mut block_domains: Vec<u32> = Vec::with_capacity(corner_count.div_ceil(BLOCK as usize) + 1);
    let mut last_domain = 0;
    for (domain, first_corner) in first_corners.enumerate() {
        // All blocks that begin before this domain's first corner begin in the previous domain.
        while (block_domains.len() as u64) * u64::from(BLOCK) < u64::from(first_corner) {
            block_domains.push(last_domain);
        }
        last_domain = domain as u32;
    }
    while block_domains.len() * (BLOCK as usize) < corner_count {
        block_domains.push(last_domain);
    }
    block_domains.push(last_domain);
    block_domains
}

/// Rest normals of all shapes, one plane per axis.
pub(crate) fn rest_normals(scene: &Scene) -> Vec<f32> {
    let plane = |axis: usize| {
        scene.shapes.iter().flat_map(move |shape| shape.mesh.corners().normals.iter().map(move |normal| normal[axis]))
    };
    (0..3).flat_map(plane).collect()
}

/// Number of corners of all shapes: the length of one plane of [`rest_normals`].
pub(crate) fn rest_corner_count(scene: &Scene) -> usize {
    scene.shapes.iter().map(|shape| shape.mesh.corners().vertices.len()).sum()
}

/// Tangents of all shapes that have tangents.
pub(crate) fn rest_tangents(scene: &Scene) -> Vec<[f32; 4]> {
    scene.shapes.iter().flat_map(|shape| shape.tangents()).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::scene_with_normal_map;
    use super::*;

    /// (vertices, rank) of each shape. Domains 2 s and 2 s + 1 use shape s.
    const SHAPES: [(usize, usize); 4] = [(7, 2), (300, 0), (8, 5), (513, 1)];

    #[test]
    fn instances_share_normals_but_not_corners() {
        let scene = scene_with_normal_map(&SHAPES);
        let slots = corner_slots(&scene);
        assert_eq!(slots[0].first_normal, slots[1].first_normal);
        assert_ne!(slots[0].first_corner, slots[1].first_corner);
        assert_eq!(slots[0].first_tangent, NO_TANGENTS, "only the last shape has a normal map");
        assert_eq!((slots[6].first_tangent, slots[7].first_tangent), (0, 0));
        let normals = rest_normals(&scene);
        let plane_stride = rest_corner_count(&scene);
        for (domain, slot) in slots.iter().enumerate() {
            for (corner, normal) in scene.shape_of(domain).mesh.corners().normals.iter().enumerate() {
                let index = slot.first_normal as usize + corner;
                assert_eq!([0, 1, 2].map(|axis| normals[axis * plane_stride + index]), *normal);
            }
        }
    }

    #[test]
    fn first_domains_bracket_the_domains_of_each_block() {
        let corner_counts_of_scenes: [&[u32]; 5] =
            [&[1], &[256], &[255, 1, 1], &[7; 1000], &[1000, 3, 256, 512, 1, 700]];
        for corner_counts in corner_counts_of_scenes {
            let first_corners: Vec<u32> =
                corner_counts.iter().scan(0, |sum, count| Some(std::mem::replace(sum, *sum + count))).collect();
            let total: u32 = corner_counts.iter().sum();
            let block_domains = first_domains(first_corners.iter().copied(), total as usize);
            assert_eq!(block_domains.len(), total.div_ceil(BLOCK) as usize + 1);
            for corner in 0..total {
                let domain = first_corners.partition_point(|first| *first <= corner) as u32 - 1;
                let block = (corner / BLOCK) as usize;
                let candidates = block_domains[block]..=block_domains[block + 1];
                assert!(candidates.contains(&domain), "corner {corner} of {corner_counts:?}");
                if corner % BLOCK == 0 {
                    assert_eq!(block_domains[block], domain);
                }
            }
        }
    }
}
