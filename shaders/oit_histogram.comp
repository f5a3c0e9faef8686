// Histogram of the number of blended fragments per pixel, and the total number of fragments. Bin b counts the pixels
// with b + 1 fragments; the last bin also counts pixels with more. A workgroup adds TILE_SIDE x TILE_SIDE pixels.
layout(local_size_x = TILE_SIDE, local_size_y = TILE_SIDE) in;
shared uint local_bins[BINS];
shared uint tile_total;
shared uint tile_max;

void main() {
    uint lane = gl_LocalInvocationIndex;
    for (uint bin = lane; bin < BINS; bin += TILE_SIDE * TILE_SIDE) local_bins[bin] = 0u;
    if (lane == 0u) tile_total = 0u, tile_max = 0u;
    memoryBarrierShared();
    barrier();
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    uint count = 0u;
    if (all(lessThan(pixel, imageSize(fragment_counts)))) count = imageLoad(fragment_counts, pixel).x;
    if (count > 0u) {
        atomicAdd(local_bins[min(count, uint(BINS)) - 1u], 1u);
        atomicAdd(tile_total, count);
        atomicMax(tile_max, count);
    }
    memoryBarrierShared();
    barrier();
    for (uint bin = lane; bin < BINS; bin += TILE_SIDE * TILE_SIDE) {
        if (local_bins[bin] > 0u) atomicAdd(counters.bins[bin], local_bins[bin]);
    }
    if (lane == 0u && tile_total > 0u) {
        uint previous_total = atomicAdd(counters.fragment_total[0], tile_total);
        bool has_carry = previous_total + tile_total < previous_total;
        if (has_carry) atomicAdd(counters.fragment_total[1], 1u);
        atomicMax(counters.max_per_pixel, tile_max);
    }
}
