// Id of a sample in the visibility image: NO_ID, or the index of a triangle in the draw order plus 1. The shading
// replaces NO_ID by GROUND_ID where a view ray hits the ground. Twin: `VisibilityId` in src/render/types.rs.
const uint NO_ID = 0u;
const uint GROUND_ID = 0xFFFFFFFFu;

#ifdef SAMPLES
#if SAMPLES > 1
layout(binding = 21) uniform usampler2DMS ids;
ivec2 id_image_size() { return textureSize(ids); }
// Depth of the same samples. An id is valid only if its depth is above 0. Multisampled ids are not cleared, because
// clearing four samples per pixel takes 0.59 ms at 1920 x 1080 on an H200, as long as clearing their depth.
layout(binding = 26) uniform sampler2DMS visibility_depth;
uint load_id(ivec2 pixel, int sample_index) {
    bool is_valid = texelFetch(visibility_depth, pixel, sample_index).x > 0.0;
    return is_valid ? texelFetch(ids, pixel, sample_index).x : NO_ID;
}
#else
layout(binding = 21) uniform usampler2D ids;
ivec2 id_image_size() { return textureSize(ids, 0); }
uint load_id(ivec2 pixel, int sample_index) { return texelFetch(ids, pixel, 0).x; }
#endif
#endif
