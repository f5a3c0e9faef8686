// Converts the visibility keys of the compute rasterizer to ids, and adds the ground. Keys are stored top row first,
// images bottom row first.
//   keys  [height][width]  uvec2: triangle, bits of its depth; all ones without a triangle, top row first  (in)
//   ids   [height][width]  R32UI: NOTHING, GROUND, or triangle + 1                                         (out)
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(std430, binding = 0) readonly buffer Keys { uvec2 keys[]; };
layout(r32ui, binding = 0) uniform writeonly uimage2D ids_out;

#ifdef HAS_GROUND
// Eight rounding steps of a depth just below 1: surfaces in the ground plane stay visible. Twin: `PipelineState::polygon_offset` in
// src/render/gl.rs.
const float GROUND_DEPTH_BIAS = 8.0 / 16777216.0;

// Depth of the ground at an image point, with the same offset as in OpenGL; 2 where the ground is not visible.
float biased_ground_depth(vec2 image, vec2 texel) {
    if (!ray_hits_ground(view_ray(image))) return 2.0;
    vec2 slope;
    float depth = 0.5 * ground_plane_depth(image, slope) + 0.5;
    vec2 changes = 0.5 * abs(slope) * texel;
    return clamp(depth + max(changes.x, changes.y) + GROUND_DEPTH_BIAS, 0.0, 1.0);
}
#endif

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy), size = imageSize(ids_out);
    if (any(greaterThanEqual(at, size))) return;
    uvec2 key = keys[(size.y - 1 - at.y) * size.x + at.x];
    bool empty = key == uvec2(0xFFFFFFFFu);
    uint id = empty ? NO_ID : key.x + 1u;
#ifdef HAS_GROUND
    // The shading finds ground that hides nothing.
    vec2 texel = 2.0 / vec2(size);
    float depth = frame.to_sun.w == 0.0 ? 2.0 : biased_ground_depth((vec2(at) + 0.5) * texel - 1.0, texel);
    if (depth <= (empty ? 1.0 : uintBitsToFloat(key.y))) id = GROUND_ID;
#endif
    imageStore(ids_out, at, uvec4(id, 0u, 0u, 0u));
}
