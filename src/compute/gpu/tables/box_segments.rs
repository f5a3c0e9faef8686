//! Bounding boxes per domain: the pieces that `bounds` reduces to boxes, and their union per domain. Pure.
//!
//! A domain with tiles of its own is cut into pieces of tiles, whose boxes `deform` computed. A domain that shares a
//! tile is one piece, a range of its positions. This keeps as many threads busy for a domain of millions of vertices as
//! for 200,000 leaves. The host unites the few boxes of a large domain.

use super::box_keys::bounds_from_keys;
use super::layout::{BoxSegment, TILE_LAST};
use super::work::WorkList;
use modalcast_model::scene::{BoundingBox, Scene};

/// Maximum number of tiles of a piece; each tile has four boxes.
const MAX_SEGMENT_TILES: u32 = 32;

/// Keys of a box.
pub(crate) const BOX_KEYS: usize = 6;

/// The pieces of all domains, in the order of the domains.
pub(crate) fn segments(scene: &Scene, work: &WorkList) -> Vec<BoxSegment> {
    let mut segments = Vec::with_capacity(scene.domains.len());
    for (index, ([(first, count), _], slot)) in work.spans.iter().zip(&scene.layout.domains).enumerate() {
        let domain = index as u32;
        if work.tiles[*first as usize].kind & TILE_LAST == 0 {
            let (first, count) = (slot.first_vertex as u32, slot.vertices as u32);
            segments.push(BoxSegment { first, count, domain, from_vertices: 1 });
            continue;
        }
        let part = |tile: u32| {
            let tiles = MAX_SEGMENT_TILES.min(first + count - tile);
            BoxSegment { first: 4 * tile, count: 4 * tiles, domain, from_vertices: 0 }
        };
        segments.extend((*first..first + count).step_by(MAX_SEGMENT_TILES as usize).map(part));
    }
    segments
}

/// Device bytes of the boxes of so many pieces.
pub(crate) const fn box_bytes(segments: usize) -> u64 {
    (segments * 4 * BOX_KEYS) as u64
}

/// One box for each domain, from the keys of its pieces.
pub(crate) fn union_per_domain(domains: &[u32], keys: &[u32], to: &mut Vec<BoundingBox>) {
    to.clear();
    for (domain, keys) in domains.iter().zip(keys.chunks_exact(BOX_KEYS)) {
        let piece = bounds_from_keys(keys);
        match to.get_mut(*domain as usize) {
            Some(all) => *all = all.union(piece),
            None => to.push(piece),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::layout::TILE_VERTICES;
    use super::super::test_scenes::{scene, used_once};
    use super::super::work::CoordinateLayout;
    use super::*;
    use modalcast_model::backend_settings::BatchPolicy;

    /// How many pieces contain each vertex of a domain.
    fn seen(scene: &Scene, work: &WorkList, domain: usize) -> Vec<u32> {
        let slot = scene.layout.domains[domain];
        let mut seen = vec![0; slot.vertices];
        for piece in segments(scene, work).iter().filter(|piece| piece.domain as usize == domain) {
            let range = piece.first as usize..(piece.first + piece.count) as usize;
            if piece.from_vertices == 1 {
                range.for_each(|vertex| seen[vertex - slot.first_vertex] += 1);
                continue;
            }
            assert!(range.start % 4 == 0 && range.end % 4 == 0, "whole tiles");
            for tile in &work.tiles[range.start / 4..range.end / 4] {
                assert_eq!((tile.domain as usize, tile.kind & TILE_VERTICES), (domain, TILE_VERTICES));
                let items = 4 * (usize::from(tile.width) - 1) + usize::from(tile.kind & TILE_LAST);
                let first = tile.first as usize - slot.first_vertex;
                seen[first..first + items].iter_mut().for_each(|count| *count += 1);
            }
        }
        seen
    }

    #[test]
    fn every_vertex_lies_in_one_piece_of_its_domain_whatever_its_tiles() {
        let sizes = [(7, 2), (64, 0), (65, 3), (128, 1), (129, 0), (9_000, 4), (1, 1)];
        for scene in [scene(&sizes, false, false), used_once(&sizes)] {
            let work = WorkList::new(&scene, &CoordinateLayout::new(&scene), BatchPolicy::default());
            let list = segments(&scene, &work);
            assert!(list.iter().any(|piece| piece.from_vertices == 1) && list.len() > scene.domains.len());
            assert!(list.is_sorted_by_key(|piece| piece.domain));
            assert!(list.iter().all(|piece| piece.from_vertices == 1 || piece.count <= 4 * MAX_SEGMENT_TILES));
            for (domain, slot) in scene.layout.domains.iter().enumerate() {
                assert_eq!(seen(&scene, &work, domain), vec![1; slot.vertices], "domain {domain}");
            }
        }
    }

    #[test]
    fn boxes_of_pieces_unite_to_those_of_domains_and_a_nan_stays() {
        // Keys of -x and x: `float_to_ordered` sets the sign bit of positive numbers and inverts all bits of negative ones.
        let key = |x: f32| if x.is_sign_negative() { !x.to_bits() } else { x.to_bits() | 1 << 31 };
        let cube = |low: f32, high: f32| [[key(-low); 3], [key(high); 3]].concat();
        let keys = [cube(-1.0, 2.0), cube(0.5, 0.75), cube(-3.0, 0.25)].concat();
        let mut boxes = vec![BoundingBox::EMPTY; 7];
        union_per_domain(&[0, 1, 1], &keys, &mut boxes);
        let want = |low: f64, high: f64| BoundingBox { min: [low; 3], max: [high; 3] };
        assert_eq!(boxes, [want(-1.0, 2.0), want(-3.0, 0.75)]);
        let spoilt = [&keys[..17], &[u32::MAX]].concat();
        union_per_domain(&[0, 1, 1], &spoilt, &mut boxes);
        assert!(boxes[0].is_finite() && !boxes[1].is_finite());
    }
}
