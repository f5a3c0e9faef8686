// Both directions of the Gaussian blur (equation 3.11 of the thesis) in one pass: depth in, blurred moments out. A
// workgroup processes a strip of the map in ascending rows, one column per lane and ITERATION_ROWS rows per iteration.
// The depths of an iteration, with margins of RADIUS to the left and right, are staged in shared memory. For each of
// these rows, a lane computes the horizontal blur at its column and adds it to the 2 RADIUS + 1 vertical sums that
// contain the row. The sums stay in registers, so that the second direction reads no memory. The shared memory is
// double-buffered, so one barrier per iteration is enough. `BlurStrip` in src/render/shaders/blur_strip.rs inserts
// unrolled code at the three markers.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(FORMAT, binding = 0) uniform writeonly image2D destination;
layout(location = 2) uniform int band_row; // first row of the map that this dispatch writes
shared float depths[2 * ITERATION_ROWS * (WORKGROUP_SIZE + 2 * RADIUS)];

void main() {
    int side = int(frame.shadow.w), lane = int(gl_LocalInvocationIndex);
    int buffer_offset = 0; // of the half of `depths` that this iteration uses
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * ivec2(WORKGROUP_SIZE, OUTPUT_ROWS) + ivec2(0, band_row);
    // @SUMS
    // The first 2 RADIUS rows complete only sums of rows above the strip. These sums are not stored.
    for (int first_row = 0; first_row < OUTPUT_ROWS + 2 * RADIUS; first_row += ITERATION_ROWS) {
        // @LOAD
        memoryBarrierShared();
        barrier();
        // @ADD
        buffer_offset = ITERATION_ROWS * (WORKGROUP_SIZE + 2 * RADIUS) - buffer_offset;
    }
}
