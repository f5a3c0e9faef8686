// Groups and blocks of triangles that culling tests, and its results. A workgroup tests a block: LANES triangles of one
// group. Twins: `CullUniforms` and `CullUniforms::empty_draws` in src/render/cull/blocks.rs.
//   ledger  commands [GROUPS] indexed indirect draws of five words; totals [supers] listed triangles per SUPER blocks
//   bits    [blocks][LANES / 32]  one bit per triangle of a block: whether it is listed
const uint MASK_WORDS = uint(WORKGROUP_SIZE) / 32u;

layout(std140, binding = 3) uniform GroupBlock {
    uvec4 ranges[MAX_GROUPS]; // first triangle, triangles, first workgroup, first block
    uvec4 flags[MAX_GROUPS];   // whether it is single-sided; whether it uses vertices only, without corners
    uvec4 count;          // groups, workgroups, blocks
    vec4 subpixel_step;            // step of the rasterizer's subpixel grid, in pixels
} groups;

layout(std430, binding = 0) buffer CullDraws {
    uint commands[5 * MAX_GROUPS];
    uint unused[2];
    uint totals[];
} draws;
layout(std430, binding = 1) buffer Bits { uint bits[]; };

// The block of this workgroup: its group, its index, and the triangle of this lane within the group.
struct Block {
    uint group;
    uint place;
    uint triangle;
    bool in_range;
};

uint workgroup_index() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

Block current_block() {
    uint work = workgroup_index(), group = 0u;
    while (group + 1u < groups.count.x && work >= groups.ranges[group + 1u].z) group++;
    uint index = work - groups.ranges[group].z;
    uint triangle = index * uint(WORKGROUP_SIZE) + gl_LocalInvocationIndex;
    return Block(group, groups.ranges[group].w + index, triangle, triangle < groups.ranges[group].y);
}
