//! Partition of the triangle groups into blocks, and the data that the culling shaders share with the host.

use bytemuck::{Pod, Zeroable};

use crate::scene_data::geometry::{BlendMode, DrawGroup};
use crate::types::{CullStats, FrameCullStats};

/// Triangles per block; one workgroup tests a block.
pub(crate) const WORKGROUP_SIZE: u32 = 256;
/// Blocks per super block, whose listed triangles are counted together.
pub(crate) const SUPERBLOCK: u32 = 64;
/// Maximum number of groups: three kinds, single- and double-sided.
pub(crate) const MAX_GROUPS: usize = 6;
/// Words of the counters: five classes for the camera, five for the sun. First words of each.
const COUNTER_WORDS: usize = 10;
pub(crate) const COUNTER_BYTES: usize = 4 * COUNTER_WORDS;
pub(crate) const CAMERA_COUNTERS: usize = 0;
pub(crate) const SHADOW_COUNTERS: usize = 5;
/// The coarsest level of the depth pyramid: squares of 2^8 pixels.
pub(crate) const MAX_LEVEL: u32 = 8;
/// Storage bindings of the culling passes.
pub(crate) const DRAWS_BINDING: u32 = 0;
pub(crate) const VISIBLE_BITS_BINDING: u32 = 1;
pub(crate) const COUNTERS_BINDING: u32 = 2;
pub(crate) const PREVIOUSLY_VISIBLE_BINDING: u32 = 3;
pub(crate) const PYRAMID_BINDING: u32 = 4;
pub(crate) const TRIANGLE_IDS_BINDING: u32 = 5;
pub(crate) const INDICES_BINDING: u32 = 6;
/// Workgroups in a row of the dispatch over blocks.
const MAX_DISPATCH_WIDTH: u32 = 1 << 15;
/// Words of an indexed indirect draw, and words of the ledger before its totals.
const COMMAND_WORDS: usize = 5;
const TOTALS_OFFSET: usize = COMMAND_WORDS * MAX_GROUPS + 2;

/// Uniform block of the groups. Twin of `GroupBlock` in `shaders/shared/cull.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct CullUniforms {
    /// First triangle, number of triangles, first workgroup, first block.
    ranges: [[u32; 4]; MAX_GROUPS],
    /// Whether the group is single-sided, and whether it uses vertices only.
    flags: [[u32; 4]; MAX_GROUPS],
    /// Number of groups, workgroups and blocks.
    count: [u32; 4],
    /// Step of the rasterizer's subpixel grid, in pixels.
    subpixel_step: [f32; 4],
}

const _: () = assert!(size_of::<CullUniforms>() == 224, "CullUniforms differs from shaders/shared/cull.glsl");

impl CullUniforms {
    /// Lays out the groups of a scene for a device with this subpixel step.
    pub(crate) fn new(groups: &[DrawGroup], subpixel_step: f32) -> Self {
        let mut own = Self { subpixel_step: [subpixel_step, 0.0, 0.0, 0.0], ..Self::zeroed() };
        let (mut work, mut block) = (0, 0);
        for ((place, way), group) in own.ranges.iter_mut().zip(&mut own.flags).zip(groups) {
            *place = [group.first_triangle as u32, group.triangles as u32, work, block];
            *way = [u32::from(!group.double_sided), u32::from(group.blend_mode == BlendMode::Opaque), 0, 0];
            let blocks = (group.triangles as u32).div_ceil(WORKGROUP_SIZE);
            work += blocks;
            // A super block contains blocks of one group only.
            block += blocks.next_multiple_of(SUPERBLOCK);
        }
        own.count = [groups.len() as u32, work, block, 0];
        own
    }

    /// Workgroups of the dispatch over all blocks.
    pub(crate) fn dispatch(&self) -> [u32; 2] {
        [self.count[1].min(MAX_DISPATCH_WIDTH), self.count[1].div_ceil(MAX_DISPATCH_WIDTH)]
    }

    /// Bytes of a bitmap with one bit for every triangle of every block.
    pub(crate) const fn mask_bytes(&self) -> usize {
        self.count[2] as usize * WORKGROUP_SIZE as usize / 8
    }

    /// Bytes of the ledger.
    pub(crate) const fn draws_bytes(&self) -> usize {
        4 * (TOTALS_OFFSET + (self.count[2] / SUPERBLOCK) as usize)
    }

    /// Initial ledger: an empty draw for each group, and zero totals.
    pub(crate) fn empty_draws(&self) -> Vec<u8> {
        let mut words = vec![0_u32; self.draws_bytes() / 4];
        for (command_offset, place) in words.chunks_exact_mut(COMMAND_WORDS).zip(&self.ranges) {
            // Index count, instances, first index, base vertex, base instance.
            command_offset.copy_from_slice(&[0, 1, 3 * place[0], 0, 0]);
        }
        bytemuck::cast_slice(&words).to_vec()
    }
}

/// Byte offset of a group's indirect draw in the ledger.
pub(crate) const fn command_offset(group: usize) -> usize {
    4 * COMMAND_WORDS * group
}

/// Culling results of a frame, from its counts.
pub(crate) fn parse_counters(counts: &[u8]) -> FrameCullStats {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(counts);
    let view = |first: usize| {
        let at = |index: usize| words.get(first + index).copied().unwrap_or_default();
        CullStats { visible: at(0), outside_view: at(1), back_facing: at(2), no_sample: at(3), occluded: at(4) }
    };
    FrameCullStats { camera: view(CAMERA_COUNTERS), shadow: view(SHADOW_COUNTERS) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(first_triangle: usize, triangles: usize) -> DrawGroup {
        DrawGroup { blend_mode: BlendMode::Mask, double_sided: true, first_triangle, triangles }
    }

    #[test]
    fn blocks_follow_each_other_in_a_group_and_no_super_block_has_two_groups() {
        let groups = CullUniforms::new(&[group(0, 1), group(1, 256 * 64 + 1), group(16386, 256)], 0.25);
        assert_eq!(groups.ranges[..3], [[0, 1, 0, 0], [1, 16385, 1, 64], [16386, 256, 66, 192]]);
        assert_eq!((groups.count, groups.dispatch()), ([3, 67, 256, 0], [67, 1]));
        assert_eq!(groups.mask_bytes(), 256 * 32);
        let ledger: Vec<u32> = bytemuck::pod_collect_to_vec(&groups.empty_draws());
        assert_eq!(ledger.len(), 32 + 4);
        assert_eq!(ledger[command_offset(1) / 4..][..5], [0, 1, 3, 0, 0]);
        assert_eq!(
            ledger[command_offset(2) / 4..][..10],
            [0, 1, 3 * 16386, 0, 0, 0, 1, 0, 0, 0],
            "the fourth is not there"
        );
    }

    #[test]
    fn a_dispatch_of_very_many_blocks_has_several_rows_and_leaves_none_out() {
        let groups = CullUniforms::new(&[group(0, 1 << 26)], 0.0);
        let [wide, tall] = groups.dispatch();
        assert!(
            wide <= 65535
                && wide * tall >= (1 << 26) / WORKGROUP_SIZE
                && wide * (tall - 1) < (1 << 26) / WORKGROUP_SIZE
        );
    }
}
