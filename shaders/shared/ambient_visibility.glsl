// Lookup of the ambient visibility: the fraction of the ambient light that reaches a point.
layout(binding = 28) uniform sampler2D ambient_visibility;  // see ambient_filter.comp

// Visibility at a point with this unit normal of its face: interpolated between the four nearest texels of its plane. If
// texels are larger than pixels, the nearest texel is enough, unless it belongs to another surface.
float ambient_visibility_of(vec3 world, vec3 normal, vec2 ndc) {
    vec2 position = (0.5 * ndc + 0.5) * ambient_extent() - AMBIENT_CENTER;
    vec2 last = vec2(textureSize(ambient_visibility, 0) - 1);
    AmbientPlane plane = ambient_plane(ambient_rays(), normal, world - frame.eye.xyz, to_clip(world).w);
#if AMBIENT_SCALE > 1
    vec2 nearest = clamp(round(position), vec2(0.0), last);
    vec2 nearest_tap = texelFetch(ambient_visibility, ivec2(nearest), 0).xy;
    if (ambient_weight(plane, nearest, nearest_tap.y) > 0.5) return nearest_tap.x;
#endif
    vec2 base = floor(position), fraction = position - base;
    float sum = 0.0, weight_sum = 0.0;
    for (int y = 0; y < 2; y++) {
        for (int x = 0; x < 2; x++) {
            vec2 texel = clamp(base + vec2(x, y), vec2(0.0), last);
            vec2 tap = texelFetch(ambient_visibility, ivec2(texel), 0).xy;
            float weight = ambient_weight(plane, texel, tap.y);
            weight *= (x == 0 ? 1.0 - fraction.x : fraction.x) * (y == 0 ? 1.0 - fraction.y : fraction.y) + 1e-3;
            sum += weight * tap.x;
            weight_sum += weight;
        }
    }
    return sum / weight_sum;
}
