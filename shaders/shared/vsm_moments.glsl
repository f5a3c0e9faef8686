// Inputs of the variance shadow map's blur: the moments m and m^2, with m = depth - 1/2. Images and buffers store the
// reversed depth 1 - depth.
layout(binding = 0) uniform sampler2DArray source; // with FROM_DEPTH: depth; else: horizontally blurred moments
#ifdef DEPTH_IN_BUFFER
// Depth from the compute rasterizer, top row first.
layout(std430, binding = 0) readonly buffer RasterDepths { float raster_depths[]; };
#ifdef PCF_FALLBACK
// Copy of the depth, bottom row first, for lookups that filter it.
layout(r32f, binding = 1) uniform writeonly image2D depth_copy;
#endif
#endif
#ifdef CASCADES
layout(location = 1) uniform int layer;
#else
const int layer = 0;
#endif

// m of the ground at a texel, which may lie outside the map.
float ground_moment(ivec2 texel, int side) {
    vec2 position = (vec2(texel) + 0.5) / float(side);
#ifdef CASCADES
    position = from_cascade(position, layer);
#endif
    return clamp(dot(frame.shadow_ground_plane.xy, position) + frame.shadow_ground_plane.z, 0.0, 1.0) - 0.5;
}

// m at a texel. A texel outside the map has the depth of the nearest texel of the map. No caster is drawn at the border
// of the map, so that texel is empty, and the result is the ground's m.
float centered_depth(ivec2 texel, int side) {
    ivec2 inside_texel = clamp(texel, ivec2(0), ivec2(side - 1));
#ifdef DEPTH_IN_BUFFER
    float reversed_depth = raster_depths[(side - 1 - inside_texel.y) * side + inside_texel.x];
#ifdef PCF_FALLBACK
    // Workgroups with overlapping margins store equal values.
    imageStore(depth_copy, inside_texel, vec4(reversed_depth));
#endif
#else
    float reversed_depth = texelFetch(source, ivec3(inside_texel, layer), 0).x;
#endif
    // An empty texel gets the depth of the ground instead of the far plane, although the ground casts no shadow. Then
    // Chebyshev's bound is exact on the ground: it equals the sum of the blur weights of the empty texels.
    return reversed_depth <= 0.0 ? ground_moment(texel, side) : 0.5 - reversed_depth;
}

vec2 load_moments(ivec2 texel, int side) {
#ifdef FROM_DEPTH
    float m = centered_depth(texel, side);
    return vec2(m, m * m);
#else
    ivec2 inside_texel = clamp(texel, ivec2(0), ivec2(side - 1));
    vec2 sums = texelFetch(source, ivec3(inside_texel, 0), 0).xy;
    // A row outside the map has the moments of the nearest row, shifted by the depth difference d of the ground between
    // the two rows: m + d, and (m + d)^2 = m^2 + d (2 m + d).
    float depth_change = ground_moment(texel, side) - ground_moment(inside_texel, side);
    return sums + depth_change * vec2(1.0, 2.0 * sums.x + depth_change);
#endif
}
