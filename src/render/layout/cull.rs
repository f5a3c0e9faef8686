//! Partition of the draw groups into blocks, and the data that the culling shaders share with the host.
//!
//! A block is [`TRIANGLES_PER_BLOCK`] consecutive triangles of a group. A superblock is [`SUPERBLOCK`] consecutive
//! blocks of a group. The compaction of the visible triangles sums their numbers per superblock, then per block.

use bytemuck::{Pod, Zeroable};

use crate::scene_data::geometry::{BlendMode, DrawGroup};
use crate::types::{CullStats, FrameCullStats};

/// Triangles per block. One workgroup tests a block.
pub(crate) const TRIANGLES_PER_BLOCK: u32 = 256;
/// Blocks per superblock. The visible triangles of a superblock are counted together.
pub(crate) const SUPERBLOCK: u32 = 64;
/// Maximum number of groups: three blend modes, single- and double-sided.
pub(crate) const MAX_GROUPS: usize = 6;
/// Number of counters: five culling results for the camera, then five for the sun.
const COUNTER_WORDS: usize = 10;
pub(crate) const CULL_COUNTER_BYTES: usize = 4 * COUNTER_WORDS;
/// First counter of the camera.
pub(crate) const CAMERA_COUNTERS: usize = 0;
/// First counter of the sun.
pub(crate) const SHADOW_COUNTERS: usize = 5;
/// The coarsest level of the depth pyramid. A texel of it covers 2^8 x 2^8 pixels.
pub(crate) const MAX_LEVEL: u32 = 8;
/// Storage bindings of the culling passes.
pub(crate) const DRAWS_BINDING: u32 = 0;
pub(crate) const VISIBLE_BITS_BINDING: u32 = 1;
pub(crate) const CULL_COUNTERS_BINDING: u32 = 2;
pub(crate) const PREVIOUSLY_VISIBLE_BINDING: u32 = 3;
pub(crate) const PYRAMID_BINDING: u32 = 4;
pub(crate) const TRIANGLE_IDS_BINDING: u32 = 5;
pub(crate) const INDICES_BINDING: u32 = 6;
/// Maximum number of workgroups in a row of the dispatch over blocks; OpenGL guarantees 65535.
const MAX_DISPATCH_WIDTH: u32 = 1 << 15;
/// Words of an indexed indirect draw command: index count, instances, first index, base vertex, base instance.
const COMMAND_WORDS: usize = 5;
/// Words of the draw buffer before the totals of the superblocks: the commands and two words of padding.
const TOTALS_OFFSET: usize = COMMAND_WORDS * MAX_GROUPS + 2;

/// Uniform block of the groups. Twin of `GroupBlock` in `shaders/shared/cull.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct CullUniforms {
    /// Per group: first triangle, number of triangles, first workgroup, first block.
    ranges: [[u32; 4]; MAX_GROUPS],
    /// Per group: whether it is single-sided, and whether its index list contains vertices (opaque groups) instead of
    /// corners. A corner is a vertex with one normal and one pair of texture coordinates.
    flags: [[u32; 4]; MAX_GROUPS],
    /// Numbers of groups, of workgroups, and of blocks including the padding of each group to whole superblocks.
    count: [u32; 4],
    /// x: step of the rasterizer's subpixel grid, in pixels.
    subpixel_step: [f32; 4],
}

const _: () = assert!(size_of::<CullUniforms>() == 224, "CullUniforms differs from shaders/shared/cull.glsl");

impl CullUniforms {
    /// Computes the partition of the groups of a scene. `subpixel_step`: step of the device's subpixel grid, in pixels.
    pub(crate) fn new(groups: &[DrawGroup], subpixel_step: f32) -> Self {
        let mut uniforms = Self { subpixel_step: [subpixel_step, 0.0, 0.0, 0.0], ..Self::zeroed() };
        let (mut workgroup, mut block) = (0, 0);
        for ((range, flags), group) in uniforms.ranges.iter_mut().zip(&mut uniforms.flags).zip(groups) {
            *range = [group.first_triangle as u32, group.triangle_count as u32, workgroup, block];
            *flags = [u32::from(!group.double_sided), u32::from(group.blend_mode == BlendMode::Opaque), 0, 0];
            let blocks = (group.triangle_count as u32).div_ceil(TRIANGLES_PER_BLOCK);
            workgroup += blocks;
            // A superblock contains blocks of one group only.
            block += blocks.next_multiple_of(SUPERBLOCK);
        }
        uniforms.count = [groups.len() as u32, workgroup, block, 0];
        uniforms
    }

    /// Numbers of workgroups, in x and y, of the dispatch over all blocks.
    pub(crate) fn dispatch_size(&self) -> [u32; 2] {
        [self.count[1].min(MAX_DISPATCH_WIDTH), self.count[1].div_ceil(MAX_DISPATCH_WIDTH)]
    }

    /// Bytes of a bitmap with one bit for every triangle of every block, including the padding.
    pub(crate) const fn bitmap_bytes(&self) -> usize {
        self.count[2] as usize * TRIANGLES_PER_BLOCK as usize / 8
    }

    /// Bytes of the draw buffer: a draw command per group, then the number of visible triangles per superblock.
    pub(crate) const fn draws_bytes(&self) -> usize {
        4 * (TOTALS_OFFSET + (self.count[2] / SUPERBLOCK) as usize)
    }

    /// Initial content of the draw buffer: an empty draw for each group, and zero totals.
    pub(crate) fn empty_draws(&self) -> Vec<u8> {
        let mut words = vec![0_u32; self.draws_bytes() / 4];
        for (command, range) in words.chunks_exact_mut(COMMAND_WORDS).zip(&self.ranges) {
            // No indices, one instance.
            command.copy_from_slice(&[0, 1, 3 * range[0], 0, 0]);
        }
        bytemuck::cast_slice(&words).to_vec()
    }
}

/// Byte offset of a group's draw command in the draw buffer.
pub(crate) const fn command_offset(group: usize) -> usize {
    4 * COMMAND_WORDS * group
}

/// Parses the culling results of a frame.
pub(crate) fn parse_counters(counters: &[u8]) -> FrameCullStats {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(counters);
    let parse_view = |first_counter: usize| {
        let counter = |index: usize| words.get(first_counter + index).copied().unwrap_or_default();
        CullStats {
            visible: counter(0),
            outside_view: counter(1),
            back_facing: counter(2),
            no_sample: counter(3),
            occluded: counter(4),
        }
    };
    FrameCullStats { camera: parse_view(CAMERA_COUNTERS), shadow: parse_view(SHADOW_COUNTERS) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(first_triangle: usize, triangle_count: usize) -> DrawGroup {
        DrawGroup { blend_mode: BlendMode::Mask, double_sided: true, first_triangle, triangle_count }
    }

    #[test]
    fn superblocks_contain_consecutive_blocks_of_one_group() {
        // Blocks: 1, 65 and 1. Superblocks: 1, 2 and 1, that is, 64, 128 and 64 blocks with padding.
        let uniforms = CullUniforms::new(&[group(0, 1), group(1, 256 * 64 + 1), group(16386, 256)], 0.25);
        assert_eq!(uniforms.ranges[..3], [[0, 1, 0, 0], [1, 16385, 1, 64], [16386, 256, 66, 192]]);
        assert_eq!((uniforms.count, uniforms.dispatch_size()), ([3, 67, 256, 0], [67, 1]));
        assert_eq!(uniforms.bitmap_bytes(), 256 * 32, "expected 32 bytes for each of 256 blocks");
        let draws: Vec<u32> = bytemuck::pod_collect_to_vec(&uniforms.empty_draws());
        assert_eq!(draws.len(), TOTALS_OFFSET + 4, "expected a total for each of four superblocks");
        assert_eq!(draws[command_offset(1) / 4..][..5], [0, 1, 3, 0, 0]);
        assert_eq!(
            draws[command_offset(2) / 4..][..10],
            [0, 1, 3 * 16386, 0, 0, 0, 1, 0, 0, 0],
            "expected an empty draw for the unused fourth group"
        );
    }

    #[test]
    fn dispatch_of_many_blocks_covers_all_blocks_in_several_rows() {
        let uniforms = CullUniforms::new(&[group(0, 1 << 26)], 0.0);
        let [columns, rows] = uniforms.dispatch_size();
        let blocks = (1 << 26) / TRIANGLES_PER_BLOCK;
        assert!(columns <= 65535, "expected at most the number that OpenGL guarantees, got {columns}");
        assert!(columns * rows >= blocks && columns * (rows - 1) < blocks);
    }
}
