// Both directions of the Gaussian blur (equation 3.11) in one pass: depth in, blurred moments out. A workgroup writes
// WIDE x TALL texels. It reads their depths and a margin once, BAND rows at a time, blurs each row into shared memory,
// then blurs the columns of the result. An invocation computes RUN sums at once, so that it loads each number once for
// all of them. Rows have an odd pitch, so that lanes that walk down columns access different banks.
layout(local_size_x = LANES) in;
layout(FORMAT, binding = 0) uniform writeonly image2D to;

void main() {
    int side = int(frame.shadow.w), lane = int(gl_LocalInvocationIndex);
    ivec2 corner = ivec2(gl_WorkGroupID.xy) * ivec2(WIDE, TALL);
    for (int first = 0; first < TALL + 2 * REACH; first += BAND) {
        int cells = min(BAND, TALL + 2 * REACH - first) * (WIDE + 2 * REACH);
        for (int cell = lane; cell < cells; cell += LANES) {
            ivec2 at = ivec2(cell % (WIDE + 2 * REACH), cell / (WIDE + 2 * REACH));
            depths[at.y * DEPTH_PITCH + at.x] = centred(corner + at + ivec2(-REACH, first - REACH), side);
        }
        memoryBarrierShared();
        barrier();
        for (int run = lane; run < BAND * (WIDE / RUN); run += LANES) {
            int row = run % BAND, left = run / BAND * RUN;
            if (first + row < TALL + 2 * REACH) {
                vec2 sums[RUN];
                across(row * DEPTH_PITCH + left + REACH, sums);
                for (int index = 0; index < RUN; index++) rows[(first + row) * PITCH + left + index] = sums[index];
            }
        }
        memoryBarrierShared();
        barrier();
    }
    for (int run = lane; run < WIDE * (TALL / RUN); run += LANES) {
        ivec2 at = ivec2(run % WIDE, run / WIDE * RUN);
        vec2 sums[RUN];
        down((at.y + REACH) * PITCH + at.x, sums);
        // Stores outside the map have no effect.
        for (int index = 0; index < RUN; index++) {
            imageStore(to, corner + at + ivec2(0, index), vec4(sums[index], 0.0, 0.0));
        }
    }
}
