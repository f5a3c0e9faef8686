// One direction of the Gaussian blur (equation 3.11 of the thesis) for software rasterizers, where texture reads are
// cheaper than shared memory. The first direction (FROM_DEPTH) reads depth, the second reads the moments that the first
// wrote. An invocation writes TEXELS_PER_INVOCATION consecutive texels along its direction, so that it reads each input
// only once. `blur_separable` in src/render/shaders/shadow.rs generates the function `blur`.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(FORMAT, binding = 0) uniform writeonly image2D destination;
layout(location = 2) uniform int band_row; // first row of the map that this dispatch writes

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    int side = int(frame.shadow.w);
#ifdef FROM_DEPTH
    const ivec2 direction = ivec2(1, 0);
#else
    const ivec2 direction = ivec2(0, 1);
#endif
    // First texel of this invocation: multiplies its index along the direction by TEXELS_PER_INVOCATION.
    texel += (TEXELS_PER_INVOCATION - 1) * texel * direction;
    texel.y += band_row;
    if (texel.x >= side) return;
    vec2 sums[TEXELS_PER_INVOCATION];
    blur(texel, direction, side, sums);
    // Stores outside the map have no effect.
    for (int index = 0; index < TEXELS_PER_INVOCATION; index++) {
        imageStore(destination, texel + index * direction, vec4(sums[index], 0.0, 0.0));
    }
}
