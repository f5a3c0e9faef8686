// Which triangles of which groups are looked at, and what is listed of them. A workgroup looks at a block: LANES triangles
// of one group. Twins: `Groups` and `Ledger` in src/render/cull/layout.rs.
//   ledger  commands [GROUPS] five words of an indexed draw; totals [supers] listed triangles of SUPER blocks
//   bits    [blocks][LANES / 32]  the triangles of a block that are listed
const uint WORDS = uint(LANES) / 32u;

layout(std140, binding = 3) uniform GroupBlock {
    uvec4 places[GROUPS]; // first triangle, triangles, first workgroup, first block
    uvec4 ways[GROUPS];   // whether it has one side; whether it is made of vertices alone, without corners
    uvec4 count;          // groups, workgroups
    vec4 grid;            // the part of a pixel to which the rasteriser rounds places
} groups;

layout(std430, binding = 0) buffer Ledger {
    uint commands[5 * GROUPS];
    uint unused[2];
    uint totals[];
} ledger;
layout(std430, binding = 1) buffer Bits { uint bits[]; };

// The block of this workgroup: its group, its place, and the triangle of this lane within the group.
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
