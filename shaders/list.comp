// Compacts the triangles whose bits are set, in their order: three indices each for the draw, and the index in the draw
// order that their fragments write as id. A group's list begins at the offset of the group. A prefix sum gives the
// offset of each block, so that the order does not depend on scheduling: totals of the preceding super blocks, then
// bits of the preceding blocks.
//   indices  [triangles][3]  of vertices, or of corners
//   names    [triangles]     indices in the draw order
layout(local_size_x = LANES) in;
layout(binding = 17) uniform usamplerBuffer triangle_corners;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;
layout(std430, binding = 5) writeonly buffer Names { uint names[]; };
layout(std430, binding = 6) writeonly buffer Indices { uint indices[]; };

shared uint before;

void main() {
    if (own_work() >= groups.count.y) return;
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) before = 0u;
    Block block = own_block();
    memoryBarrierShared();
    barrier();
    uint super_block = block.place / SUPER, sum = 0u;
    for (uint at = groups.places[block.group].w / SUPER + lane; at < super_block; at += uint(LANES)) sum += ledger.totals[at];
    for (uint at = super_block * SUPER * WORDS + lane; at < block.place * WORDS; at += uint(LANES)) sum += bitCount(bits[at]);
    if (sum > 0u) atomicAdd(before, sum);
    memoryBarrierShared();
    barrier();
    uint first_word = block.place * WORDS, own_word = first_word + lane / 32u, below = (1u << (lane & 31u)) - 1u;
    uint word = bits[own_word];
    if ((word & (below + 1u)) == 0u) return;
    uint place = groups.places[block.group].x + before + bitCount(word & below);
    for (uint at = first_word; at < own_word; at++) place += bitCount(bits[at]);
    uint triangle = groups.places[block.group].x + block.triangle;
    bool is_solid = groups.ways[block.group].y != 0u;
    uvec3 corners = is_solid ? texelFetch(triangle_vertices, int(triangle)).xyz : texelFetch(triangle_corners, int(triangle)).xyz;
    names[place] = triangle;
    for (uint corner = 0u; corner < 3u; corner++) indices[3u * place + corner] = corners[corner];
}
