// `sun_visibility`: share of the sun's light that reaches a surface point, 0 to 1, for all shadow methods. It uses no derivatives,
// so that fragment and compute shaders can call it. NaN inputs give a finite result.
#ifdef SHADOWS
layout(binding = 0) uniform sampler2DArray shadow_map;

#ifdef CASCADES
vec2 cascade_scale(int layer) { return cascades.scale_offsets[layer].xy; }
#else
vec2 cascade_scale(int layer) { return vec2(1.0); }
#endif

// Slope of the surface plane in the map: change of its depth per texel in x and in y.
vec2 receiver_plane_gradient(vec3 normal, int layer) {
    // The rows of the map's matrix are the scaled axes of light space; the third points away from the sun.
    mat3 axes = transpose(mat3(frame.shadow_from_world));
    vec3 part = vec3(dot(normal, axes[0]), dot(normal, axes[1]), dot(normal, axes[2]));
    vec3 square = vec3(dot(axes[0], axes[0]), dot(axes[1], axes[1]), dot(axes[2], axes[2]));
    // Slopes steeper than ten to one are clamped: the sun only grazes there.
    float facing = max(abs(part.z), 0.1 * sqrt(square.z)) * (part.z < 0.0 ? -1.0 : 1.0);
    return -(part.xy / square.xy) * (square.z / facing) / (frame.shadow.w * cascade_scale(layer));
}

#ifdef SHADOW_VARIANCE
// Bias that compensates for ground depth leaking into the blurred mean near a contact line, which would pull the mean
// towards the sun. The ground casts no shadow, so the bias is subtracted. With h the height above the line in standard
// deviations, and k the depth difference of surface and ground per standard deviation, the ground shifts the mean by k
// (phi(h) - h Q(h)); 0.4 k (1 - h / 2)^2 is an upper bound up to h = 1.9.
float contact_bias(vec3 at, int layer, vec3 normal) {
    vec2 whole = at.xy;
#ifdef CASCADES
    whole = from_cascade(whole, layer);
#endif
    float above = max(dot(frame.shadow_ground_plane.xy, whole) + frame.shadow_ground_plane.z - at.z, 0.0);
    float gradient_difference = DEVIATION * length(receiver_plane_gradient(normal, layer) - receiver_plane_gradient(frame.up.xyz, layer));
    float near = 1.0 - 0.5 * above / max(gradient_difference, 1e-12);
    return near > 0.0 ? 0.4 * gradient_difference * near * near : 0.0;
}

// Chebyshev's bound on the blurred moments of depth (equation 3.10 with the variance M2 - M1 M1). Depth is measured
// from the center of its range, where floats are finest.
float shadow_visibility(vec3 at, int layer, vec3 normal) {
    vec2 moments = textureLod(shadow_map, vec3(at.xy, float(layer)), 0.0).xy;
    float behind = clamp(at.z, 0.0, 1.0) - 0.5 - moments.x - contact_bias(at, layer, normal);
    if (!(behind > 0.0)) return 1.0;
    float variance = max(moments.y - moments.x * moments.x, frame.shadow.x);
    float bound = variance / (variance + behind * behind);
    return clamp((bound - frame.shadow.y) / (1.0 - frame.shadow.y), 0.0, 1.0);
}
#else
// Bias of the comparison. Texels are compared with the plane of the surface instead of the point's own depth, so that a
// slope does not shadow itself; a caster counts from one texel side in front of that plane. The bias covers curved
// surfaces, whose triangles deviate from their normals, and the rounding of depth.
float depth_bias(int layer) {
    vec3 light_depth_gradient = vec3(frame.shadow_from_world[0].z, frame.shadow_from_world[1].z, frame.shadow_from_world[2].z);
    vec2 scale = cascade_scale(layer);
    return frame.shadow_ground_plane.w / min(scale.x, scale.y) * length(light_depth_gradient) + 4e-7;
}

// Depth of a texel without a caster.
const float NO_CASTER_DEPTH = 1.0;
#endif

#ifdef SHADOW_STANDARD
// Standard shadow map: binary, from the single texel that contains the point.
float shadow_visibility(vec3 at, int layer, vec3 normal) {
    vec2 place = at.xy * frame.shadow.w;
    float depth = texelFetch(shadow_map, ivec3(place, layer), 0).x;
    float own = at.z - depth_bias(layer) + dot(receiver_plane_gradient(normal, layer), floor(place) + 0.5 - place);
    return depth >= NO_CASTER_DEPTH || own <= depth ? 1.0 : 0.0;
}
#endif

#ifdef SHADOW_FILTERED
// Percentage-closer filtering: share of the texels around the point without a caster in front of it, weighted by a
// Gaussian centered at the point (TAPS: one half, center first, and a trailing zero).
float shadow_visibility(vec3 at, int layer, vec3 normal) {
    vec2 place = at.xy * frame.shadow.w - 0.5;
    vec2 first = floor(place);
    vec2 past = place - first;
    vec2 steep = receiver_plane_gradient(normal, layer);
    float own = at.z - depth_bias(layer), share = 0.0;
    for (int y = -RADIUS; y <= RADIUS; y += 2) {
        vec2 rows = mix(vec2(TAPS[abs(y)], TAPS[abs(y + 1)]), vec2(TAPS[abs(y - 1)], TAPS[abs(y)]), past.y);
        for (int x = -RADIUS; x <= RADIUS; x += 2) {
            vec2 columns = mix(vec2(TAPS[abs(x)], TAPS[abs(x + 1)]), vec2(TAPS[abs(x - 1)], TAPS[abs(x)]), past.x);
            vec2 corner = vec2(x, y);
            // The four texels around their common corner, in textureGather order (0, 1), (1, 1), (1, 0), (0, 0).
            vec4 depth = textureGather(shadow_map, vec3((first + corner + 1.0) / frame.shadow.w, float(layer)), 0);
            float there = own + dot(steep, corner - past);
            vec4 plane = there + vec4(steep.y, steep.x + steep.y, steep.x, 0.0);
            vec4 open = vec4(lessThanEqual(plane, depth));
            open = max(open, vec4(greaterThanEqual(depth, vec4(NO_CASTER_DEPTH))));
            share += dot(open, rows.yyxx * columns.xyyx);
        }
    }
    return clamp(share, 0.0, 1.0);
}
#endif

float sun_visibility(vec3 world, vec3 normal) {
    vec3 at = (frame.shadow_from_world * vec4(world, 1.0)).xyz;
    int layer = 0;
#ifdef CASCADES
    layer = cascade_of(world);
    at.xy = to_cascade(at.xy, layer);
#endif
    // The rim has no caster. The outermost texels are not used, because filtering repeats them at the edge.
    vec2 inside = min(at.xy, 1.0 - at.xy) * frame.shadow.w;
    if (!(min(inside.x, inside.y) >= 1.0)) return 1.0;
    return shadow_visibility(at, layer, normal);
}
#else
float sun_visibility(vec3 world, vec3 normal) { return 1.0; }
#endif
