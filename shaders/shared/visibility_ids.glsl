// Id of a sample in the visibility image: nothing, the ground, or a triangle's index in the draw order plus 1. Twin:
// `VisibilityId` in src/render/visibility_id.rs.
const uint NO_ID = 0u;
const uint GROUND_ID = 0xFFFFFFFFu;

#ifdef SAMPLES
#if SAMPLES > 1
layout(binding = 21) uniform usampler2DMS ids;
ivec2 id_image_size() { return textureSize(ids); }
// Depth of the same samples. An id is valid where something was drawn, that is, nearer than the far plane. The ids are
// not cleared: clearing those of four samples would take as long as clearing their depth, 0.59 ms at 1920 x 1080 on an
// H200.
layout(binding = 26) uniform sampler2DMS visibility_depth;
uint load_id(ivec2 at, int index) { return texelFetch(visibility_depth, at, index).x < 1.0 ? texelFetch(ids, at, index).x : NO_ID; }
#else
layout(binding = 21) uniform usampler2D ids;
ivec2 id_image_size() { return textureSize(ids, 0); }
uint load_id(ivec2 at, int index) { return texelFetch(ids, at, 0).x; }
#endif
#endif
