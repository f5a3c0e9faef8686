//! Tables of `normals`, derived from a scene: slots, blocks, rest normals and tangents. Pure.

use super::layout::{BLOCK, NO_TANGENTS};
use modalcast_model::scene::Scene;

/// Offsets of the corners of one domain. Instances share `first_normal` and `first_tangent`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CornerSlot {
    pub first: u32,
    pub first_normal: u32,
    pub first_tangent: u32,
}

/// One slot per domain.
pub(crate) fn corner_slots(scene: &Scene) -> Vec<CornerSlot> {
    let (mut normals, mut tangents) = (0, 0);
    let mut places = Vec::with_capacity(scene.shapes.len());
    for shape in &scene.shapes {
        places.push((normals, if shape.tangents().is_empty() { NO_TANGENTS } else { tangents }));
        normals += shape.mesh.corners().vertices.len() as u32;
        tangents += shape.tangents().len() as u32;
    }
    let slot = |(domain, slot): (&modalcast_model::domain::Domain, &modalcast_model::scene::DomainLayout)| {
        let (first_normal, first_tangent) = places[domain.shape];
        CornerSlot { first: slot.first_corner as u32, first_normal, first_tangent }
    };
    scene.domains.iter().zip(&scene.layout.domains).map(slot).collect()
}

/// The domain of the first item of each block, followed by the last domain. `firsts`: the first items of all domains in
/// order. `items`: the number of items.
pub(crate) fn first_domains(firsts: impl Iterator<Item = u32>, items: usize) -> Vec<u32> {
    let mut blocks: Vec<u32> = Vec::with_capacity(items.div_ceil(BLOCK as usize) + 1);
    let mut last = 0;
    for (domain, first) in firsts.enumerate() {
        // All blocks that begin before this domain's first item begin in the previous domain.
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

/// Rest normals of all shapes, one plane per axis.
pub(crate) fn rest_normals(scene: &Scene) -> Vec<f32> {
    let all = |axis: usize| {
        scene.shapes.iter().flat_map(move |shape| shape.mesh.corners().normals.iter().map(move |normal| normal[axis]))
    };
    (0..3).flat_map(all).collect()
}

/// Number of corners of all shapes: the length of one plane of [`rest_normals`].
pub(crate) fn rest_corners(scene: &Scene) -> usize {
    scene.shapes.iter().map(|shape| shape.mesh.corners().vertices.len()).sum()
}

/// Tangents of all shapes that have tangents.
pub(crate) fn rest_tangents(scene: &Scene) -> Vec<[f32; 4]> {
    scene.shapes.iter().flat_map(|shape| shape.tangents()).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::scene;
    use super::*;

    const SHAPES: [(usize, usize); 4] = [(7, 2), (300, 0), (8, 5), (513, 1)];

    #[test]
    fn instances_share_normals_but_not_corners() {
        let scene = scene(&SHAPES, true, false);
        let corners = corner_slots(&scene);
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
    fn the_first_domain_of_each_block_brackets_the_domains_of_all_its_corners() {
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
