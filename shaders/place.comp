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
shared uint room[TILE * TILE];
shared uint most;
shared uint first;
shared uint any_here;

// Maximum number of records per pixel for which all lists fit; unlimited if all fragments fit. With b_k pixels of k
// fragments, raising the maximum from k to k + 1 costs one record for each pixel with more than k fragments: the sum of
// b_j over j > k.
uint fair() {
    if (ledger.total[1] == 0u && ledger.total[0] <= ledger.budget) return ALL;
    uint more = 0u;
    for (int bin = 0; bin < BINS; bin++) more += ledger.bins[bin];
    uint sum = 0u, kept = 0u;
    while (kept < uint(BINS) && more <= ledger.budget - sum) {
        sum += more;
        more -= ledger.bins[kept];
        kept++;
    }
    return kept;
}

void main() {
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) {
        any_here = 0u;
        most = fair();
        if (gl_WorkGroupID.xy == uvec2(0u)) {
            ledger.most = most;
            // Instance counts: none when nothing is dropped.
            ledger.commands[1] = ledger.commands[6] = most == ALL ? 0u : 1u;
        }
    }
    memoryBarrierShared();
    barrier();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    bool inside = all(lessThan(at, imageSize(counts)));
    uint count_here = inside ? imageLoad(counts, at).x : 0u;
    uint own = min(count_here, most);
    room[lane] = own;
    if (count_here > 0u) any_here = 1u;
    for (uint reach = 1u; reach < TILE * TILE; reach *= 2u) {
        memoryBarrierShared();
        barrier();
        uint before = lane >= reach ? room[lane - reach] : 0u;
        memoryBarrierShared();
        barrier();
        room[lane] += before;
    }
    memoryBarrierShared();
    barrier();
    if (lane == TILE * TILE - 1u) first = room[lane] > 0u ? atomicAdd(ledger.used, room[lane]) : 0u;
    memoryBarrierShared();
    barrier();
    uint begin = first + room[lane] - own;
    if (inside) imageStore(ends, at, uvec4(begin));
    if (count_here > own) {
        for (uint index = begin; index < begin + own; index++) {
            records[2u * index] = ALL;
            records[2u * index + 1u] = 0u;
        }
    }
    if (lane == 0u && any_here > 0u) {
        uint place = atomicAdd(count, 1u);
        if (place % ROW == 0u) atomicAdd(groups[1], 1u);
        tiles[place] = gl_WorkGroupID.x | gl_WorkGroupID.y << 16;
    }
}
