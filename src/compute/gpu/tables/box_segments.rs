//! Bounding boxes per domain: the segments that `bounds` reduces to boxes, and their union per domain.
//!
//! A domain with tiles of its own is split into segments of consecutive tiles, whose boxes `deform` computed. A domain
//! that shares a tile with other domains is one segment, the range of its vertices. An item of a segment is therefore a
//! box or a vertex (`BoxSegment::is_vertex_range`). One domain of millions of vertices thus keeps as many threads busy
//! as 200,000 small domains. The host unites the boxes of the segments of a domain.

use super::box_keys::bounds_from_keys;
use super::layout::{BoxSegment, LAST_QUAD_ITEMS};
use super::work::WorkList;
use modalcast_model::scene::{BoundingBox, Scene};

/// Maximum number of tiles of a segment. Each tile has four boxes, because up to four warps of `deform` share a tile
/// and each warp writes a box.
const MAX_SEGMENT_TILES: u32 = 32;

/// Number of keys of a box.
pub(crate) const BOX_KEYS: usize = 6;

/// The segments of all domains, in the order of the domains.
pub(crate) fn box_segments(scene: &Scene, work: &WorkList) -> Vec<BoxSegment> {
    let mut segments = Vec::with_capacity(scene.domains.len());
    for (index, (tiles, layout)) in work.domain_tiles.iter().zip(&scene.layout.domains).enumerate() {
        let (domain, span) = (index as u32, tiles.vertices);
        // The number of items of the last quad is stored as 0 in a mixed tile, which several domains share.
        if work.tiles[span.first as usize].kind & LAST_QUAD_ITEMS == 0 {
            let (first_item, item_count) = (layout.first_vertex as u32, layout.vertices as u32);
            segments.push(BoxSegment { first_item, item_count, domain, is_vertex_range: 1 });
            continue;
        }
        let end_tile = span.first + span.count;
        let segment_from = |tile: u32| {
            let tile_count = MAX_SEGMENT_TILES.min(end_tile - tile);
            BoxSegment { first_item: 4 * tile, item_count: 4 * tile_count, domain, is_vertex_range: 0 }
        };
        segments.extend((span.first..end_tile).step_by(MAX_SEGMENT_TILES as usize).map(segment_from));
    }
    segments
}

/// Device bytes of the boxes of segments.
pub(crate) const fn box_bytes(segment_count: usize) -> u64 {
    (segment_count * 4 * BOX_KEYS) as u64
}

/// Computes one box per domain. `domains` has the domain of each segment, in ascending order, and `keys` has the box of
/// each segment. Every domain has a segment.
pub(crate) fn unite_boxes(domains: &[u32], keys: &[u32], boxes: &mut Vec<BoundingBox>) {
    boxes.clear();
    for (domain, keys) in domains.iter().zip(keys.chunks_exact(BOX_KEYS)) {
        let segment_box = bounds_from_keys(keys);
        match boxes.get_mut(*domain as usize) {
            Some(domain_box) => *domain_box = domain_box.union(segment_box),
            None => boxes.push(segment_box),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::layout::TILE_VERTICES;
    use super::super::test_scenes::{scene, scene_without_sharing};
    use super::super::work::CoordinateLayout;
    use super::*;
    use modalcast_model::backend_settings::BatchPolicy;

    /// Per vertex of a domain, the number of segments that contain it.
    fn segment_counts(scene: &Scene, work: &WorkList, domain: usize) -> Vec<u32> {
        let layout = scene.layout.domains[domain];
        let mut counts = vec![0; layout.vertices];
        for segment in box_segments(scene, work).iter().filter(|segment| segment.domain as usize == domain) {
            let items = segment.first_item as usize..(segment.first_item + segment.item_count) as usize;
            if segment.is_vertex_range == 1 {
                items.for_each(|vertex| counts[vertex - layout.first_vertex] += 1);
                continue;
            }
            assert!(items.start % 4 == 0 && items.end % 4 == 0, "expected the four boxes of each tile, got {items:?}");
            for tile in &work.tiles[items.start / 4..items.end / 4] {
                assert_eq!((tile.domain as usize, tile.kind & TILE_VERTICES), (domain, TILE_VERTICES));
                let vertex_count = 4 * (usize::from(tile.quad_count) - 1) + usize::from(tile.kind & LAST_QUAD_ITEMS);
                let first_vertex = tile.first_item as usize - layout.first_vertex;
                counts[first_vertex..first_vertex + vertex_count].iter_mut().for_each(|count| *count += 1);
            }
        }
        counts
    }

    #[test]
    fn every_vertex_lies_in_one_segment_of_its_domain() {
        let sizes = [(7, 2), (64, 0), (65, 3), (128, 1), (129, 0), (9_000, 4), (1, 1)];
        for scene in [scene(&sizes), scene_without_sharing(&sizes)] {
            let work = WorkList::new(&scene, &CoordinateLayout::new(&scene), BatchPolicy::default());
            let segments = box_segments(&scene, &work);
            let is_vertex_range = |segment: &BoxSegment| segment.is_vertex_range == 1;
            assert!(segments.iter().any(is_vertex_range) && segments.len() > scene.domains.len());
            assert!(segments.is_sorted_by_key(|segment| segment.domain));
            let is_short = |segment: &BoxSegment| segment.item_count <= 4 * MAX_SEGMENT_TILES;
            assert!(segments.iter().all(|segment| is_vertex_range(segment) || is_short(segment)));
            for (domain, layout) in scene.layout.domains.iter().enumerate() {
                assert_eq!(segment_counts(&scene, &work, domain), vec![1; layout.vertices], "domain {domain}");
            }
        }
    }

    #[test]
    fn segment_boxes_unite_per_domain_and_nan_propagates() {
        // Keys of -x and x: `float_to_ordered` sets the sign bit of positive numbers and inverts all bits of negative
        // ones.
        let key = |x: f32| if x.is_sign_negative() { !x.to_bits() } else { x.to_bits() | 1 << 31 };
        let cube_keys = |min: f32, max: f32| [[key(-min); 3], [key(max); 3]].concat();
        // One segment of domain 0, two of domain 1.
        let keys = [cube_keys(-1.0, 2.0), cube_keys(0.5, 0.75), cube_keys(-3.0, 0.25)].concat();
        let mut boxes = vec![BoundingBox::EMPTY; 7]; // old content, which is overwritten
        unite_boxes(&[0, 1, 1], &keys, &mut boxes);
        let cube = |min: f64, max: f64| BoundingBox { min: [min; 3], max: [max; 3] };
        assert_eq!(boxes, [cube(-1.0, 2.0), cube(-3.0, 0.75)]);
        // A NaN in the last of the 18 keys, the maximum of z.
        let keys_with_nan = [&keys[..17], &[u32::MAX]].concat();
        unite_boxes(&[0, 1, 1], &keys_with_nan, &mut boxes);
        assert!(boxes[0].is_finite() && !boxes[1].is_finite());
    }
}
