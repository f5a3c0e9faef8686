//! The structs that host and kernels share, field by field as in `kernels/layout.cuh`, which documents the fields. Both
//! sides assert the sizes, and tests compare the offsets.
//!
//! An item is a vertex or a corner, and a quad is four consecutive items. A tile is up to 32 quads, the work of one
//! warp; a mixed tile has quads of several domains. A field `first_x` is the index of the first element in the table x.

use bytemuck::{Pod, Zeroable};

use crate::storage::TILE_QUADS;
use modalcast_model::domain::RING_START;
use modalcast_model::scene::TransformRoots;

/// Threads per block of `apply`, `bounds` and `normals`, and corners per block of `normals`.
pub(crate) const BLOCK: u32 = 256;

/// Threads per warp.
pub(crate) const WARP_THREADS: u32 = 32;

/// `first_tangent` of a shape without tangents.
pub(crate) const NO_TANGENTS: u32 = u32::MAX;

/// `first_corner_group` of a shape without smoothing groups.
pub(crate) const NO_GROUPS: u32 = u32::MAX;

/// [`TransformLink::frame`] of a domain that is its own transform root.
pub(crate) const NO_FRAME: u32 = TransformRoots::NO_FRAME;

/// Bit mask of [`WarpTile::kind`]: the number of items (vertices or corners) of the last quad; 0 in a mixed tile.
pub(crate) const LAST_QUAD_ITEMS: u8 = 7;
/// Bit of [`WarpTile::kind`]: the tile computes positions.
pub(crate) const TILE_VERTICES: u8 = 8;
/// Bit of [`WarpTile::kind`]: the tile computes normals and tangents.
pub(crate) const TILE_CORNERS: u8 = 16;

/// The start of a step's inputs; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct StepHeader {
    pub positions: u64,
    pub normals: u64,
    pub tangents: u64,
    pub displacements: u64,
    /// Number of the last step that the output buffers contain before the launch; 0 for a full step, which writes all
    /// outputs.
    pub output_step: u32,
    /// Number of the last step that computed all domains.
    pub last_full_step: u32,
    /// Number of this step, counted from 1.
    pub step: u32,
    pub change_count: u32,
    pub dirty_tile_count: u32,
    pub reserved: [u32; 3],
    /// Output of `bounds`: the box along the coordinate axes, and one along `bounding_axes` if they are used. A box has
    /// six keys, which compare like its floats (`box_keys`).
    pub bounds: [u32; 12],
}

/// The work of one warp of `deform`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct WarpTile {
    pub first_word: u64,
    pub first_item: u32,
    pub rest_quad: u32,
    pub domain: u32,
    pub first_q: u32,
    pub first_scale: u32,
    pub chunk_count: u16,
    pub quad_count: u8,
    pub kind: u8,
}

/// A quad of a mixed tile.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct MixedQuad {
    pub first_item: u32,
    pub rest_quad: u32,
    /// Four times the domain, plus the number of items of the quad, minus 1.
    pub packed_domain: u32,
    pub first_q: u32,
}

/// An entry of the list of changed domains that `apply` reads.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct Change {
    pub domain: u32,
    pub first_q: u32,
    pub q_count: u32,
    pub first_new_q: u32,
}

/// The transform root of a domain (the domain whose transform it uses), and the frame of a follower (its constant
/// transform relative to its root); only in scenes with followers.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct TransformLink {
    pub root: u32,
    pub frame: u32,
}

/// Arguments of `deform`. Pointers are device addresses, as in all arguments below.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct DeformArgs {
    pub header: u64,
    pub tiles: u64,
    pub mixed_quads: u64,
    pub words: u64,
    pub rest_positions: u64,
    pub rest_normals: u64,
    pub rest_tangents: u64,
    pub corner_offsets: u64,
    pub scales: u64,
    pub mixed_quad_scales: u64,
    pub transforms: u64,
    pub transform_links: u64,
    pub follower_frames: u64,
    pub q: u64,
    pub tile_list: u64,
    pub boxes: u64,
    pub tile_count: u32,
    pub reserved: u32,
}

/// A group of domains of one shape, for which `batch` reads U once. The domains are the members of the group.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct BatchGroup {
    pub first_word: u64,
    pub rest_quad: u32,
    pub first_scale: u32,
    pub vertex_count: u32,
    pub first_member: u32,
    pub chunk_count: u32,
    pub member_count: u32,
}

/// A domain of a [`BatchGroup`].
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct BatchMember {
    pub first_vertex: u32,
    pub first_q: u32,
    pub domain: u32,
    pub first_tile: u32,
}

/// The work of one block of `batch`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct BatchBlock {
    pub group: u32,
    pub first_tile: u32,
    pub end_tile: u32,
    pub reserved: u32,
}

/// Arguments of `batch`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct BatchArgs {
    pub header: u64,
    pub blocks: u64,
    pub groups: u64,
    pub members: u64,
    pub words: u64,
    pub rest_positions: u64,
    pub scales: u64,
    pub transforms: u64,
    pub transform_links: u64,
    pub follower_frames: u64,
    pub q: u64,
    pub boxes: u64,
}

/// A part of a domain that `bounds` reduces to one box.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct BoxSegment {
    pub first_item: u32,
    pub item_count: u32,
    pub domain: u32,
    pub is_vertex_range: u32,
}

/// Arguments of `bounds`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct BoundsArgs {
    pub header: u64,
    pub boxes: u64,
    pub segments: u64,
    pub change_steps: u64,
    pub segment_boxes: u64,
    pub box_count: u32,
    pub segment_count: u32,
    pub bounding_axes: [f32; 9],
    pub reserved: u32,
}

/// Arguments of `apply`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct ApplyArgs {
    pub header: u64,
    pub changes: u64,
    pub new_transforms: u64,
    pub new_q: u64,
    pub dirty_tiles: u64,
    pub transform_links: u64,
    pub transforms: u64,
    pub q: u64,
    pub change_steps: u64,
    pub tile_list: u64,
}

/// Offsets of the corners and vertices of one domain in the tables of `normals`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(crate) struct NormalSlot {
    pub first_corner: u32,
    pub first_normal: u32,
    pub first_tangent: u32,
    pub first_vertex: u32,
    pub first_corner_group: u32,
}

/// Arguments of `normals`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct NormalsArgs {
    pub header: u64,
    pub slots: u64,
    pub first_domains: u64,
    pub rest_normals: u64,
    pub rest_tangents: u64,
    pub transforms: u64,
    pub transform_links: u64,
    pub follower_frames: u64,
    pub change_steps: u64,
    pub corner_groups: u64,
    pub ring_offsets: u64,
    pub rings: u64,
    pub group_normals: u64,
    pub corner_count: u32,
    pub rest_corner_count: u32,
    pub group_count: u32,
    pub reserved: u32,
}

const _: () = assert!(size_of::<StepHeader>() == 112, "StepHeader differs from kernels/layout.cuh");
const _: () = assert!(size_of::<WarpTile>() == 32, "WarpTile differs from kernels/layout.cuh");
const _: () = assert!(size_of::<MixedQuad>() == 16, "MixedQuad differs from kernels/layout.cuh");
const _: () = assert!(size_of::<Change>() == 16, "Change differs from kernels/layout.cuh");
const _: () = assert!(size_of::<TransformLink>() == 8, "TransformLink differs from kernels/layout.cuh");
const _: () = assert!(size_of::<DeformArgs>() == 136, "DeformArgs differs from kernels/layout.cuh");
const _: () = assert!(size_of::<BatchGroup>() == 32, "BatchGroup differs from kernels/layout.cuh");
const _: () = assert!(size_of::<BatchMember>() == 16, "BatchMember differs from kernels/layout.cuh");
const _: () = assert!(size_of::<BatchBlock>() == 16, "BatchBlock differs from kernels/layout.cuh");
const _: () = assert!(size_of::<BatchArgs>() == 96, "BatchArgs differs from kernels/layout.cuh");
const _: () = assert!(size_of::<BoxSegment>() == 16, "BoxSegment differs from kernels/layout.cuh");
const _: () = assert!(size_of::<BoundsArgs>() == 88, "BoundsArgs differs from kernels/layout.cuh");
const _: () = assert!(size_of::<ApplyArgs>() == 80, "ApplyArgs differs from kernels/layout.cuh");
const _: () = assert!(size_of::<NormalSlot>() == 20, "NormalSlot differs from kernels/layout.cuh");
const _: () = assert!(size_of::<NormalsArgs>() == 120, "NormalsArgs differs from kernels/layout.cuh");

/// A size, offset or constant that must be the same on host and device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayoutConstant {
    /// The C++ expression, e.g. `OFFSET(WarpTile, rest_quad)`.
    pub expression: String,
    /// Its value on the host.
    pub host: u32,
}

macro_rules! layout_constants {
    ($($struct_name:ident { $($field:ident),* })*) => {
        vec![$(
            LayoutConstant { expression: concat!("sizeof(", stringify!($struct_name), ")").into(), host: size_of::<$struct_name>() as u32 },
            $(LayoutConstant {
                expression: concat!("OFFSET(", stringify!($struct_name), ", ", stringify!($field), ")").into(),
                host: std::mem::offset_of!($struct_name, $field) as u32,
            },)*
        )*]
    };
}

/// Every size, offset and constant that host and device share, with the host's value.
pub fn layout_constants() -> Vec<LayoutConstant> {
    let mut list = layout_constants! {
        StepHeader {
            positions, normals, tangents, displacements, output_step, last_full_step, step, change_count, dirty_tile_count,
            reserved, bounds
        }
        WarpTile { first_word, first_item, rest_quad, domain, first_q, first_scale, chunk_count, quad_count, kind }
        MixedQuad { first_item, rest_quad, packed_domain, first_q }
        Change { domain, first_q, q_count, first_new_q }
        TransformLink { root, frame }
        DeformArgs {
            header, tiles, mixed_quads, words, rest_positions, rest_normals, rest_tangents, corner_offsets, scales,
            mixed_quad_scales, transforms, transform_links, follower_frames, q, tile_list, boxes, tile_count, reserved
        }
        BatchGroup { first_word, rest_quad, first_scale, vertex_count, first_member, chunk_count, member_count }
        BatchMember { first_vertex, first_q, domain, first_tile }
        BatchBlock { group, first_tile, end_tile, reserved }
        BatchArgs {
            header, blocks, groups, members, words, rest_positions, scales, transforms, transform_links, follower_frames, q, boxes
        }
        BoxSegment { first_item, item_count, domain, is_vertex_range }
        BoundsArgs { header, boxes, segments, change_steps, segment_boxes, box_count, segment_count, bounding_axes, reserved }
        ApplyArgs { header, changes, new_transforms, new_q, dirty_tiles, transform_links, transforms, q, change_steps, tile_list }
        NormalSlot { first_corner, first_normal, first_tangent, first_vertex, first_corner_group }
        NormalsArgs {
            header, slots, first_domains, rest_normals, rest_tangents, transforms, transform_links, follower_frames, change_steps,
            corner_groups, ring_offsets, rings, group_normals, corner_count, rest_corner_count, group_count, reserved
        }
    };
    for (name, host) in
        [("LAST_QUAD_ITEMS", LAST_QUAD_ITEMS), ("TILE_VERTICES", TILE_VERTICES), ("TILE_CORNERS", TILE_CORNERS)]
    {
        list.push(LayoutConstant { expression: name.into(), host: u32::from(host) });
    }
    list.push(LayoutConstant { expression: "TILE_QUADS".into(), host: TILE_QUADS as u32 });
    list.push(LayoutConstant { expression: "BLOCK".into(), host: BLOCK });
    list.push(LayoutConstant { expression: "NO_TANGENTS".into(), host: NO_TANGENTS });
    list.push(LayoutConstant { expression: "NO_GROUPS".into(), host: NO_GROUPS });
    list.push(LayoutConstant { expression: "NO_FRAME".into(), host: NO_FRAME });
    list.push(LayoutConstant { expression: "RING_START".into(), host: RING_START });
    list
}

/// The start of a CUDA source that evaluates the expressions of [`LayoutConstant`]s. NVRTC has no `offsetof`, so
/// `OFFSET` computes the address of a field in a struct at address 0.
pub(crate) const PRELUDE: &str =
    "#include \"layout.cuh\"\n#define OFFSET(type, field) __INTADDR__(&(((type*)0)->field))\n";

/// Source of a kernel `layout_values`, which writes the device's value of every layout constant to its argument, in the
/// order of [`layout_constants`].
pub(crate) fn layout_kernel_source() -> String {
    let line = |(index, constant): (usize, &LayoutConstant)| {
        format!("    values[{index}] = (unsigned)({});\n", constant.expression)
    };
    let lines: String = layout_constants().iter().enumerate().map(line).collect();
    format!("{PRELUDE}extern \"C\" __global__ void layout_values(unsigned* values) {{\n{lines}}}\n")
}
