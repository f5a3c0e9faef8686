//! Tests that read the work list of `deform` in the same way as the kernel. In most test scenes, two domains use each
//! shape (`test_scenes`).

use super::super::layout::LAST_QUAD_ITEMS;
use super::super::test_scenes::{scene, scene_with_matching_corners, scene_with_storage, scene_without_sharing};
use super::*;
use std::sync::Arc;

/// The tables of U and x0 that `deform` reads.
pub(crate) struct LoadedTables {
    pub words: Vec<PackedWord>,
    pub scales: Vec<f32>,
    pub rest_positions: Vec<[f32; 4]>,
    /// Per shape and mode.
    pub factors: Vec<Vec<f32>>,
}

pub(crate) fn load_tables(scene: &Scene, work: &WorkList) -> LoadedTables {
    let tiles = |shape: usize| TiledModes::new(&scene.shapes[shape], scene.deformation.storage);
    let mut loaded = LoadedTables {
        words: Vec::new(),
        scales: vec![0.0; work.scale_count as usize],
        rest_positions: rest_positions(scene, work),
        factors: Vec::new(),
    };
    for source in &work.sources {
        match source {
            WordSource::Shape(shape) => loaded.words.extend_from_slice(tiles(*shape).packed_words()),
            WordSource::Mixed(shapes) => {
                loaded.words.extend(mix_tiles(&shapes.iter().map(|shape| tiles(*shape)).collect::<Vec<_>>()));
            }
        }
    }
    for shape in 0..scene.shapes.len() {
        let tiles = tiles(shape);
        loaded.scales[work.first_scales[shape] as usize..][..tiles.scales().len()].copy_from_slice(tiles.scales());
        loaded.factors.push(tiles.factors().to_vec());
    }
    loaded
}

/// A quad of a tile, as `load_lane_slice` of the kernel derives it.
struct Quad {
    domain: usize,
    /// Index of the first item among the vertices or corners of all domains.
    first_item: u32,
    item_count: usize,
    /// Index of the first quad of the tile in the table of x0; in a mixed tile, of this quad.
    rest_quad: u32,
    /// Index of this quad relative to `rest_quad`.
    quad_in_tile: usize,
    /// Number of float4 vectors from one component of x0 to the next one.
    component_stride: usize,
    first_q: u32,
    first_scale: u32,
}

fn load_quad(work: &WorkList, tile: &WarpTile, quad: usize) -> Quad {
    let last_quad_items = usize::from(tile.kind & LAST_QUAD_ITEMS);
    let quad_count = usize::from(tile.quad_count);
    if last_quad_items > 0 {
        Quad {
            domain: tile.domain as usize,
            first_item: tile.first_item + 4 * quad as u32,
            item_count: if quad + 1 == quad_count { last_quad_items } else { 4 },
            rest_quad: tile.rest_quad,
            quad_in_tile: quad,
            component_stride: quad_count,
            first_q: tile.first_q,
            first_scale: tile.first_scale,
        }
    } else {
        let index = tile.first_item as usize + quad;
        let mixed_quad = work.mixed_quads[index];
        Quad {
            domain: (mixed_quad.packed_domain / 4) as usize,
            first_item: mixed_quad.first_item,
            item_count: 1 + mixed_quad.packed_domain as usize % 4,
            rest_quad: mixed_quad.rest_quad,
            quad_in_tile: 0,
            component_stride: 1,
            first_q: mixed_quad.first_q,
            first_scale: work.mixed_quad_scales.get(index).copied().unwrap_or(0),
        }
    }
}

/// Checks that exactly one tile computes each corner, and that the tile finds the rest normal of the corner.
fn check_corners(scene: &Scene, work: &WorkList) {
    let mut tile_counts = vec![0; scene.layout.corners];
    for tile in work.tiles.iter().filter(|tile| tile.kind & TILE_CORNERS > 0) {
        for quad in (0..usize::from(tile.quad_count)).map(|quad| load_quad(work, tile, quad)) {
            let has_offset = tile.kind & TILE_VERTICES > 0 && !work.corner_offsets.is_empty();
            let offset = if has_offset { work.corner_offsets[quad.domain] } else { 0 };
            let layout = scene.layout.domains[quad.domain];
            let first_quad = work.quads.corner_quads[scene.domains[quad.domain].shape] as usize;
            for item in 0..quad.item_count {
                let corner = quad.first_item.wrapping_add(offset) as usize + item;
                tile_counts[corner] += 1;
                let rest_quad = quad.rest_quad as usize + quad.quad_in_tile;
                assert_eq!(rest_quad, first_quad + (corner - layout.first_corner) / 4);
                let quads_with_normals = work.quads.first_direction_quad..work.quads.quad_count;
                assert!(quads_with_normals.contains(&u64::from(quad.rest_quad)));
            }
        }
    }
    assert!(tile_counts.iter().all(|count| *count == 1), "expected one tile per corner");
}

/// Reads the work list as the kernel does. Checks that exactly one tile computes each vertex, and that the tile finds
/// x0, q and the entries of U of the vertex.
fn check_work_list(scene: &Arc<Scene>) -> WorkList {
    let coordinates = CoordinateLayout::new(scene);
    let work = WorkList::new(scene, &coordinates, BatchPolicy::default());
    let loaded = load_tables(scene, &work);
    assert_eq!(loaded.words.len() as u64, work.word_count);
    check_corners(scene, &work);
    let chunk_modes = modes_per_chunk(scene.deformation.storage);
    let mut tile_counts = vec![0; scene.layout.vertices];
    for (index, tile) in work.tiles.iter().enumerate().filter(|(_, tile)| tile.kind & TILE_VERTICES > 0) {
        assert!((1..=TILE_QUADS).contains(&usize::from(tile.quad_count)));
        for quad_index in 0..usize::from(tile.quad_count) {
            let quad = load_quad(&work, tile, quad_index);
            let shape = &scene.shapes[scene.domains[quad.domain].shape];
            assert_eq!(quad.first_q, coordinates.first_q[quad.domain]);
            let span = work.domain_tiles[quad.domain].vertices;
            assert!((span.first..span.first + span.count).contains(&(index as u32)), "{span:?} lacks tile {index}");
            assert_eq!(usize::from(tile.chunk_count), shape.modes.rank().div_ceil(chunk_modes));
            for item in 0..quad.item_count {
                let packed_vertex = quad.first_item as usize + item;
                tile_counts[packed_vertex] += 1;
                let vertex = packed_vertex - scene.layout.domains[quad.domain].first_vertex;
                for axis in 0..3 {
                    let x0 = 3 * quad.rest_quad as usize + axis * quad.component_stride + quad.quad_in_tile;
                    assert_eq!(loaded.rest_positions[x0][item], shape.mesh.rest_positions()[vertex][axis]);
                    for mode in 0..shape.modes.rank() {
                        let entry = load_entry(scene, &loaded, (tile, quad_index), &quad, [mode, axis, item]);
                        let expected = shape.modes.entry(vertex, axis, mode);
                        // Int8 rounds by at most 1/254 of the largest entry of the tile and mode. Entries grow in steps
                        // of 0.25 (`test_scenes`), so that entry exceeds `expected` by less than 0.25 * 3 * 128 = 96.
                        let tolerance = expected.abs() / 100.0 + 1.0;
                        assert!((entry - expected).abs() <= tolerance, "expected {expected}, got {entry}");
                    }
                }
            }
        }
    }
    assert!(tile_counts.iter().all(|count| *count == 1), "expected one tile per vertex");
    work
}

/// Decodes the entry `[mode, axis, item]` of U of a quad.
fn load_entry(
    scene: &Scene,
    loaded: &LoadedTables,
    (tile, quad_index): (&WarpTile, usize),
    quad: &Quad,
    [mode, axis, item]: [usize; 3],
) -> f32 {
    let storage = scene.deformation.storage;
    let chunk_modes = modes_per_chunk(storage);
    let entry_bytes = 4 / chunk_modes;
    let byte_offset = ((mode % chunk_modes * 3 + axis) * 4 + item) * entry_bytes;
    let row = mode / chunk_modes * 3 + byte_offset / 16;
    let word = tile.first_word as usize + row * usize::from(tile.quad_count) + quad_index;
    let bytes = &loaded.words[word].0[byte_offset % 16..][..entry_bytes];
    let stored = match storage {
        StorageType::F32 => bytemuck::pod_read_unaligned::<f32>(bytes),
        StorageType::F16 => half::f16::from_le_bytes([bytes[0], bytes[1]]).to_f32(),
        StorageType::Bf16 => half::bf16::from_le_bytes([bytes[0], bytes[1]]).to_f32(),
        StorageType::Int8 => (f32::from(bytes[0]) - 128.0) * loaded.scales[quad.first_scale as usize + mode],
    };
    let factor = loaded.factors[scene.domains[quad.domain].shape].get(mode).copied();
    stored * factor.unwrap_or(1.0)
}

/// (vertices, rank) of each shape.
const SHAPES: [(usize, usize); 7] = [(7, 2), (300, 0), (1, 5), (513, 1), (130, 33), (64, 2), (65, 2)];

#[test]
fn every_vertex_finds_its_entries_in_every_storage() {
    for storage in StorageType::ALL {
        check_work_list(&scene_with_storage(&SHAPES, storage));
    }
}

#[test]
fn small_domains_share_tiles_unless_they_share_modes() {
    let vertex_tiles = |work: &WorkList| -> Vec<WarpTile> {
        work.tiles.iter().filter(|tile| tile.kind & TILE_VERTICES > 0).copied().collect()
    };
    // Two domains of each shape. With modes they share U and have tiles of their own.
    let work = check_work_list(&scene(&[(7, 0); 40]));
    assert_eq!(vertex_tiles(&work).len(), 80 * 2 / 32, "80 domains of two quads, 32 quads per tile");
    assert!(vertex_tiles(&work).iter().all(|tile| (tile.kind & LAST_QUAD_ITEMS, tile.quad_count) == (0, 32)));
    let work = check_work_list(&scene(&[(7, 3); 40]));
    // 40 shapes of two quads, three chunks, and three words per quad and chunk.
    assert_eq!((vertex_tiles(&work).len(), work.word_count), (80, 40 * 2 * 3 * 3));
    let work = check_work_list(&scene_without_sharing(&[(7, 3); 80]));
    assert_eq!((vertex_tiles(&work).len(), work.word_count), (80 * 2 / 32, 80 * 2 * 3 * 3));
}

#[test]
fn matching_corners_share_tiles_and_quads_with_vertices() {
    let work = check_work_list(&scene_with_matching_corners(&[(7, 2), (300, 0), (9, 0)]));
    assert!(work.tiles.iter().all(|tile| tile.kind & (TILE_VERTICES | TILE_CORNERS) == TILE_VERTICES | TILE_CORNERS));
    let quads = &work.quads;
    assert_eq!((quads.first_direction_quad, quads.quad_count), (0, quads.position_quad_count));
    let work = check_work_list(&scene_without_sharing(&[(7, 2), (300, 0)]));
    assert!(
        work.tiles
            .iter()
            .all(|tile| [TILE_VERTICES, TILE_CORNERS].contains(&(tile.kind & (TILE_VERTICES | TILE_CORNERS))))
    );
}

#[test]
fn tiles_with_the_most_modes_come_first() {
    let work = check_work_list(&scene_without_sharing(&[(7, 1), (700, 9), (9, 0), (200, 40), (8, 9)]));
    let chunks: Vec<u16> = work.tiles.iter().map(|tile| tile.chunk_count).collect();
    assert!(chunks.windows(2).all(|pair| pair[0] >= pair[1]), "{chunks:?}");
    assert_eq!((chunks[0], chunks[chunks.len() - 1]), (40, 0));
}

#[test]
fn coordinates_are_padded_to_whole_chunks() {
    let shapes = [(7, 3), (9, 5)];
    let packed = CoordinateLayout::new(&scene_with_storage(&shapes, StorageType::F32));
    assert_eq!((packed.first_q.as_slice(), packed.total, packed.is_scene_order), ([0, 3, 6, 11].as_slice(), 16, true));
    let chunked = CoordinateLayout::new(&scene_with_storage(&shapes, StorageType::Int8));
    assert_eq!((chunked.first_q.as_slice(), chunked.total), ([0, 4, 8, 16].as_slice(), 24));
}
