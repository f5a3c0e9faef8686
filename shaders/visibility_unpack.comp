// Converts the visibility keys of the compute rasterizer to ids, and adds the ground.
//   keys     (in)   [height][width]  uvec2, top row first: triangle and bits of its depth; all ones without a triangle
//   ids_out  (out)  [height][width]  R32UI, bottom row first
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(std430, binding = 0) readonly buffer Keys { uvec2 keys[]; };
layout(r32ui, binding = 0) uniform writeonly uimage2D ids_out;

#ifdef HAS_GROUND
// Eight rounding steps of a depth just below 1, so that surfaces in the ground plane stay visible. Twin:
// `PipelineState::polygon_offset` in src/render/device/gl.rs.
const float GROUND_DEPTH_BIAS = 8.0 / 16777216.0;

// Depth of the ground at an image point with the polygon offset of OpenGL (factor 1, 8 units); 2 without ground.
float biased_ground_depth(vec2 ndc, vec2 pixel_size) {
    if (!ray_hits_ground(view_ray(ndc))) return 2.0;
    vec2 slope;
    float depth = 0.5 * ground_plane_depth(ndc, slope) + 0.5;
    vec2 depth_change = 0.5 * abs(slope) * pixel_size;
    return clamp(depth + max(depth_change.x, depth_change.y) + GROUND_DEPTH_BIAS, 0.0, 1.0);
}
#endif

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy), size = imageSize(ids_out);
    if (any(greaterThanEqual(pixel, size))) return;
    uvec2 key = keys[(size.y - 1 - pixel.y) * size.x + pixel.x];
    bool is_empty = key == uvec2(0xFFFFFFFFu);
    uint id = is_empty ? NO_ID : key.x + 1u;
#ifdef HAS_GROUND
    // `to_sun.w` is 0 if the ground lies behind all surfaces. Then the shading adds the ground, and this pass must not.
    vec2 pixel_size = 2.0 / vec2(size);
    float depth = frame.to_sun.w == 0.0 ? 2.0 : biased_ground_depth((vec2(pixel) + 0.5) * pixel_size - 1.0, pixel_size);
    if (depth <= (is_empty ? 1.0 : uintBitsToFloat(key.y))) id = GROUND_ID;
#endif
    imageStore(ids_out, pixel, uvec4(id, 0u, 0u, 0u));
}
