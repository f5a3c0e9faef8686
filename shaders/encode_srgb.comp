// Converts linear light to sRGB bytes, opaque, top row first; with FXAA after anti-aliasing, with DITHER dithered.
//   picture  [height][width]  RGBA16F, 0 to 1, bottom row first (in)
//   pixels   [height][width]  RGBA8 in one word                 (out)
layout(local_size_x = WORKGROUP_SIZE) in;
layout(std430, binding = 0) writeonly buffer Pixels { uint pixels[]; };

#ifdef DITHER
// Ordered dithering threshold of a pixel, in output levels: -63/128 to 63/128 in steps of 1/64, each once in every 8 x
// 8 pixels (Bayer 1973). Its bits alternate between y and x ^ y, lowest bits first. The mean over a square preserves
// what rounding would lose, and a value exactly on a level is not changed.
float bayer_threshold(ivec2 at) {
    uint x = uint(at.x ^ at.y), y = uint(at.y);
    uint place = (x & 1u) << 5 | (y & 1u) << 4 | (x & 2u) << 2 | (y & 2u) << 1 | (x & 4u) >> 1 | (y & 4u) >> 2;
    return (float(place) - 31.5) / 64.0;
}
#endif

void main() {
    ivec2 size = textureSize(scene_color, 0);
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x) return;
#ifdef FXAA
    vec3 linear = fxaa_color(at);
#else
    vec3 linear = texelFetch(scene_color, at, 0).rgb;
#endif
    vec3 curve = 1.055 * pow(max(linear, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055;
    vec3 encoded = mix(curve, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
#ifdef DITHER
    encoded += bayer_threshold(at) / 255.0;
#endif
    uint word = packUnorm4x8(vec4(encoded, 1.0));
    pixels[uint(size.y - 1 - at.y) * uint(size.x) + uint(at.x)] = word;
}
