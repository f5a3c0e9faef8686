// Linear samples to sRGB bytes, opaque, top row first: averages the samples of each pixel, encodes, packs.
//   picture   [height][width][SAMPLES]  RGBA16F, bottom row first (in)
//   pixels    [height][width]           RGBA8 in one word         (out)
layout(local_size_x = LANES) in;
#if SAMPLES > 1
layout(binding = 0) uniform sampler2DMS picture;
#else
layout(binding = 0) uniform sampler2D picture;
#endif
layout(std430, binding = 0) writeonly buffer Pixels { uint pixels[]; };

void main() {
#if SAMPLES > 1
    ivec2 size = textureSize(picture);
#else
    ivec2 size = textureSize(picture, 0);
#endif
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x) return;
    vec3 sum = vec3(0.0);
    for (int part = 0; part < SAMPLES; part++) {
        vec3 light = texelFetch(picture, at, part).rgb;
        // Clamped one by one, so that one bright sample does not whiten an edge; a NaN fails the comparison and is black.
        sum += mix(vec3(0.0), min(light, vec3(1.0)), greaterThan(light, vec3(0.0)));
    }
    vec3 linear = sum / float(SAMPLES);
    vec3 curve = 1.055 * pow(max(linear, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055;
    vec3 encoded = mix(curve, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
    uint word = packUnorm4x8(vec4(encoded, 1.0));
    pixels[uint(size.y - 1 - at.y) * uint(size.x) + uint(at.x)] = word;
}
