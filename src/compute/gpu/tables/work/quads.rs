//! Layout of x0, normals and tangents at rest on the device, in quads (four vertices or corners) as `deform` reads
//! them.

use super::{QUAD, WorkList, has_own_tiles, has_rigid_normals, shapes_with_own_tiles};
use crate::storage::TILE_QUADS;
use modalcast_model::domain::Shape;
use modalcast_model::scene::Scene;

/// Indices of the quads of x0, normals and tangents. A shape matches if one tile computes its vertex i and its corner
/// i ([`WorkList::corners_match`]). Three kinds of quads follow each other:
/// 1. x0 of shapes that do not match,
/// 2. x0, normals and tangents of shapes that match,
/// 3. normals and tangents of shapes that do not match.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct QuadLayout {
    /// Per shape, its first quad of x0.
    pub vertex_quads: Vec<u32>,
    /// Per shape, its first quad of normals and tangents.
    pub corner_quads: Vec<u32>,
    /// Number of quads with x0: kinds 1 and 2.
    pub position_quad_count: u64,
    /// First quad with normals: the first of kind 2.
    pub first_direction_quad: u64,
    /// Number of quads of all kinds.
    pub quad_count: u64,
}

impl QuadLayout {
    /// `corners_match`: per shape, whether the shape matches.
    pub(crate) fn new(scene: &Scene, corners_match: &[bool]) -> Self {
        let has_rigid_normals = has_rigid_normals(scene);
        let shapes = || scene.shapes.iter().zip(corners_match);
        let vertex_count = |shape: &Shape| shape.mesh.rest_positions().len();
        let corner_count = |shape: &Shape| shape.mesh.corners().vertices.len();
        // Per shape, its number of items in quads of kinds 1, 2 and 3.
        let unmatched_vertex_counts =
            shapes().map(|(shape, corners_match)| if *corners_match { 0 } else { vertex_count(shape) });
        let matching_counts =
            shapes().map(|(shape, corners_match)| if *corners_match { vertex_count(shape) } else { 0 });
        let unmatched_corner_counts = shapes()
            .map(|(shape, corners_match)| if has_rigid_normals && !*corners_match { corner_count(shape) } else { 0 });
        let mut quad_count = 0;
        let first_unmatched_vertex_quads = append_quads(unmatched_vertex_counts, &mut quad_count);
        let first_direction_quad = quad_count;
        let first_matching_quads = append_quads(matching_counts, &mut quad_count);
        let position_quad_count = quad_count;
        let first_unmatched_corner_quads = append_quads(unmatched_corner_counts, &mut quad_count);
        let select = |unmatched: &[u32]| {
            let shapes = corners_match.iter().zip(&first_matching_quads).zip(unmatched);
            shapes
                .map(|((corners_match, matching), unmatched)| if *corners_match { *matching } else { *unmatched })
                .collect()
        };
        Self {
            vertex_quads: select(&first_unmatched_vertex_quads),
            corner_quads: select(&first_unmatched_corner_quads),
            position_quad_count,
            first_direction_quad,
            quad_count,
        }
    }
}

/// Appends the quads of each shape, and returns the index of the first quad of each shape.
fn append_quads(item_counts: impl Iterator<Item = usize>, quad_count: &mut u64) -> Vec<u32> {
    let append_shape = |item_count: usize| {
        let first_quad = *quad_count;
        *quad_count += item_count.div_ceil(QUAD) as u64;
        first_quad as u32
    };
    item_counts.map(append_shape).collect()
}

/// x0 of all shapes, three float4 per quad.
pub(crate) fn rest_positions(scene: &Scene, work: &WorkList) -> Vec<[f32; 4]> {
    let mut positions = vec![[0.0; 4]; 3 * work.quads.position_quad_count as usize];
    let shape_has_tiles = shapes_with_own_tiles(scene);
    for (index, shape) in scene.shapes.iter().enumerate() {
        let vectors = arrange_for_tiles(&quads_of_items(shape.mesh.rest_positions()), shape_has_tiles[index]);
        positions[3 * work.quads.vertex_quads[index] as usize..][..vectors.len()].copy_from_slice(&vectors);
    }
    positions
}

/// Normals at rest (three float4 per quad) and tangents at rest (four float4 per quad) of all shapes, from the first
/// quad that has normals. Both are empty without rigid normals; tangents are also empty without normal maps.
pub(crate) fn rest_directions(scene: &Scene, work: &WorkList) -> [Vec<[f32; 4]>; 2] {
    if !has_rigid_normals(scene) {
        return [Vec::new(), Vec::new()];
    }
    let quad_count = (work.quads.quad_count - work.quads.first_direction_quad) as usize;
    let mut normals = vec![[0.0; 4]; 3 * quad_count];
    let mut tangents = vec![[0.0; 4]; if scene.features.normal_maps { 4 * quad_count } else { 0 }];
    let shape_has_tiles = shapes_with_own_tiles(scene);
    for (index, shape) in scene.shapes.iter().enumerate() {
        let corner_normals = &shape.mesh.corners().normals;
        let has_tiles =
            if work.corners_match[index] { shape_has_tiles[index] } else { has_own_tiles(corner_normals.len()) };
        let first_quad = (u64::from(work.quads.corner_quads[index]) - work.quads.first_direction_quad) as usize;
        let vectors = arrange_for_tiles(&quads_of_items(corner_normals), has_tiles);
        normals[3 * first_quad..][..vectors.len()].copy_from_slice(&vectors);
        if !shape.tangents().is_empty() {
            let vectors = arrange_for_tiles(&quads_of_items(shape.tangents()), has_tiles);
            tangents[4 * first_quad..][..vectors.len()].copy_from_slice(&vectors);
        }
    }
    [normals, tangents]
}

/// Quads of N components as the kernel reads them: `[N][quads of the tile]` float4 per tile of one domain, or `[N]`
/// float4 per quad of a mixed tile.
fn arrange_for_tiles<const N: usize>(quads: &[[[f32; 4]; N]], has_own_tiles: bool) -> Vec<[f32; 4]> {
    if !has_own_tiles {
        return quads.as_flattened().to_vec();
    }
    let transpose = |tile: &[[[f32; 4]; N]]| -> Vec<[f32; 4]> {
        (0..N).flat_map(|component| tile.iter().map(move |quad| quad[component])).collect()
    };
    quads.chunks(TILE_QUADS).flat_map(transpose).collect()
}

/// Groups a list of items into quads `[component][item]`. The padding of the last quad is zero.
fn quads_of_items<const N: usize>(items: &[[f32; N]]) -> Vec<[[f32; 4]; N]> {
    let mut quads = vec![[[0.0; 4]; N]; items.len().div_ceil(QUAD)];
    for (index, item) in items.iter().enumerate() {
        (0..N).for_each(|component| quads[index / QUAD][component][index % QUAD] = item[component]);
    }
    quads
}
