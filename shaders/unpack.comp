// What CUDA's rasteriser saw to ids, and the ground among them. Its keys come with rows from the top; images begin below.
//   keys  [height][width]  uvec2: triangle, bits of its depth; all ones where nothing is, top row first  (in)
//   ids   [height][width]  R32UI: NOTHING, GROUND, or triangle + 1                                       (out)
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(std430, binding = 0) readonly buffer Keys { uvec2 keys[]; };
layout(r32ui, binding = 0) uniform writeonly uimage2D seen;

#ifdef GROUND_SEEN
// Eight steps of a depth just below 1: what lies in the plane of the ground is seen. Twin: `Fixed::behind` in src/render/gl.rs.
const float BEHIND = 8.0 / 16777216.0;

// Depth of the ground at a place of the picture, drawn a little behind itself as OpenGL draws it; 2 where it is not seen.
// One over the way to it, in units of depth, is linear in the picture.
float ground_depth(vec2 image, vec2 texel) {
    float height = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    vec3 falls = -frame.up.xyz * mat3(frame.world_from_image) / height;
    float nearness = dot(falls, vec3(image, 1.0));
    vec3 direction = mat3(frame.world_from_image) * vec3(image, 1.0);
    if (!meets_ground(direction)) return 2.0;
    vec2 from = (frame.clip_from_world * vec4(frame.eye.xyz, 1.0)).zw;
    vec2 towards = (frame.clip_from_world * vec4(direction, 0.0)).zw;
    vec2 there = nearness * from + towards;
    float slope = 0.5 * abs(from.x / there.y) * max(abs(falls.x) * texel.x, abs(falls.y) * texel.y);
    return clamp(0.5 * there.x / there.y + 0.5 + slope + BEHIND, 0.0, 1.0);
}
#endif

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy), size = imageSize(seen);
    if (any(greaterThanEqual(at, size))) return;
    uvec2 key = keys[(size.y - 1 - at.y) * size.x + at.x];
    bool empty = key == uvec2(0xFFFFFFFFu);
    uint id = empty ? NOTHING : key.x + 1u;
#ifdef GROUND_SEEN
    vec2 texel = 2.0 / vec2(size);
    float depth = ground_depth((vec2(at) + 0.5) * texel - 1.0, texel);
    if (depth <= (empty ? 1.0 : uintBitsToFloat(key.y))) id = GROUND;
#endif
    imageStore(seen, at, uvec4(id, 0u, 0u, 0u));
}
