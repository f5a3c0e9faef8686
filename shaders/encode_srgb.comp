// Encodes the image to opaque sRGB bytes. FXAA and DITHER enable anti-aliasing and dithering.
//   scene_color  (in)   [height][width]  RGBA16F, linear, 0 to 1, bottom row first
//   pixels       (out)  [height][width]  RGBA8 in one word, top row first
layout(local_size_x = WORKGROUP_SIZE) in;
layout(std430, binding = 0) writeonly buffer Pixels { uint pixels[]; };

#ifdef DITHER
// Threshold of ordered dithering for a pixel, in output levels (Bayer 1973). Each of -63/128 to 63/128 in steps of 1/64
// occurs once in every 8 x 8 pixels. `rank`, 0 to 63, interleaves the lower three bits of x ^ y and y: bit 0 of both
// becomes the highest two bits of `rank`, bit 1 the next two, and bit 2 the lowest two. The mean over 8 x 8 pixels is
// exact to 1/64 level, and a value exactly on a level does not change.
float bayer_threshold(ivec2 pixel) {
    uint x = uint(pixel.x ^ pixel.y), y = uint(pixel.y);
    uint rank = (x & 1u) << 5 | (y & 1u) << 4 | (x & 2u) << 2 | (y & 2u) << 1 | (x & 4u) >> 1 | (y & 4u) >> 2;
    return (float(rank) - 31.5) / 64.0;
}
#endif

void main() {
    ivec2 size = textureSize(scene_color, 0);
    ivec2 pixel = image_pixel();
    if (pixel.x >= size.x) return;
#ifdef FXAA
    vec3 linear = fxaa_color(pixel);
#else
    vec3 linear = texelFetch(scene_color, pixel, 0).rgb;
#endif
    // sRGB transfer function (IEC 61966-2-1).
    vec3 curve = 1.055 * pow(max(linear, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055;
    vec3 encoded = mix(curve, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
#ifdef DITHER
    encoded += bayer_threshold(pixel) / 255.0;
#endif
    uint word = packUnorm4x8(vec4(encoded, 1.0));
    pixels[uint(size.y - 1 - pixel.y) * uint(size.x) + uint(pixel.x)] = word;
}
