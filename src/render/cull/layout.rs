//! Partition of the triangle groups into blocks, and the data that the culling shaders share with the host.

use bytemuck::{Pod, Zeroable};

use super::super::geometry::{Group, Kind};

/// Triangles per block; one workgroup tests a block.
pub(crate) const LANES: u32 = 256;
/// Blocks per super block, whose listed triangles are counted together.
pub(crate) const SUPER: u32 = 64;
/// Maximum number of groups: three kinds, single- and double-sided.
pub(crate) const GROUPS: usize = 6;
/// Workgroups in a row of the dispatch over blocks.
const ROW: u32 = 1 << 15;
/// Words of an indexed indirect draw, and words of the ledger before its totals.
const COMMAND: usize = 5;
const HEAD: usize = COMMAND * GROUPS + 2;

/// Uniform block of the groups. Twin of `GroupBlock` in `shaders/shared/cull.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Groups {
    /// First triangle, number of triangles, first workgroup, first block.
    places: [[u32; 4]; GROUPS],
    /// Whether the group is single-sided, and whether it uses vertices only.
    ways: [[u32; 4]; GROUPS],
    /// Number of groups, workgroups and blocks.
    count: [u32; 4],
    /// Step of the rasterizer's subpixel grid, in pixels.
    grid: [f32; 4],
}

const _: () = assert!(size_of::<Groups>() == 224, "Groups differs from shaders/shared/cull.glsl");

impl Groups {
    /// Lays out the groups of a scene for a device with this subpixel step.
    pub(crate) fn new(groups: &[Group], grid: f32) -> Self {
        let mut own = Self { grid: [grid, 0.0, 0.0, 0.0], ..Self::zeroed() };
        let (mut work, mut block) = (0, 0);
        for ((place, way), group) in own.places.iter_mut().zip(&mut own.ways).zip(groups) {
            *place = [group.first_triangle as u32, group.triangles as u32, work, block];
            *way = [u32::from(!group.double_sided), u32::from(group.kind == Kind::Opaque), 0, 0];
            let blocks = (group.triangles as u32).div_ceil(LANES);
            work += blocks;
            // A super block contains blocks of one group only.
            block += blocks.next_multiple_of(SUPER);
        }
        own.count = [groups.len() as u32, work, block, 0];
        own
    }

    /// Workgroups of the dispatch over all blocks.
    pub(crate) fn dispatch(&self) -> [u32; 2] {
        [self.count[1].min(ROW), self.count[1].div_ceil(ROW)]
    }

    /// Bytes of a bitmap with one bit for every triangle of every block.
    pub(crate) const fn bit_bytes(&self) -> usize {
        self.count[2] as usize * LANES as usize / 8
    }

    /// Bytes of the ledger.
    pub(crate) const fn ledger_bytes(&self) -> usize {
        4 * (HEAD + (self.count[2] / SUPER) as usize)
    }

    /// Initial ledger: an empty draw for each group, and zero totals.
    pub(crate) fn empty_ledger(&self) -> Vec<u8> {
        let mut words = vec![0_u32; self.ledger_bytes() / 4];
        for (command, place) in words.chunks_exact_mut(COMMAND).zip(&self.places) {
            // Index count, instances, first index, base vertex, base instance.
            command.copy_from_slice(&[0, 1, 3 * place[0], 0, 0]);
        }
        bytemuck::cast_slice(&words).to_vec()
    }
}

/// Byte offset of a group's indirect draw in the ledger.
pub(crate) const fn command(group: usize) -> usize {
    4 * COMMAND * group
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(first_triangle: usize, triangles: usize) -> Group {
        Group { kind: Kind::Mask, double_sided: true, first_triangle, triangles }
    }

    #[test]
    fn blocks_follow_each_other_in_a_group_and_no_super_block_has_two_groups() {
        let groups = Groups::new(&[group(0, 1), group(1, 256 * 64 + 1), group(16386, 256)], 0.25);
        assert_eq!(groups.places[..3], [[0, 1, 0, 0], [1, 16385, 1, 64], [16386, 256, 66, 192]]);
        assert_eq!((groups.count, groups.dispatch()), ([3, 67, 256, 0], [67, 1]));
        assert_eq!(groups.bit_bytes(), 256 * 32);
        let ledger: Vec<u32> = bytemuck::pod_collect_to_vec(&groups.empty_ledger());
        assert_eq!(ledger.len(), 32 + 4);
        assert_eq!(ledger[command(1) / 4..][..5], [0, 1, 3, 0, 0]);
        assert_eq!(ledger[command(2) / 4..][..10], [0, 1, 3 * 16386, 0, 0, 0, 1, 0, 0, 0], "the fourth is not there");
    }

    #[test]
    fn a_dispatch_of_very_many_blocks_has_several_rows_and_leaves_none_out() {
        let groups = Groups::new(&[group(0, 1 << 26)], 0.0);
        let [wide, tall] = groups.dispatch();
        assert!(wide <= 65535 && wide * tall >= (1 << 26) / LANES && wide * (tall - 1) < (1 << 26) / LANES);
    }
}
