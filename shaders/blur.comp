// One direction of the Gaussian blur (equation 3.11) for software rasterizers, where texture reads are cheaper than
// shared memory. The first direction reads depth, the second the moments that the first wrote. An invocation writes RUN
// consecutive texels along its direction, so that it reads each texel once for all of them.
layout(local_size_x = LANES) in;
layout(FORMAT, binding = 0) uniform writeonly image2D to;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    int side = int(frame.shadow.w);
#ifdef FIRST
    const ivec2 along = ivec2(1, 0);
#else
    const ivec2 along = ivec2(0, 1);
#endif
    at += (RUN - 1) * at * along;
    if (at.x >= side) return;
    vec2 sums[RUN];
    blur(at, along, side, sums);
    // Stores outside the map have no effect.
    for (int index = 0; index < RUN; index++) {
        imageStore(to, at + index * along, vec4(sums[index], 0.0, 0.0));
    }
}
