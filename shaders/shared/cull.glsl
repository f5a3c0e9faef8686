// Inputs and results of triangle culling. A group contains the triangles of one indirect draw. A workgroup tests a
// block: WORKGROUP_SIZE triangles of one group. A superblock is SUPERBLOCK consecutive blocks of one group. Block
// indices are padded, so that each group begins with a new superblock; no workgroup runs for the padding. Twins:
// `CullUniforms` and `CullUniforms::empty_draws` in src/render/layout/cull.rs.
//   commands  [MAX_GROUPS][5]       indirect draws: index count, instances, first index, base vertex, base instance
//   totals    [superblocks]         number of visible triangles of the superblock
//   bits      [blocks][MASK_WORDS]  one bit per triangle: whether it is visible
const uint MASK_WORDS = uint(WORKGROUP_SIZE) / 32u;

layout(std140, binding = 3) uniform GroupBlock {
    uvec4 ranges[MAX_GROUPS]; // first triangle, triangles, first workgroup, first block
    uvec4 flags[MAX_GROUPS];  // x: 1 for a single-sided group; y: 1 if its index list contains vertices, 0 for corners
    uvec4 count;              // numbers of groups, of workgroups, of blocks with padding
    vec4 subpixel_step;       // x: step of the rasterizer's subpixel grid, in pixels
} groups;

layout(std430, binding = 0) buffer CullDraws {
    uint commands[5 * MAX_GROUPS];
    uint padding[2];
    uint totals[];
} draws;
layout(std430, binding = 1) buffer Bits { uint bits[]; };

// The block of this workgroup, and the triangle of this lane.
struct Block {
    uint group;
    uint index;         // among the blocks of all groups, with padding
    uint triangle;      // index within the group
    bool has_triangle;  // false for the last lanes of the group's last block
};

uint workgroup_index() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

Block current_block() {
    uint workgroup = workgroup_index(), group = 0u;
    while (group + 1u < groups.count.x && workgroup >= groups.ranges[group + 1u].z) group++;
    uint index_in_group = workgroup - groups.ranges[group].z;
    uint triangle = index_in_group * uint(WORKGROUP_SIZE) + gl_LocalInvocationIndex;
    return Block(group, groups.ranges[group].w + index_in_group, triangle, triangle < groups.ranges[group].y);
}
