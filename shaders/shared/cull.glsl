// Groups and blocks of triangles that culling tests, and its results. A workgroup tests a block: WORKGROUP_SIZE
// triangles of one group. A superblock is SUPERBLOCK consecutive blocks. Twins: `CullUniforms` and
// `CullUniforms::empty_draws` in src/render/layout/cull.rs.
//   commands  [MAX_GROUPS][5]       indexed indirect draws
//   totals    [superblocks]         number of visible triangles
//   bits      [blocks][MASK_WORDS]  one bit per triangle: whether it is visible
const uint MASK_WORDS = uint(WORKGROUP_SIZE) / 32u;

layout(std140, binding = 3) uniform GroupBlock {
    uvec4 ranges[MAX_GROUPS]; // first triangle, triangles, first workgroup, first block
    uvec4 flags[MAX_GROUPS];  // whether it is single-sided; whether it uses vertices only, without corners
    uvec4 count;              // groups, workgroups, blocks
    vec4 subpixel_step;       // x: step of the rasterizer's subpixel grid, in pixels
} groups;

layout(std430, binding = 0) buffer CullDraws {
    uint commands[5 * MAX_GROUPS];
    uint unused[2];
    uint totals[];
} draws;
layout(std430, binding = 1) buffer Bits { uint bits[]; };

// The block of this workgroup.
struct Block {
    uint group;
    uint index;     // among the blocks of all groups
    uint triangle;  // of this lane, within the group
    bool in_range;  // whether the group has this triangle
};

uint workgroup_index() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

Block current_block() {
    uint workgroup = workgroup_index(), group = 0u;
    while (group + 1u < groups.count.x && workgroup >= groups.ranges[group + 1u].z) group++;
    uint index_in_group = workgroup - groups.ranges[group].z;
    uint triangle = index_in_group * uint(WORKGROUP_SIZE) + gl_LocalInvocationIndex;
    return Block(group, groups.ranges[group].w + index_in_group, triangle, triangle < groups.ranges[group].y);
}
