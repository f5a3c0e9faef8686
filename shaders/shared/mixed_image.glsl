// Lookup in an image of a mixed texture array: its images have several sizes and may be smaller than its layers. An
// image and its mipmap levels begin at the first texel of the layer and of its levels. Repeats at the edges of the
// image as GL_REPEAT does at those of a layer.
//   image_anisotropy    largest number of lookups along the longer axis of a pixel's footprint
//   IMAGE_LEVEL_BLEND   defined if two mipmap levels are blended
vec4 bilinear_image_texel(sampler2DArray images, int layer, ivec2 size, vec2 uv, int level) {
    ivec2 level_size = max(size >> level, ivec2(1));
    vec2 position = fract(uv) * vec2(level_size) - 0.5;
    vec2 weight = fract(position);
    // The clamp affects only texture coordinates that are not finite.
    ivec2 low = clamp(ivec2(floor(position)), ivec2(-1), level_size - 1);
    ivec2 high = low + 1;
    low += level_size * ivec2(lessThan(low, ivec2(0)));
    high -= level_size * ivec2(greaterThanEqual(high, level_size));
    vec4 top = mix(texelFetch(images, ivec3(low, layer), level), texelFetch(images, ivec3(high.x, low.y, layer), level), weight.x);
    vec4 bottom = mix(texelFetch(images, ivec3(low.x, high.y, layer), level), texelFetch(images, ivec3(high, layer), level), weight.x);
    return mix(top, bottom, weight.y);
}

// location.x: bits 0 to 2 are the index of the texture array, the others width - 1. location.y: bits 0 to 10 are the
// layer, the others height - 1. dx, dy: derivatives of uv.
vec4 mixed_image_texel(sampler2DArray images, ivec2 location, vec2 uv, vec2 dx, vec2 dy) {
    int layer = location.y & 2047;
    ivec2 size = ivec2(location.x >> 3, location.y >> 11) + 1;
    float length_x = length(dx * vec2(size)), length_y = length(dy * vec2(size));
    float longer = max(length_x, length_y), shorter = min(length_x, length_y);
    // Comparisons with NaN are false, so that derivatives that are not finite give one lookup at level 0.
    float lookups = longer > shorter ? clamp(ceil(longer / max(shorter, 1e-20)), 1.0, image_anisotropy) : 1.0;
    float last_level = float(findMSB(max(size.x, size.y)));
    float level = longer > lookups ? min(log2(longer / lookups), last_level) : 0.0;
    vec2 axis = length_x > length_y ? dx : dy;
    vec4 sum = vec4(0.0);
    for (float index = 0.5; index < lookups; index += 1.0) {
        vec2 lookup_uv = uv + axis * (index / lookups - 0.5);
#ifdef IMAGE_LEVEL_BLEND
        int finer = int(level);
        vec4 texel = bilinear_image_texel(images, layer, size, lookup_uv, finer);
        float coarser_weight = level - float(finer);
        if (coarser_weight > 0.0) {
            texel = mix(texel, bilinear_image_texel(images, layer, size, lookup_uv, finer + 1), coarser_weight);
        }
        sum += texel;
#else
        sum += bilinear_image_texel(images, layer, size, lookup_uv, int(level + 0.5));
#endif
    }
    return sum / lookups;
}
