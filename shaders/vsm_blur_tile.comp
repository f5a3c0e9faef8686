// Both directions of the Gaussian blur (equation 3.11) in one pass: depth in, blurred moments out. A workgroup writes
// WIDE x TALL texels. It reads their depths and a margin once, BAND rows at a time, blurs each row into shared memory,
// then blurs the columns of the result. An invocation computes RUN sums at once, so that it loads each number once for
// all of them. Rows have an odd pitch, so that lanes that walk down columns access different banks.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(FORMAT, binding = 0) uniform writeonly image2D destination;

void main() {
    int side = int(frame.shadow.w), lane = int(gl_LocalInvocationIndex);
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * ivec2(OUTPUT_COLUMNS, OUTPUT_ROWS);
    for (int first = 0; first < OUTPUT_ROWS + 2 * RADIUS; first += BAND_ROWS) {
        int cells = min(BAND_ROWS, OUTPUT_ROWS + 2 * RADIUS - first) * (OUTPUT_COLUMNS + 2 * RADIUS);
        for (int cell = lane; cell < cells; cell += WORKGROUP_SIZE) {
            ivec2 at = ivec2(cell % (OUTPUT_COLUMNS + 2 * RADIUS), cell / (OUTPUT_COLUMNS + 2 * RADIUS));
            depths[at.y * DEPTH_PITCH + at.x] = centered_depth(corner + at + ivec2(-RADIUS, first - RADIUS), side);
        }
        memoryBarrierShared();
        barrier();
        for (int run = lane; run < BAND_ROWS * (OUTPUT_COLUMNS / TEXELS_PER_INVOCATION); run += WORKGROUP_SIZE) {
            int row = run % BAND_ROWS, left = run / BAND_ROWS * TEXELS_PER_INVOCATION;
            if (first + row < OUTPUT_ROWS + 2 * RADIUS) {
                vec2 sums[TEXELS_PER_INVOCATION];
                blur_row(row * DEPTH_PITCH + left + RADIUS, sums);
                for (int index = 0; index < TEXELS_PER_INVOCATION; index++) rows[(first + row) * ROW_PITCH + left + index] = sums[index];
            }
        }
        memoryBarrierShared();
        barrier();
    }
    for (int run = lane; run < OUTPUT_COLUMNS * (OUTPUT_ROWS / TEXELS_PER_INVOCATION); run += WORKGROUP_SIZE) {
        ivec2 at = ivec2(run % OUTPUT_COLUMNS, run / OUTPUT_COLUMNS * TEXELS_PER_INVOCATION);
        vec2 sums[TEXELS_PER_INVOCATION];
        blur_column((at.y + RADIUS) * ROW_PITCH + at.x, sums);
        // Stores outside the map have no effect.
        for (int index = 0; index < TEXELS_PER_INVOCATION; index++) {
            imageStore(destination, corner + at + ivec2(0, index), vec4(sums[index], 0.0, 0.0));
        }
    }
}
