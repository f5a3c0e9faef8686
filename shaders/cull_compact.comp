// Writes the index lists of the visible triangles, those whose bits are set, in draw order. A group's list begins at
// the index of the group's first triangle. The offset of a block in the list is the number of visible triangles before
// it: the totals of the group's preceding superblocks, plus the bits of the preceding blocks in the same superblock. So
// the order does not depend on scheduling. `shared/cull.glsl` defines groups, blocks and superblocks.
//   indices       (out)  [triangles][3]  indices of vertices for groups that need only positions, else of corners
//   triangle_ids  (out)  [triangles]     index in the draw order, which the fragments write as id
layout(local_size_x = WORKGROUP_SIZE) in;
layout(binding = 17) uniform usamplerBuffer triangle_corners;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;
layout(std430, binding = 5) writeonly buffer TriangleIds { uint triangle_ids[]; };
layout(std430, binding = 6) writeonly buffer Indices { uint indices[]; };

shared uint preceding_count; // visible triangles of the group in preceding blocks

void main() {
    if (workgroup_index() >= groups.count.y) return;
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) preceding_count = 0u;
    Block block = current_block();
    memoryBarrierShared();
    barrier();
    uvec4 range = groups.ranges[block.group]; // first triangle, triangles, first workgroup, first block
    uint superblock = block.index / SUPERBLOCK, partial_sum = 0u;
    uint first_superblock = range.w / SUPERBLOCK;
    for (uint index = first_superblock + lane; index < superblock; index += uint(WORKGROUP_SIZE)) partial_sum += draws.totals[index];
    uint superblock_word = superblock * SUPERBLOCK * MASK_WORDS, block_word = block.index * MASK_WORDS;
    for (uint index = superblock_word + lane; index < block_word; index += uint(WORKGROUP_SIZE)) partial_sum += bitCount(bits[index]);
    if (partial_sum > 0u) atomicAdd(preceding_count, partial_sum);
    memoryBarrierShared();
    barrier();
    // `lower_lanes`: mask of the lanes before this lane in its word. `lower_lanes + 1` is the bit of this lane.
    uint lane_word = block_word + lane / 32u, lower_lanes = (1u << (lane & 31u)) - 1u;
    uint mask = bits[lane_word];
    if ((mask & (lower_lanes + 1u)) == 0u) return;
    uint output_index = range.x + preceding_count + bitCount(mask & lower_lanes);
    for (uint word_index = block_word; word_index < lane_word; word_index++) output_index += bitCount(bits[word_index]);
    uint triangle = range.x + block.triangle;
    bool is_position_only = groups.flags[block.group].y != 0u;
    uvec3 triangle_indices = is_position_only
        ? texelFetch(triangle_vertices, int(triangle)).xyz
        : texelFetch(triangle_corners, int(triangle)).xyz;
    triangle_ids[output_index] = triangle;
    for (uint corner = 0u; corner < 3u; corner++) indices[3u * output_index + corner] = triangle_indices[corner];
}
