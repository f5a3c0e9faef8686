// Compacts the triangles whose bits are set, in their order: three indices each for the draw, and the index in the draw
// order that their fragments write as id. A group's list begins at the offset of the group. A prefix sum gives the
// offset of each block, so that the order does not depend on scheduling: totals of the preceding super blocks, then
// bits of the preceding blocks.
//   indices  [triangles][3]  of vertices, or of corners
//   names    [triangles]     indices in the draw order
layout(local_size_x = WORKGROUP_SIZE) in;
layout(binding = 17) uniform usamplerBuffer triangle_corners;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;
layout(std430, binding = 5) writeonly buffer TriangleIds { uint triangle_ids[]; };
layout(std430, binding = 6) writeonly buffer Indices { uint indices[]; };

shared uint preceding_count;

void main() {
    if (workgroup_index() >= groups.count.y) return;
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) preceding_count = 0u;
    Block block = current_block();
    memoryBarrierShared();
    barrier();
    uint super_block = block.place / SUPERBLOCK, sum = 0u;
    for (uint at = groups.ranges[block.group].w / SUPERBLOCK + lane; at < super_block; at += uint(WORKGROUP_SIZE)) sum += draws.totals[at];
    for (uint at = super_block * SUPERBLOCK * MASK_WORDS + lane; at < block.place * MASK_WORDS; at += uint(WORKGROUP_SIZE)) sum += bitCount(bits[at]);
    if (sum > 0u) atomicAdd(preceding_count, sum);
    memoryBarrierShared();
    barrier();
    uint first_word = block.place * MASK_WORDS, own_word = first_word + lane / 32u, below = (1u << (lane & 31u)) - 1u;
    uint word = bits[own_word];
    if ((word & (below + 1u)) == 0u) return;
    uint place = groups.ranges[block.group].x + preceding_count + bitCount(word & below);
    for (uint at = first_word; at < own_word; at++) place += bitCount(bits[at]);
    uint triangle = groups.ranges[block.group].x + block.triangle;
    bool is_solid = groups.flags[block.group].y != 0u;
    uvec3 corners = is_solid ? texelFetch(triangle_vertices, int(triangle)).xyz : texelFetch(triangle_corners, int(triangle)).xyz;
    triangle_ids[place] = triangle;
    for (uint corner = 0u; corner < 3u; corner++) indices[3u * place + corner] = corners[corner];
}
