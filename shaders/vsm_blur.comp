// One direction of the Gaussian blur (equation 3.11) for software rasterizers, where texture reads are cheaper than
// shared memory. The first direction reads depth, the second the moments that the first wrote. An invocation writes RUN
// consecutive texels along its direction, so that it reads each texel once for all of them.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(FORMAT, binding = 0) uniform writeonly image2D destination;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    int side = int(frame.shadow.w);
#ifdef FROM_DEPTH
    const ivec2 along = ivec2(1, 0);
#else
    const ivec2 along = ivec2(0, 1);
#endif
    at += (TEXELS_PER_INVOCATION - 1) * at * along;
    if (at.x >= side) return;
    vec2 sums[TEXELS_PER_INVOCATION];
    blur(at, along, side, sums);
    // Stores outside the map have no effect.
    for (int index = 0; index < TEXELS_PER_INVOCATION; index++) {
        imageStore(destination, at + index * along, vec4(sums[index], 0.0, 0.0));
    }
}
