// Histogram of the number of blended fragments per pixel, and their total.
layout(local_size_x = TILE_SIDE, local_size_y = TILE_SIDE) in;
shared uint local_bins[BINS];
shared uint sum;
shared uint largest;

void main() {
    uint lane = gl_LocalInvocationIndex;
    for (uint bin = lane; bin < BINS; bin += TILE_SIDE * TILE_SIDE) local_bins[bin] = 0u;
    if (lane == 0u) sum = 0u, largest = 0u;
    memoryBarrierShared();
    barrier();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    uint count = 0u;
    if (all(lessThan(at, imageSize(fragment_counts)))) count = imageLoad(fragment_counts, at).x;
    if (count > 0u) {
        atomicAdd(local_bins[min(count, uint(BINS)) - 1u], 1u);
        atomicAdd(sum, count);
        atomicMax(largest, count);
    }
    memoryBarrierShared();
    barrier();
    for (uint bin = lane; bin < BINS; bin += TILE_SIDE * TILE_SIDE) {
        if (local_bins[bin] > 0u) atomicAdd(counters.bins[bin], local_bins[bin]);
    }
    if (lane == 0u && sum > 0u) {
        uint low = atomicAdd(counters.total[0], sum);
        if (low + sum < low) atomicAdd(counters.total[1], 1u);
        atomicMax(counters.max_per_pixel, largest);
    }
}
