// Allocates the list of each pixel. A list has one record per fragment, but at most `per_pixel_limit` records. A tile
// (TILE x TILE pixels) allocates the records of its lists contiguously, and a prefix sum over its pixels gives the
// offset of each list. The order of the tiles varies, but does not affect the image. Tiles with fragments are appended
// to the tile list.
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(std430, binding = 2) writeonly buffer Records { uint records[]; };
shared uint scan[TILE * TILE];
shared uint per_pixel_limit;
shared uint tile_first_record;
shared uint tile_has_fragments;

// Maximum number of records per pixel for which all lists fit the budget; UNBOUNDED if all fragments fit. Raising the
// limit from k to k + 1 needs one more record for each pixel with more than k fragments.
uint fit_per_pixel_limit() {
    // `fragment_total[1]` is the high word of the total.
    if (counters.fragment_total[1] == 0u && counters.fragment_total[0] <= counters.budget) return UNBOUNDED;
    // Number of pixels with more than `limit` fragments. Bin b counts the pixels with b + 1 fragments.
    uint pixels_above = 0u;
    for (int bin = 0; bin < BINS; bin++) pixels_above += counters.bins[bin];
    uint record_count = 0u, limit = 0u;
    while (limit < uint(BINS) && pixels_above <= counters.budget - record_count) {
        record_count += pixels_above;
        pixels_above -= counters.bins[limit];
        limit++;
    }
    return limit;
}

void main() {
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) {
        tile_has_fragments = 0u;
        per_pixel_limit = fit_per_pixel_limit();
        if (gl_WorkGroupID.xy == uvec2(0u)) {
            counters.per_pixel_limit = per_pixel_limit;
            // Word 1 of a draw's five words is its instance count. The two draws of the last gather phase run only if a
            // pixel has more fragments than the limit.
            counters.commands[1] = counters.commands[6] = per_pixel_limit == UNBOUNDED ? 0u : 1u;
        }
    }
    memoryBarrierShared();
    barrier();
    ivec2 pixel = image_pixel();
    bool is_inside = all(lessThan(pixel, imageSize(fragment_counts)));
    uint fragment_count = is_inside ? imageLoad(fragment_counts, pixel).x : 0u;
    uint record_count = min(fragment_count, per_pixel_limit);
    scan[lane] = record_count;
    if (fragment_count > 0u) tile_has_fragments = 1u;
    // Inclusive prefix sum (Hillis and Steele 1986).
    for (uint stride = 1u; stride < TILE * TILE; stride *= 2u) {
        memoryBarrierShared();
        barrier();
        uint preceding_sum = 0u;
        // Not a conditional expression, because Mesa evaluates both of its operands.
        if (lane >= stride) preceding_sum = scan[lane - stride];
        memoryBarrierShared();
        barrier();
        scan[lane] += preceding_sum;
    }
    memoryBarrierShared();
    barrier();
    if (lane == TILE * TILE - 1u) {
        uint tile_record_count = scan[lane];
        tile_first_record = tile_record_count > 0u ? atomicAdd(counters.allocated, tile_record_count) : 0u;
    }
    memoryBarrierShared();
    barrier();
    uint first_record = tile_first_record + scan[lane] - record_count;
    if (is_inside) imageStore(cursors, pixel, uvec4(first_record));
    if (fragment_count > record_count) {
        // Empty records. The gather phases lower the depth by atomic minima, and raise the id and coverage by atomic
        // maxima. So the initial depth is the largest word, and the initial id and coverage is 0.
        for (uint index = first_record; index < first_record + record_count; index++) {
            records[2u * index] = UNBOUNDED;
            records[2u * index + 1u] = 0u;
        }
    }
    if (lane == 0u && tile_has_fragments > 0u) append_tile();
}
