// Converts the visibility keys of the compute rasterizer to ids.
//   keys     (in)   [height][width]  uvec2, top row first: triangle, inverted bits of its depth; all ones if empty
//   ids_out  (out)  [height][width]  R32UI, bottom row first
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(std430, binding = 0) readonly buffer Keys { uvec2 keys[]; };
layout(r32ui, binding = 0) uniform writeonly uimage2D ids_out;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy), size = imageSize(ids_out);
    if (any(greaterThanEqual(pixel, size))) return;
    uvec2 key = keys[(size.y - 1 - pixel.y) * size.x + pixel.x];
    bool is_empty = key == uvec2(0xFFFFFFFFu);
    uint id = is_empty ? NO_ID : key.x + 1u;
    imageStore(ids_out, pixel, uvec4(id, 0u, 0u, 0u));
}
