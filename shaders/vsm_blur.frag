// One direction of the Gaussian blur (equation 3.11 of the thesis) with one fragment per texel, as in the thesis: the
// baseline of measurements. The first pass (FROM_DEPTH) reads depth and blurs along x. The second pass reads the moments
// of the first and blurs along y. `blur_separable` in src/render/shaders/shadow.rs generates the function `blur`.
layout(location = 0) out vec4 blurred;

void main() {
    vec2 sums[TEXELS_PER_INVOCATION];
#ifdef FROM_DEPTH
    blur(ivec2(gl_FragCoord.xy), ivec2(1, 0), int(frame.shadow.w), sums);
#else
    blur(ivec2(gl_FragCoord.xy), ivec2(0, 1), int(frame.shadow.w), sums);
#endif
    blurred = vec4(sums[0], 0.0, 0.0);
}
