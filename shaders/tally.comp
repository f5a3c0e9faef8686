// Histogram of the number of blended fragments per pixel, and their total.
layout(local_size_x = SIDE, local_size_y = SIDE) in;
shared uint own_bins[BINS];
shared uint sum;
shared uint largest;

void main() {
    uint lane = gl_LocalInvocationIndex;
    for (uint bin = lane; bin < BINS; bin += SIDE * SIDE) own_bins[bin] = 0u;
    if (lane == 0u) sum = 0u, largest = 0u;
    memoryBarrierShared();
    barrier();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    uint count = 0u;
    if (all(lessThan(at, imageSize(counts)))) count = imageLoad(counts, at).x;
    if (count > 0u) {
        atomicAdd(own_bins[min(count, uint(BINS)) - 1u], 1u);
        atomicAdd(sum, count);
        atomicMax(largest, count);
    }
    memoryBarrierShared();
    barrier();
    for (uint bin = lane; bin < BINS; bin += SIDE * SIDE) {
        if (own_bins[bin] > 0u) atomicAdd(ledger.bins[bin], own_bins[bin]);
    }
    if (lane == 0u && sum > 0u) {
        uint low = atomicAdd(ledger.total[0], sum);
        if (low + sum < low) atomicAdd(ledger.total[1], 1u);
        atomicMax(ledger.deepest, largest);
    }
}
