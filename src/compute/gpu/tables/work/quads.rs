//! Layout of x0, normals and tangents at rest on the device, in quads as `deform` reads them. Pure.

use super::{QUAD, WorkList, has_own_tiles, has_rigid_normals, shapes_with_own_tiles};
use crate::storage::TILE_QUADS;
use modalcast_model::domain::Shape;
use modalcast_model::scene::Scene;

/// Offsets of the quads of x0, normals and tangents. The order is: x0 of shapes whose corners differ from their
/// vertices; x0, normals and tangents of shapes whose corner i is vertex i; normals and tangents of the first kind.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Quads {
    /// Per shape, its first quad of x0.
    pub vertices: Vec<u32>,
    /// Per shape, its first quad of normals and tangents.
    pub corners: Vec<u32>,
    /// Number of quads with x0, and the first quad that has normals.
    pub rest: u64,
    pub first_with_normals: u64,
    /// The end of all quads.
    pub end: u64,
}

impl Quads {
    /// `corners_match`: per shape, whether one lane computes a vertex and its corner.
    pub(crate) fn new(scene: &Scene, corners_match: &[bool]) -> Self {
        let has_rigid_normals = has_rigid_normals(scene);
        let places = |own: &dyn Fn(&Shape, bool) -> Option<usize>, next: &mut u64| -> Vec<u32> {
            let place = |(shape, corners_match): (&Shape, &bool)| {
                let first = *next;
                *next += own(shape, *corners_match).map_or(0, |items| items.div_ceil(QUAD)) as u64;
                first as u32
            };
            scene.shapes.iter().zip(corners_match).map(place).collect()
        };
        let vertices = |shape: &Shape| shape.mesh.rest_positions().len();
        let mut next = 0;
        let before = places(&|shape, corners_match| (!corners_match).then(|| vertices(shape)), &mut next);
        let first_with_normals = next;
        let both = places(&|shape, corners_match| corners_match.then(|| vertices(shape)), &mut next);
        let rest = next;
        let corners = |shape: &Shape| shape.mesh.corners().vertices.len();
        let behind =
            places(&|shape, corners_match| (has_rigid_normals && !corners_match).then(|| corners(shape)), &mut next);
        let choose = |others: &[u32]| {
            let each = corners_match.iter().zip(&both).zip(others);
            each.map(|((corners_match, both), other)| if *corners_match { *both } else { *other }).collect()
        };
        Self { vertices: choose(&before), corners: choose(&behind), rest, first_with_normals, end: next }
    }
}

/// x0 of all shapes, three float4 per quad.
pub(crate) fn rest_positions(scene: &Scene, work: &WorkList) -> Vec<[f32; 4]> {
    let mut all = vec![[0.0; 4]; 3 * work.quads.rest as usize];
    let own = shapes_with_own_tiles(scene);
    for (index, shape) in scene.shapes.iter().enumerate() {
        let fours = arrange_for_tiles(&quads_of_items(shape.mesh.rest_positions()), own[index]);
        all[3 * work.quads.vertices[index] as usize..][..fours.len()].copy_from_slice(&fours);
    }
    all
}

/// Normals and tangents at rest of all shapes, three and four float4 per quad, from the first quad that has normals.
/// Empty where the scene needs none.
pub(crate) fn rest_directions(scene: &Scene, work: &WorkList) -> [Vec<[f32; 4]>; 2] {
    if !has_rigid_normals(scene) {
        return [Vec::new(), Vec::new()];
    }
    let count = (work.quads.end - work.quads.first_with_normals) as usize;
    let mut normals = vec![[0.0; 4]; 3 * count];
    let mut tangents = vec![[0.0; 4]; if scene.features.normal_maps { 4 * count } else { 0 }];
    let vertices = shapes_with_own_tiles(scene);
    for (index, shape) in scene.shapes.iter().enumerate() {
        let corners = &shape.mesh.corners().normals;
        let own = if work.corners_match[index] { vertices[index] } else { has_own_tiles(corners.len()) };
        let first = (u64::from(work.quads.corners[index]) - work.quads.first_with_normals) as usize;
        let fours = arrange_for_tiles(&quads_of_items(corners), own);
        normals[3 * first..][..fours.len()].copy_from_slice(&fours);
        if !shape.tangents().is_empty() {
            let fours = arrange_for_tiles(&quads_of_items(shape.tangents()), own);
            tangents[4 * first..][..fours.len()].copy_from_slice(&fours);
        }
    }
    [normals, tangents]
}

/// Quads of N components as the kernel reads them: `[N][width]` float4 per tile of one domain, else `[N]` float4 per
/// quad.
fn arrange_for_tiles<const N: usize>(quads: &[[[f32; 4]; N]], own: bool) -> Vec<[f32; 4]> {
    if !own {
        return quads.as_flattened().to_vec();
    }
    let tile = |tile: &[[[f32; 4]; N]]| -> Vec<[f32; 4]> {
        (0..N).flat_map(|number| tile.iter().map(move |quad| quad[number])).collect()
    };
    quads.chunks(TILE_QUADS).flat_map(tile).collect()
}

/// Components of items, as quads; the padding is zero.
fn quads_of_items<const N: usize>(items: &[[f32; N]]) -> Vec<[[f32; 4]; N]> {
    let mut quads = vec![[[0.0; 4]; N]; items.len().div_ceil(QUAD)];
    for (at, item) in items.iter().enumerate() {
        (0..N).for_each(|number| quads[at / QUAD][number][at % QUAD] = item[number]);
    }
    quads
}
