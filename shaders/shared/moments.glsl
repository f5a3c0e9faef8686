// Depth to what is blurred: m = depth - 1/2 and m m.
layout(binding = 0) uniform sampler2DArray from;
#ifdef SPLITS
layout(location = 1) uniform int layer;
#else
const int layer = 0;
#endif

// m at a texel; those beyond the edge repeat it.
float centred(ivec2 at, int side) {
    at = clamp(at, ivec2(0), ivec2(side - 1));
    float depth = texelFetch(from, ivec3(at, layer), 0).x;
    if (depth >= 1.0) {
        // Nothing is there but the ground behind it. The ground casts no shadow, but with its own depth in place of the
        // far plane's the bound is exact on it: the share of the blur's weight that lies off the caster.
        vec2 place = (vec2(at) + 0.5) / float(side);
#ifdef SPLITS
        place = in_whole(place, layer);
#endif
        depth = clamp(dot(frame.ground_depth.xy, place) + frame.ground_depth.z, 0.0, 1.0);
    }
    return depth - 0.5;
}

vec2 moments(ivec2 at, int side) {
#ifdef FIRST
    float m = centred(at, side);
    return vec2(m, m * m);
#else
    return texelFetch(from, ivec3(clamp(at, ivec2(0), ivec2(side - 1)), 0), 0).xy;
#endif
}
