//! Groups of domains that share a shape, for which `batch` reads U once.

use super::super::layout::{BatchBlock, BatchGroup, BatchMember};
use super::{CoordinateLayout, WorkList, chunk_count, count_users, quad_count};
use crate::storage::TILE_QUADS;
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::domain::Shape;
use modalcast_model::scene::Scene;

/// Maximum number of domains of a group.
pub(crate) const MAX_BATCH_SIZE: usize = 16;

/// With `BatchPolicy::Auto`, the domains of a shape are deformed in batches when the shape's U has at least this many
/// bytes, about a third of the L2 cache of a large device. On an H200, `batch` and `deform` took the same time for two
/// domains with a U of 20 MB.
const MIN_SHAPE_BYTES: u64 = 16 << 20;
/// With `BatchPolicy::Auto`, the domains of a shape are also deformed in batches when `deform` would read at least this
/// many bytes of U for all these domains. Below both limits, `deform` is faster: it reads U from the L2 cache for each
/// further domain, whereas a batch uses few warps for a long time. On an H200, `batch` and `deform` took the same time
/// at about 100 MB for shapes of 16,000 vertices.
const MIN_READ_BYTES: u64 = 128 << 20;

/// Number of blocks that keep a large device busy until the kernel ends. With more work, a block processes up to
/// [`MAX_TILES_PER_BLOCK`] consecutive tiles, for which it loads T and q once.
const TARGET_BLOCKS: usize = 4096;
const MAX_TILES_PER_BLOCK: usize = 8;

/// The work list of `batch`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct BatchTables {
    pub groups: Vec<BatchGroup>,
    pub members: Vec<BatchMember>,
    pub blocks: Vec<BatchBlock>,
    /// Maximum number of chunks of modes of a group.
    pub max_chunks: usize,
    /// Maximum number of members of a group.
    pub max_members: usize,
}

/// Per shape, whether its domains are deformed in batches.
pub(crate) fn batched_shapes(scene: &Scene, policy: BatchPolicy) -> Vec<bool> {
    let features = scene.features;
    // `batch` does not compensate its sums, and writes no displacements.
    let is_supported = !(features.compensated || features.displacements);
    let is_batched = |(shape, user_count): (&Shape, usize)| {
        let bytes = (48 * quad_count(shape) * chunk_count(scene, shape)) as u64;
        let is_faster = bytes >= MIN_SHAPE_BYTES || user_count as u64 * bytes >= MIN_READ_BYTES;
        let is_wanted = match policy {
            BatchPolicy::Never => false,
            BatchPolicy::Auto => is_faster,
            BatchPolicy::Always => true,
        };
        is_supported && shape.modes.rank() > 0 && user_count > 1 && is_wanted
    };
    scene.shapes.iter().zip(count_users(scene)).map(is_batched).collect()
}

impl BatchTables {
    /// Number of tiles of all groups. A tile counts once for each group of its shape.
    pub(crate) fn tiles(&self) -> usize {
        self.blocks.iter().map(|block| (block.end_tile - block.first_tile) as usize).sum()
    }

    /// Groups the domains of a work list. Per shape, `is_batched` tells whether its domains are deformed in batches,
    /// and `first_words` has its first word of U.
    pub(crate) fn new(
        scene: &Scene,
        work: &WorkList,
        coordinates: &CoordinateLayout,
        is_batched: &[bool],
        first_words: &[Option<u64>],
    ) -> Self {
        let mut shape_indices: Vec<usize> = (0..scene.shapes.len()).filter(|shape| is_batched[*shape]).collect();
        shape_indices.sort_by_key(|shape| std::cmp::Reverse(chunk_count(scene, &scene.shapes[*shape])));
        let mut users = vec![Vec::new(); scene.shapes.len()];
        scene.domains.iter().enumerate().for_each(|(index, domain)| users[domain.shape].push(index));
        let mut tables = Self::default();
        let tile_count = |shape: usize| quad_count(&scene.shapes[shape]).div_ceil(TILE_QUADS);
        let group_tiles =
            shape_indices.iter().map(|shape| tile_count(*shape) * users[*shape].len().div_ceil(MAX_BATCH_SIZE));
        let tiles_per_block = (group_tiles.sum::<usize>() / TARGET_BLOCKS).clamp(1, MAX_TILES_PER_BLOCK);
        for shape_index in shape_indices {
            let (shape, users) = (&scene.shapes[shape_index], &users[shape_index]);
            let first_group = tables.groups.len();
            // Split the domains evenly, so that no group is nearly empty.
            let group_count = users.len().div_ceil(MAX_BATCH_SIZE);
            for domains in users.chunks(users.len().div_ceil(group_count)) {
                tables.groups.push(BatchGroup {
                    first_word: first_words[shape_index].unwrap_or(0),
                    rest_quad: work.quads.vertex_quads[shape_index],
                    first_scale: work.first_scales[shape_index],
                    vertex_count: shape.mesh.rest_positions().len() as u32,
                    first_member: tables.members.len() as u32,
                    chunk_count: chunk_count(scene, shape) as u32,
                    member_count: domains.len() as u32,
                });
                tables.members.extend(domains.iter().map(|domain| BatchMember {
                    first_vertex: scene.layout.domains[*domain].first_vertex as u32,
                    first_q: coordinates.first_q[*domain],
                    domain: *domain as u32,
                    first_tile: work.domain_tiles[*domain].vertices.first,
                }));
                tables.max_members = tables.max_members.max(domains.len());
            }
            tables.max_chunks = tables.max_chunks.max(chunk_count(scene, shape));
            // The blocks of all groups of a shape for the same tiles are adjacent, so that all but the first of them
            // read U from the cache.
            let groups = first_group as u32..tables.groups.len() as u32;
            let tile_count = tile_count(shape_index) as u32;
            tables.blocks.extend((0..tile_count).step_by(tiles_per_block).flat_map(|first_tile| {
                let end_tile = tile_count.min(first_tile + tiles_per_block as u32);
                groups.clone().map(move |group| BatchBlock { group, first_tile, end_tile, reserved: 0 })
            }));
        }
        tables
    }
}
