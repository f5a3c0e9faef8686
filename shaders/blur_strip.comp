// Both directions of the Gaussian blur (equation 3.11) in one pass: depth in, blurred moments out. A workgroup walks down a
// strip of the map, a column a lane, TURN rows a turn. A turn's depths, and those REACH to each side, go through shared
// memory, where a lane finds its neighbours. A lane adds each blurred row to the 2 REACH + 1 sums of its column that the
// row is part of; they stay in registers, so that the second direction reads nothing. Two halves of the shared memory
// take turns: a barrier a turn is enough.
layout(local_size_x = LANES) in;
layout(FORMAT, binding = 0) uniform writeonly image2D to;
shared float depths[2 * TURN * (LANES + 2 * REACH)];

void main() {
    int side = int(frame.shadow.w), lane = int(gl_LocalInvocationIndex), half_at = 0;
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * ivec2(LANES, TALL);
    // Of rows above the strip, too, which are not stored.
    // @SUMS
    for (int first = 0; first < TALL + 2 * REACH; first += TURN) {
        // @LOAD
        memoryBarrierShared();
        barrier();
        // @ADD
        half_at = TURN * (LANES + 2 * REACH) - half_at;
    }
}
