// Both directions of the Gaussian blur (equation 3.11) in one pass: depth in, blurred moments out. A workgroup walks
// down a strip of the map, one column per lane and TURN rows per iteration. The depths of an iteration, with margins of
// REACH to each side, go through shared memory, where each lane reads those of its neighbors. A lane adds each blurred
// row to the 2 REACH + 1 sums of its column that contain the row. The sums stay in registers, so that the second
// direction reads no memory. The shared memory is double-buffered, so one barrier per iteration is enough.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(FORMAT, binding = 0) uniform writeonly image2D destination;
shared float depths[2 * STEP_ROWS * (WORKGROUP_SIZE + 2 * RADIUS)];

void main() {
    int side = int(frame.shadow.w), lane = int(gl_LocalInvocationIndex), half_at = 0;
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * ivec2(WORKGROUP_SIZE, OUTPUT_ROWS);
    // Includes the sums of rows above the strip, which are not stored.
    // @SUMS
    for (int first = 0; first < OUTPUT_ROWS + 2 * RADIUS; first += STEP_ROWS) {
        // @LOAD
        memoryBarrierShared();
        barrier();
        // @ADD
        half_at = STEP_ROWS * (WORKGROUP_SIZE + 2 * RADIUS) - half_at;
    }
}
