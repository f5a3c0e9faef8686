// Upsamples by two, with weights 3/4 and 1/4 of the nearest two texels in each direction (Chaikin 1974; repeated, it
// converges to a quadratic B-spline), and adds the result to the next finer level. All levels have the same weight: the
// input is the mean of `coarser_levels` levels. The last step adds the glow to the shaded picture, from which the shading has
// removed the light that began to glow: displayed values are converted back to light and through the tone curve again.
//   from  [ceil height/2][ceil width/2]  RGBA16F (in)
//   to    [height][width]                RGBA16F (in and out)
layout(local_size_x = TILE, local_size_y = TILE) in;
#ifndef COMPOSITE
layout(location = 0) uniform int coarser_levels;
#endif
layout(binding = 0) uniform sampler2D source;
layout(rgba16f, binding = 0) uniform image2D destination;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    ivec2 last = textureSize(source, 0) - 1;
    if (any(greaterThanEqual(at, imageSize(destination)))) return;
    ivec2 here = at >> 1;
    ivec2 next = clamp(here + 2 * (at & 1) - 1, ivec2(0), last);
    vec3 glow = 0.5625 * texelFetch(source, here, 0).rgb + 0.0625 * texelFetch(source, next, 0).rgb;
    glow += 0.1875 * (texelFetch(source, ivec2(next.x, here.y), 0).rgb + texelFetch(source, ivec2(here.x, next.y), 0).rgb);
    vec3 own = imageLoad(destination, at).rgb;
#ifdef COMPOSITE
    own = tone_map(inverse_tone_map(own) + BLOOM_STRENGTH * glow);
#else
    own = (own + float(coarser_levels) * glow) / float(coarser_levels + 1);
#endif
    imageStore(destination, at, vec4(own, 1.0));
}
