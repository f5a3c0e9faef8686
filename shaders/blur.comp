// One direction of the Gaussian blur (equation 3.11) for rasterisers in software, where reading a texture is cheaper
// than shared memory. The first direction reads depth, the second the moments that the first wrote. One invocation
// makes RUN texels in a row along its direction, so that a texel is read once for all of them.
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
    // Stores beyond the edge of the map are dropped.
    for (int index = 0; index < RUN; index++) {
        imageStore(to, at + index * along, vec4(sums[index], 0.0, 0.0));
    }
}
