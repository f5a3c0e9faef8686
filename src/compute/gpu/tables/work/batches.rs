//! Groups of domains that share a shape, for which `batch` reads U once. Pure.

use super::super::layout::{BatchBlock, BatchGroup, BatchMember};
use super::{CoordinateLayout, WorkList, chunks_of, quads_of};
use crate::storage::TILE_QUADS;
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::Scene;

/// Maximum number of domains of a group.
pub(crate) const MAX_BATCH_SIZE: usize = 16;

/// With `BatchPolicy::Auto`, a shape has batches when its U has at least so many bytes, about a third of a large device's
/// L2 cache. Measured on an H200: of U of two domains, both ways took the same time at 20 MB.
const MIN_SHAPE_BYTES: u64 = 16 << 20;
/// A shape also has batches when all its domains together would read at least so many bytes of U. Below both limits it
/// is faster to read U again from the cache, because a batch uses few warps for a long time. Measured on an H200: both
/// ways took the same time at about 100 MB of 16,000 vertices.
const MIN_READ_BYTES: u64 = 128 << 20;

/// Number of blocks that keep a large device busy to the end. With more work, a block processes a run of up to
/// [`MAX_TILES_PER_BLOCK`] tiles, for which it loads T and q once.
const TARGET_BLOCKS: usize = 4096;
const MAX_TILES_PER_BLOCK: usize = 8;

/// The work list of `batch`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct BatchTables {
    pub groups: Vec<BatchGroup>,
    pub members: Vec<BatchMember>,
    pub blocks: Vec<BatchBlock>,
    /// Maximum number of chunks of modes of a group.
    pub chunks: usize,
    /// Maximum number of members of a group.
    pub max_members: usize,
}

/// Per shape, whether its domains are deformed in batches.
pub(crate) fn shapes(scene: &Scene, policy: BatchPolicy) -> Vec<bool> {
    let features = scene.features;
    // `batch` neither truncates nor compensates its sums, and writes no displacements.
    let never = features.truncation || features.compensated || features.displacements;
    let mut users = vec![0_usize; scene.shapes.len()];
    scene.domains.iter().for_each(|domain| users[domain.shape] += 1);
    let chosen = |(shape, users): (usize, usize)| {
        let of = &scene.shapes[shape];
        let bytes = (48 * quads_of(of) * chunks_of(scene, of)) as u64;
        let pays = bytes >= MIN_SHAPE_BYTES || users as u64 * bytes >= MIN_READ_BYTES;
        match policy {
            BatchPolicy::Never => false,
            BatchPolicy::Auto => users > 1 && pays,
            BatchPolicy::Always => users > 1,
        }
    };
    let has_modes = |shape: usize| scene.shapes[shape].modes.rank() > 0;
    users.into_iter().enumerate().map(|user| !never && has_modes(user.0) && chosen(user)).collect()
}

impl BatchTables {
    /// Number of tiles of all groups.
    pub(crate) fn tiles(&self) -> usize {
        self.blocks.iter().map(|block| (block.end - block.tile) as usize).sum()
    }

    /// Groups the domains of an existing work list; `first_words` are the first words of the shapes.
    pub(crate) fn new(
        scene: &Scene,
        (work, coordinates): (&WorkList, &CoordinateLayout),
        (batched, first_words): (&[bool], &[Option<u64>]),
    ) -> Self {
        let mut shapes: Vec<usize> = (0..scene.shapes.len()).filter(|shape| batched[*shape]).collect();
        shapes.sort_by_key(|shape| std::cmp::Reverse(chunks_of(scene, &scene.shapes[*shape])));
        let mut users = vec![Vec::new(); scene.shapes.len()];
        scene.domains.iter().enumerate().for_each(|(index, domain)| users[domain.shape].push(index));
        let mut all = Self::default();
        let tiles_of = |shape: usize| quads_of(&scene.shapes[shape]).div_ceil(TILE_QUADS);
        let work_items = shapes.iter().map(|shape| tiles_of(*shape) * users[*shape].len().div_ceil(MAX_BATCH_SIZE));
        let run = (work_items.sum::<usize>() / TARGET_BLOCKS).clamp(1, MAX_TILES_PER_BLOCK);
        for shape in shapes {
            let of = &scene.shapes[shape];
            let first_group = all.groups.len();
            let users = &users[shape];
            // Split evenly, so that no group is nearly empty.
            let count = users.len().div_ceil(MAX_BATCH_SIZE);
            for list in users.chunks(users.len().div_ceil(count)) {
                all.groups.push(BatchGroup {
                    first_word: first_words[shape].unwrap_or(0),
                    rest: work.quads.vertices[shape],
                    first_scale: work.first_scale[shape],
                    vertices: of.mesh.rest_positions().len() as u32,
                    first_member: all.members.len() as u32,
                    chunks: chunks_of(scene, of) as u32,
                    members: list.len() as u32,
                });
                all.members.extend(list.iter().map(|domain| BatchMember {
                    first: scene.layout.domains[*domain].first_vertex as u32,
                    first_q: coordinates.first[*domain],
                    domain: *domain as u32,
                    first_tile: work.spans[*domain][0].0,
                }));
                all.max_members = all.max_members.max(list.len());
            }
            all.chunks = all.chunks.max(chunks_of(scene, of));
            // Blocks of the groups of one shape are adjacent: U that one block reads is in the cache for the next.
            let groups = first_group as u32..all.groups.len() as u32;
            let end = tiles_of(shape) as u32;
            all.blocks.extend((0..end).step_by(run).flat_map(|tile| {
                let end = end.min(tile + run as u32);
                groups.clone().map(move |group| BatchBlock { group, tile, end, reserved: 0 })
            }));
        }
        all
    }
}
