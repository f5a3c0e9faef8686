// Linear light to sRGB bytes, opaque, top row first.
//   picture  [height][width]  RGBA16F, 0 to 1, bottom row first (in)
//   pixels   [height][width]  RGBA8 in one word                 (out)
layout(local_size_x = LANES) in;
layout(binding = 0) uniform sampler2D picture;
layout(std430, binding = 0) writeonly buffer Pixels { uint pixels[]; };

void main() {
    ivec2 size = textureSize(picture, 0);
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x) return;
    vec3 linear = texelFetch(picture, at, 0).rgb;
    vec3 curve = 1.055 * pow(max(linear, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055;
    vec3 encoded = mix(curve, 12.92 * linear, lessThanEqual(linear, vec3(0.0031308)));
    uint word = packUnorm4x8(vec4(encoded, 1.0));
    pixels[uint(size.y - 1 - at.y) * uint(size.x) + uint(at.x)] = word;
}
