// Converts depth to the blurred moments: m = depth - 1/2, and m^2.
layout(binding = 0) uniform sampler2DArray source;
#ifdef DEPTH_IN_BUFFER
// Depth from the compute rasterizer, top row first.
layout(std430, binding = 0) readonly buffer RasterDepths { float raster_depths[]; };
#endif
#ifdef CASCADES
layout(location = 1) uniform int layer;
#else
const int layer = 0;
#endif

// m of the ground at a texel, which may lie outside the map.
float ground_moment(ivec2 at, int side) {
    vec2 place = (vec2(at) + 0.5) / float(side);
#ifdef CASCADES
    place = from_cascade(place, layer);
#endif
    return clamp(dot(frame.shadow_ground_plane.xy, place) + frame.shadow_ground_plane.z, 0.0, 1.0) - 0.5;
}

// m at a texel. Outside the map the texel at the edge is repeated: the rim of the map is empty, and shows the ground.
float centered_depth(ivec2 at, int side) {
    ivec2 held = clamp(at, ivec2(0), ivec2(side - 1));
#ifdef DEPTH_IN_BUFFER
    float depth = raster_depths[(side - 1 - held.y) * side + held.x];
#else
    float depth = texelFetch(source, ivec3(held, layer), 0).x;
#endif
    // Empty texels get the depth of the ground behind them. The ground casts no shadow, but with its own depth instead
    // of the far plane's, the bound is exact on the ground: the share of the blur weight that lies off the caster.
    return depth >= 1.0 ? ground_moment(at, side) : depth - 0.5;
}

vec2 load_moments(ivec2 at, int side) {
#ifdef FROM_DEPTH
    float m = centered_depth(at, side);
    return vec2(m, m * m);
#else
    ivec2 held = clamp(at, ivec2(0), ivec2(side - 1));
    vec2 sums = texelFetch(source, ivec3(held, 0), 0).xy;
    // A row outside the map is the last row, shifted by the depth difference of the ground.
    float deeper = ground_moment(at, side) - ground_moment(held, side);
    return sums + deeper * vec2(1.0, 2.0 * sums.x + deeper);
#endif
}
