// Upsamples by two and adds the result to the next finer level. The nearest two texels in each direction have the
// weights 3/4 and 1/4 (Chaikin 1974); repeated, this converges to a quadratic B-spline. All levels have the same
// weight: `source` is the mean of `coarser_levels` levels, and `destination` becomes the mean of one more level. With
// COMPOSITE, `destination` is the shaded image, from which shade.comp has subtracted the bloom light. This shader
// inverts the tone curve, adds the blurred bloom light, and applies the tone curve again.
//   source       (in)         [ceil height/2][ceil width/2]  RGBA16F
//   destination  (in, out)    [height][width]                RGBA16F
layout(local_size_x = TILE, local_size_y = TILE) in;
#ifndef COMPOSITE
layout(location = 0) uniform int coarser_levels;
#endif
layout(binding = 0) uniform sampler2D source;
layout(rgba16f, binding = 0) uniform image2D destination;

void main() {
    ivec2 destination_texel = image_pixel();
    ivec2 max_texel = textureSize(source, 0) - 1;
    if (any(greaterThanEqual(destination_texel, imageSize(destination)))) return;
    ivec2 near_texel = destination_texel >> 1;
    ivec2 far_texel = clamp(near_texel + 2 * (destination_texel & 1) - 1, ivec2(0), max_texel);
    // Products of the weights in x and y: 9/16 near in both, 1/16 far in both, 3/16 for each of the two mixed texels.
    vec3 glow = 0.5625 * texelFetch(source, near_texel, 0).rgb + 0.0625 * texelFetch(source, far_texel, 0).rgb;
    glow += 0.1875 * (texelFetch(source, ivec2(far_texel.x, near_texel.y), 0).rgb
        + texelFetch(source, ivec2(near_texel.x, far_texel.y), 0).rgb);
    vec3 color = imageLoad(destination, destination_texel).rgb;
#ifdef COMPOSITE
    color = tone_map(inverse_tone_map(color) + BLOOM_STRENGTH * glow);
#else
    color = (color + float(coarser_levels) * glow) / float(coarser_levels + 1);
#endif
    imageStore(destination, destination_texel, vec4(color, 1.0));
}
