// What a sample of the visibility image holds: nothing, the ground, or a triangle's place in the index buffer plus one.
// Twin: `Seen` in src/render/seen.rs.
const uint NOTHING = 0u;
const uint GROUND = 0xFFFFFFFFu;

#ifdef SAMPLES
#if SAMPLES > 1
layout(binding = 21) uniform usampler2DMS ids;
ivec2 size_of_ids() { return textureSize(ids); }
#else
layout(binding = 21) uniform usampler2D ids;
ivec2 size_of_ids() { return textureSize(ids, 0); }
#endif
#endif
