// Converts depth to the blurred moments: m = depth - 1/2, and m^2.
layout(binding = 0) uniform sampler2DArray from;
#ifdef OF_BUFFER
// Depth from the compute rasterizer, top row first.
layout(std430, binding = 0) readonly buffer Depths { float depths_held[]; };
#endif
#ifdef SPLITS
layout(location = 1) uniform int layer;
#else
const int layer = 0;
#endif

// m of the ground at a texel, which may lie outside the map.
float ground(ivec2 at, int side) {
    vec2 place = (vec2(at) + 0.5) / float(side);
#ifdef SPLITS
    place = in_whole(place, layer);
#endif
    return clamp(dot(frame.ground_depth.xy, place) + frame.ground_depth.z, 0.0, 1.0) - 0.5;
}

// m at a texel. Outside the map the texel at the edge is repeated: the rim of the map is empty, and shows the ground.
float centred(ivec2 at, int side) {
    ivec2 held = clamp(at, ivec2(0), ivec2(side - 1));
#ifdef OF_BUFFER
    float depth = depths_held[(side - 1 - held.y) * side + held.x];
#else
    float depth = texelFetch(from, ivec3(held, layer), 0).x;
#endif
    // Empty texels get the depth of the ground behind them. The ground casts no shadow, but with its own depth instead
    // of the far plane's, the bound is exact on the ground: the share of the blur weight that lies off the caster.
    return depth >= 1.0 ? ground(at, side) : depth - 0.5;
}

vec2 moments(ivec2 at, int side) {
#ifdef FIRST
    float m = centred(at, side);
    return vec2(m, m * m);
#else
    ivec2 held = clamp(at, ivec2(0), ivec2(side - 1));
    vec2 sums = texelFetch(from, ivec3(held, 0), 0).xy;
    // A row outside the map is the last row, shifted by the depth difference of the ground.
    float deeper = ground(at, side) - ground(held, side);
    return sums + deeper * vec2(1.0, 2.0 * sums.x + deeper);
#endif
}
