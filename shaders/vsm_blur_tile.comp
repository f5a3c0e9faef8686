// Both directions of the Gaussian blur (equation 3.11 of the thesis) in one pass: depth in, blurred moments out. A
// workgroup writes OUTPUT_COLUMNS x OUTPUT_ROWS texels. It loads their depths with a margin of RADIUS, a band of
// BAND_ROWS rows at a time, and blurs each row into shared memory. Then it blurs the columns of the result. An
// invocation computes a segment of TEXELS_PER_INVOCATION consecutive sums, so that it loads each input only once. The
// pitch of a row is odd, so that lanes that process different rows access different banks of shared memory. `BlurTile`
// in src/render/shaders/shadow.rs generates the shared arrays `depths` and `rows`, and the functions `blur_row` and
// `blur_column`.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(FORMAT, binding = 0) uniform writeonly image2D destination;
layout(location = 2) uniform int band_row; // first row of the map that this dispatch writes

void main() {
    int side = int(frame.shadow.w), lane = int(gl_LocalInvocationIndex);
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * ivec2(OUTPUT_COLUMNS, OUTPUT_ROWS) + ivec2(0, band_row);
    for (int first_row = 0; first_row < OUTPUT_ROWS + 2 * RADIUS; first_row += BAND_ROWS) {
        int depth_count = min(BAND_ROWS, OUTPUT_ROWS + 2 * RADIUS - first_row) * (OUTPUT_COLUMNS + 2 * RADIUS);
        for (int index = lane; index < depth_count; index += WORKGROUP_SIZE) {
            ivec2 band_texel = ivec2(index % (OUTPUT_COLUMNS + 2 * RADIUS), index / (OUTPUT_COLUMNS + 2 * RADIUS));
            ivec2 texel = corner + band_texel + ivec2(-RADIUS, first_row - RADIUS);
            depths[band_texel.y * DEPTH_PITCH + band_texel.x] = centered_depth(texel, side);
        }
        memoryBarrierShared();
        barrier();
        for (int segment = lane; segment < BAND_ROWS * (OUTPUT_COLUMNS / TEXELS_PER_INVOCATION); segment += WORKGROUP_SIZE) {
            int row = segment % BAND_ROWS, first_column = segment / BAND_ROWS * TEXELS_PER_INVOCATION;
            if (first_row + row < OUTPUT_ROWS + 2 * RADIUS) {
                vec2 sums[TEXELS_PER_INVOCATION];
                blur_row(row * DEPTH_PITCH + first_column + RADIUS, sums);
                int first_sum = (first_row + row) * ROW_PITCH + first_column;
                for (int index = 0; index < TEXELS_PER_INVOCATION; index++) rows[first_sum + index] = sums[index];
            }
        }
        memoryBarrierShared();
        barrier();
    }
    for (int segment = lane; segment < OUTPUT_COLUMNS * (OUTPUT_ROWS / TEXELS_PER_INVOCATION); segment += WORKGROUP_SIZE) {
        ivec2 texel = ivec2(segment % OUTPUT_COLUMNS, segment / OUTPUT_COLUMNS * TEXELS_PER_INVOCATION);
        vec2 sums[TEXELS_PER_INVOCATION];
        blur_column((texel.y + RADIUS) * ROW_PITCH + texel.x, sums);
        // Stores outside the map have no effect.
        for (int index = 0; index < TEXELS_PER_INVOCATION; index++) {
            imageStore(destination, corner + texel + ivec2(0, index), vec4(sums[index], 0.0, 0.0));
        }
    }
}
