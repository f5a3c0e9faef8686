//! Tests that walk the work list of `deform` as the kernel does.

use super::super::layout::TILE_LAST;
use super::super::test_scenes::{scene, stored};
use super::*;
use std::sync::Arc;

/// Words, scales and x0 of a scene, as `deform` loads them.
pub(crate) struct Loaded {
    pub words: Vec<PackedWord>,
    pub scales: Vec<f32>,
    pub rest: Vec<[f32; 4]>,
    pub factors: Vec<Vec<f32>>,
}

pub(crate) fn load(scene: &Scene, work: &WorkList) -> Loaded {
    let tiles = |shape: usize| TiledModes::new(&scene.shapes[shape], scene.deformation.storage);
    let mut loaded = Loaded {
        words: Vec::new(),
        scales: vec![0.0; work.scales as usize],
        rest: rest_positions(scene, work),
        factors: Vec::new(),
    };
    for source in &work.sources {
        match source {
            WordSource::Shape(shape) => loaded.words.extend_from_slice(tiles(*shape).packed_words()),
            WordSource::Mixed(shapes) => {
                loaded.words.extend(side_by_side(&shapes.iter().map(|shape| tiles(*shape)).collect::<Vec<_>>()));
            }
        }
    }
    for shape in 0..scene.shapes.len() {
        let own = tiles(shape);
        loaded.scales[work.first_scale[shape] as usize..][..own.scales().len()].copy_from_slice(own.scales());
        loaded.factors.push(own.factors().to_vec());
    }
    loaded
}

/// A lane as the kernel sees it: domain, first item, number of items, first quad of x0, first q, first scale.
fn lane(work: &WorkList, tile: &WarpTile, quad: usize) -> (usize, u32, usize, u32, u32, u32) {
    let last = usize::from(tile.kind & TILE_LAST);
    if last > 0 {
        let count = if quad + 1 == usize::from(tile.width) { last } else { 4 };
        let step = quad as u32;
        let item = tile.first + 4 * step;
        (tile.domain as usize, item, count, tile.rest, tile.first_q, tile.first_scale)
    } else {
        let at = tile.first as usize + quad;
        let lane = work.mixed_quads[at];
        let scale = work.mixed_quad_scales.get(at).copied().unwrap_or(0);
        let (domain, count) = ((lane.domain / 4) as usize, 1 + lane.domain as usize % 4);
        (domain, lane.item, count, lane.rest, lane.first_q, scale)
    }
}

/// Counts the tiles that compute each packed corner, and checks the offset of its rest normal.
fn check_corners(scene: &Scene, work: &WorkList) {
    let mut seen = vec![0; scene.layout.corners];
    let shifts = &work.corner_offsets;
    for tile in work.tiles.iter().filter(|tile| tile.kind & TILE_CORNERS > 0) {
        for in_tile in 0..usize::from(tile.width) {
            let (domain, item, count, rest, ..) = lane(work, tile, in_tile);
            let both = tile.kind & TILE_VERTICES > 0;
            let shift = if both { shifts.get(domain).copied().unwrap_or(0) } else { 0 };
            let slot = scene.layout.domains[domain];
            for within in 0..count {
                let corner = item.wrapping_add(shift) as usize + within;
                seen[corner] += 1;
                let quad = work.quads.corners[scene.domains[domain].shape] as usize;
                let own = usize::from(tile.kind & TILE_LAST) > 0;
                let lane = if own { in_tile } else { 0 };
                assert_eq!(rest as usize + lane, quad + (corner - slot.first_corner) / 4);
                assert!(rest as u64 >= work.quads.first_with_normals && (rest as u64) < work.quads.end);
            }
        }
    }
    assert!(seen.iter().all(|times| *times == 1), "every corner is computed once");
}

/// Walks the work list as the kernel does and checks that every vertex finds its x0, its entries and its q.
fn check(scene: &Arc<Scene>) -> WorkList {
    let coordinates = CoordinateLayout::new(scene);
    let work = WorkList::new(scene, &coordinates, BatchPolicy::default());
    let loaded = load(scene, &work);
    assert_eq!(loaded.words.len() as u64, work.words);
    let per_chunk = modes_per_chunk(scene.deformation.storage);
    let mut seen = vec![0; scene.layout.vertices];
    check_corners(scene, &work);
    for (index, tile) in work.tiles.iter().enumerate().filter(|(_, tile)| tile.kind & TILE_VERTICES > 0) {
        assert!((1..=TILE_QUADS).contains(&usize::from(tile.width)));
        for quad in 0..usize::from(tile.width) {
            let (domain, first, count, rest, first_q, first_scale) = lane(&work, tile, quad);
            let shape = &scene.shapes[scene.domains[domain].shape];
            assert_eq!(first_q, coordinates.first[domain]);
            let (begin, tiles) = work.spans[domain][0];
            assert!((begin..begin + tiles).contains(&(index as u32)), "the domain knows its tiles");
            assert_eq!(usize::from(tile.chunks), shape.modes.rank().div_ceil(per_chunk));
            for within in 0..count {
                let packed = first as usize + within;
                seen[packed] += 1;
                let vertex = packed - scene.layout.domains[domain].first_vertex;
                for axis in 0..3 {
                    let own = usize::from(tile.kind & TILE_LAST) > 0;
                    let (step, lane) = if own { (usize::from(tile.width), quad) } else { (1, 0) };
                    let at = 3 * rest as usize + axis * step + lane;
                    assert_eq!(loaded.rest[at][within], shape.mesh.rest_positions()[vertex][axis]);
                    for mode in 0..shape.modes.rank() {
                        let size = 4 / per_chunk;
                        let byte = ((mode % per_chunk * 3 + axis) * 4 + within) * size;
                        let row = mode / per_chunk * 3 + byte / 16;
                        let at = tile.first_word as usize + row * usize::from(tile.width) + quad;
                        let bytes = &loaded.words[at].0[byte % 16..][..size];
                        let factor = loaded.factors[scene.domains[domain].shape].get(mode).copied();
                        let got = match scene.deformation.storage {
                            StorageType::F32 => bytemuck::pod_read_unaligned::<f32>(bytes),
                            StorageType::F16 => half::f16::from_le_bytes([bytes[0], bytes[1]]).to_f32(),
                            StorageType::Bf16 => half::bf16::from_le_bytes([bytes[0], bytes[1]]).to_f32(),
                            StorageType::Int8 => {
                                (f32::from(bytes[0]) - 128.0) * loaded.scales[first_scale as usize + mode]
                            }
                        };
                        let (got, want) = (got * factor.unwrap_or(1.0), shape.modes.entry(vertex, axis, mode));
                        assert!((got - want).abs() <= want.abs() / 100.0 + 1.0, "{got} is not {want}");
                    }
                }
            }
        }
    }
    assert!(seen.iter().all(|times| *times == 1), "every vertex is computed once");
    work
}

const SHAPES: [(usize, usize); 7] = [(7, 2), (300, 0), (1, 5), (513, 1), (130, 33), (64, 2), (65, 2)];

#[test]
fn every_vertex_finds_its_entries_whatever_the_storage_and_the_tile() {
    for storage in StorageType::ALL {
        check(&stored(&SHAPES, storage));
    }
}

#[test]
fn small_rigid_domains_fill_tiles_together_and_those_with_modes_do_unless_they_share_them() {
    let vertices = |work: &WorkList| -> Vec<WarpTile> {
        work.tiles.iter().filter(|tile| tile.kind & TILE_VERTICES > 0).copied().collect()
    };
    // Two instances of each shape: those with modes share U and have tiles of their own.
    let work = check(&scene(&[(7, 0); 40], false, false));
    assert_eq!(vertices(&work).len(), 80 * 2 / 32);
    assert!(vertices(&work).iter().all(|tile| (tile.kind & TILE_LAST, tile.width) == (0, 32)));
    let work = check(&scene(&[(7, 3); 40], false, false));
    assert_eq!((vertices(&work).len(), work.words), (80, 40 * 2 * 3 * 3));
    let work = check(&single(&[(7, 3); 80]));
    assert_eq!((vertices(&work).len(), work.words), (80 * 2 / 32, 80 * 2 * 3 * 3));
}

#[test]
fn corners_that_are_the_vertices_share_their_tiles_and_have_no_room_of_their_own() {
    let work = check(&super::super::test_scenes::corners_match(&[(7, 2), (300, 0), (9, 0)]));
    assert!(work.tiles.iter().all(|tile| tile.kind & (TILE_VERTICES | TILE_CORNERS) == TILE_VERTICES | TILE_CORNERS));
    assert_eq!((work.quads.first_with_normals, work.quads.end), (0, work.quads.rest));
    let work = check(&single(&[(7, 2), (300, 0)]));
    assert!(
        work.tiles
            .iter()
            .all(|tile| [TILE_VERTICES, TILE_CORNERS].contains(&(tile.kind & (TILE_VERTICES | TILE_CORNERS))))
    );
}

/// Every shape used by one domain.
fn single(shapes: &[(usize, usize)]) -> Arc<Scene> {
    super::super::test_scenes::used_once(shapes)
}

#[test]
fn tiles_with_the_most_modes_come_first() {
    let work = check(&single(&[(7, 1), (700, 9), (9, 0), (200, 40), (8, 9)]));
    let chunks: Vec<u16> = work.tiles.iter().map(|tile| tile.chunks).collect();
    assert!(chunks.windows(2).all(|pair| pair[0] >= pair[1]), "{chunks:?}");
    assert_eq!((chunks[0], chunks[chunks.len() - 1]), (40, 0));
}

#[test]
fn coordinates_fill_whole_chunks_unless_chunks_are_single_modes() {
    let shapes = [(7, 3), (9, 5)];
    let packed = CoordinateLayout::new(&stored(&shapes, StorageType::F32));
    assert_eq!((packed.first.as_slice(), packed.total, packed.is_scene_order), ([0, 3, 6, 11].as_slice(), 16, true));
    let chunked = CoordinateLayout::new(&stored(&shapes, StorageType::Int8));
    assert_eq!((chunked.first.as_slice(), chunked.total), ([0, 4, 8, 16].as_slice(), 24));
}
