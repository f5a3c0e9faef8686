// Allocates the list of each pixel: an exclusive prefix sum over the counts of a tile, which allocates its records in
// one piece. The order of the tiles varies, but does not affect the picture. Tiles with lists are listed for the
// indirect dispatch over them.
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(std430, binding = 2) writeonly buffer Records { uint records[]; };
layout(std430, binding = 1) buffer Tiles {
    uint groups[3];
    uint count;
    uint tiles[];
};
shared uint scan[TILE * TILE];
shared uint per_pixel_limit;
shared uint first;
shared uint tile_has_fragments;

// Maximum number of records per pixel for which all lists fit; unlimited if all fragments fit. With b_k pixels of k
// fragments, raising the maximum from k to k + 1 costs one record for each pixel with more than k fragments: the sum of
// b_j over j > k.
uint fit_per_pixel_limit() {
    if (counters.total[1] == 0u && counters.total[0] <= counters.budget) return UNBOUNDED;
    uint more = 0u;
    for (int bin = 0; bin < BINS; bin++) more += counters.bins[bin];
    uint sum = 0u, kept = 0u;
    while (kept < uint(BINS) && more <= counters.budget - sum) {
        sum += more;
        more -= counters.bins[kept];
        kept++;
    }
    return kept;
}

void main() {
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) {
        tile_has_fragments = 0u;
        per_pixel_limit = fit_per_pixel_limit();
        if (gl_WorkGroupID.xy == uvec2(0u)) {
            counters.per_pixel_limit = per_pixel_limit;
            // Instance counts: none when nothing is dropped.
            counters.commands[1] = counters.commands[6] = per_pixel_limit == UNBOUNDED ? 0u : 1u;
        }
    }
    memoryBarrierShared();
    barrier();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    bool inside = all(lessThan(at, imageSize(fragment_counts)));
    uint count_here = inside ? imageLoad(fragment_counts, at).x : 0u;
    uint own = min(count_here, per_pixel_limit);
    scan[lane] = own;
    if (count_here > 0u) tile_has_fragments = 1u;
    for (uint reach = 1u; reach < TILE * TILE; reach *= 2u) {
        memoryBarrierShared();
        barrier();
        uint before = lane >= reach ? scan[lane - reach] : 0u;
        memoryBarrierShared();
        barrier();
        scan[lane] += before;
    }
    memoryBarrierShared();
    barrier();
    if (lane == TILE * TILE - 1u) first = scan[lane] > 0u ? atomicAdd(counters.allocated, scan[lane]) : 0u;
    memoryBarrierShared();
    barrier();
    uint begin = first + scan[lane] - own;
    if (inside) imageStore(cursors, at, uvec4(begin));
    if (count_here > own) {
        for (uint index = begin; index < begin + own; index++) {
            records[2u * index] = UNBOUNDED;
            records[2u * index + 1u] = 0u;
        }
    }
    if (lane == 0u && tile_has_fragments > 0u) {
        uint place = atomicAdd(count, 1u);
        if (place % TILES_PER_ROW == 0u) atomicAdd(groups[1], 1u);
        tiles[place] = gl_WorkGroupID.x | gl_WorkGroupID.y << 16;
    }
}
