// Groups and blocks of triangles that culling tests, and its results. A workgroup tests a block: LANES triangles of one
// group. Twins: `Groups` and `Groups::empty_ledger` in src/render/cull/layout.rs.
//   ledger  commands [GROUPS] indexed indirect draws of five words; totals [supers] listed triangles per SUPER blocks
//   bits    [blocks][LANES / 32]  one bit per triangle of a block: whether it is listed
const uint WORDS = uint(LANES) / 32u;

layout(std140, binding = 3) uniform GroupBlock {
    uvec4 places[GROUPS]; // first triangle, triangles, first workgroup, first block
    uvec4 ways[GROUPS];   // whether it is single-sided; whether it uses vertices only, without corners
    uvec4 count;          // groups, workgroups, blocks
    vec4 grid;            // step of the rasterizer's subpixel grid, in pixels
} groups;

layout(std430, binding = 0) buffer Ledger {
    uint commands[5 * GROUPS];
    uint unused[2];
    uint totals[];
} ledger;
layout(std430, binding = 1) buffer Bits { uint bits[]; };

// The block of this workgroup: its group, its index, and the triangle of this lane within the group.
struct Block {
    uint group;
    uint place;
    uint triangle;
    bool is_there;
};

uint own_work() { return gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x; }

Block own_block() {
    uint work = own_work(), group = 0u;
    while (group + 1u < groups.count.x && work >= groups.places[group + 1u].z) group++;
    uint index = work - groups.places[group].z;
    uint triangle = index * uint(LANES) + gl_LocalInvocationIndex;
    return Block(group, groups.places[group].w + index, triangle, triangle < groups.places[group].y);
}
