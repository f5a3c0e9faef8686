// `sun_visibility`: fraction of the sun's light that reaches a surface point, for all shadow methods. It uses no
// derivatives, so that fragment and compute shaders can call it. NaN inputs give a finite result. A map position is x,
// y and depth in the shadow map, each from 0 to 1. With cascades, x and y are those of the point's layer.
#ifdef SHADOWS
#ifdef SHADOW_VARIANCE
layout(binding = 0) uniform sampler2DArray shadow_moments;
#ifdef PCF_FALLBACK
layout(binding = 27) uniform sampler2DArray shadow_depth;
#endif
#else
layout(binding = 0) uniform sampler2DArray shadow_depth;
#endif

#ifdef CASCADES
vec2 cascade_scale(int layer) { return cascades.scale_offsets[layer].xy; }
#else
vec2 cascade_scale(int layer) { return vec2(1.0); }
#endif

// Slope of the surface plane in the map: change of depth per texel in x and in y.
vec2 receiver_plane_gradient(vec3 normal, int layer) {
    // The rows a_i of the map's matrix are the scaled axes of light space. The third row points away from the sun. A
    // point x has the map coordinates p_i = a_i . x, up to offsets. The plane of a surface with normal n is therefore
    // sum_i p_i (n . a_i) / (a_i . a_i) = constant. The result is the gradient of p_2 as a function of p_0 and p_1.
    mat3 axes = transpose(mat3(frame.shadow_from_world));
    vec3 light_normal = vec3(dot(normal, axes[0]), dot(normal, axes[1]), dot(normal, axes[2]));
    vec3 axis_squares = vec3(dot(axes[0], axes[0]), dot(axes[1], axes[1]), dot(axes[2], axes[2]));
    // Slopes steeper than ten to one, where the sun is at a grazing angle, are clamped.
    float clamped_z = max(abs(light_normal.z), 0.1 * sqrt(axis_squares.z)) * (light_normal.z < 0.0 ? -1.0 : 1.0);
    return -(light_normal.xy / axis_squares.xy) * (axis_squares.z / clamped_z) / (frame.shadow.w * cascade_scale(layer));
}

#if !defined(SHADOW_VARIANCE) || defined(PCF_FALLBACK)
// Bias of the comparison. A texel's depth is compared with the depth of the surface plane at the texel's center, so a
// slope does not shadow itself. A caster must be in front of that plane by at least the side of a texel, because on
// curved surfaces the triangles deviate from the plane that the normal defines. The term 4e-7 covers the rounding of
// depth.
float depth_bias(int layer) {
    vec3 light_depth_gradient = vec3(frame.shadow_from_world[0].z, frame.shadow_from_world[1].z, frame.shadow_from_world[2].z);
    vec2 layer_scale = cascade_scale(layer);
    // `shadow_ground_plane.w`: side of a texel in scene units. The gradient is the change of depth per scene unit.
    return frame.shadow_ground_plane.w / min(layer_scale.x, layer_scale.y) * length(light_depth_gradient) + 4e-7;
}

// The map stores 1 - depth, as all depth images. 0 is the value of a texel without a caster.
float caster_depth(float stored) { return 1.0 - stored; }
vec4 caster_depth(vec4 stored) { return 1.0 - stored; }

// Depth of a texel without a caster.
const float NO_CASTER_DEPTH = 1.0;
#endif

#ifdef SHADOW_STANDARD
// Standard shadow map: 0 or 1, from the texel that contains the point.
float shadow_visibility(vec3 position, int layer, vec3 normal) {
    vec2 texel = position.xy * frame.shadow.w;
    float depth = caster_depth(texelFetch(shadow_depth, ivec3(texel, layer), 0).x);
    float receiver_depth = position.z - depth_bias(layer) + dot(receiver_plane_gradient(normal, layer), floor(texel) + 0.5 - texel);
    return depth >= NO_CASTER_DEPTH || receiver_depth <= depth ? 1.0 : 0.0;
}
#endif

#if defined(SHADOW_FILTERED) || defined(PCF_FALLBACK)
// Weights of the texels at these distances from the center, along one axis.
vec3 tap_weights(vec3 offsets) { return TAP_SCALE * exp2(TAP_FALLOFF * offsets * offsets); }

// Percentage-closer filtering: weight of the texels without a caster in front of the point. The weights are a Gaussian
// centered at the point. GATHERS x GATHERS texture gathers read four texels each; GATHER_SPACING is even and the distance
// of two gathers in texels, 2 if no texel is skipped. `rows` is GATHERS.
float percentage_closer_visibility(vec3 position, int layer, vec3 normal, int rows) {
    vec2 texel = position.xy * frame.shadow.w - 0.5;
    vec2 base_texel = floor(texel); // the point lies between this texel's center and those of its next neighbors
    vec2 fraction = texel - base_texel;
    vec2 gradient = receiver_plane_gradient(normal, layer);
    float receiver_depth = position.z - depth_bias(layer), lit_weight = 0.0;
    const float first_offset = float((1 - GATHERS) * GATHER_SPACING / 2);
    for (int row = 0; row < rows; row++) {
        float y = first_offset + float(row * GATHER_SPACING);
        // Weights of rows y and y + 1, interpolated between Gaussians that are centered at rows 0 and 1.
        vec3 row_taps = tap_weights(vec3(y - 1.0, y, y + 1.0));
        vec2 row_weights = mix(row_taps.yz, row_taps.xy, fraction.y);
        for (int column = 0; column < GATHERS; column++) {
            float x = first_offset + float(column * GATHER_SPACING);
            vec3 column_taps = tap_weights(vec3(x - 1.0, x, x + 1.0));
            vec2 column_weights = mix(column_taps.yz, column_taps.xy, fraction.x);
            vec2 corner = vec2(x, y);
            // The four texels around their common corner, in textureGather order (0, 1), (1, 1), (1, 0), (0, 0).
            vec4 depth = caster_depth(textureGather(shadow_depth, vec3((base_texel + corner + 1.0) / frame.shadow.w, float(layer)), 0));
            float corner_depth = receiver_depth + dot(gradient, corner - fraction);
            vec4 receiver_depths = corner_depth + vec4(gradient.y, gradient.x + gradient.y, gradient.x, 0.0);
            vec4 is_lit = vec4(lessThanEqual(receiver_depths, depth));
            is_lit = max(is_lit, vec4(greaterThanEqual(depth, vec4(NO_CASTER_DEPTH))));
            lit_weight += dot(row_weights.yyxx * column_weights.xyyx, is_lit);
        }
    }
    return lit_weight;
}
#endif

#ifdef SHADOW_FILTERED
float shadow_visibility(vec3 position, int layer, vec3 normal) {
    return percentage_closer_visibility(position, layer, normal, GATHERS);
}
#endif

#ifdef SHADOW_VARIANCE
// Bias that compensates for ground depth leaking into the blurred mean near a contact line, where a surface meets the
// ground. The leak would pull the mean towards the sun, although the ground casts no shadow. Let h be the height above
// the line in standard deviations of the blur, and k the depth difference of surface and ground per standard deviation.
// The ground shifts the mean by k (phi(h) - h Q(h)), with the density phi and the upper tail Q of the normal
// distribution. The bias 0.4 k (1 - h / 2)^2 is an upper bound of this shift up to h = 1.9.
float contact_bias(vec3 position, int layer, vec3 normal) {
    vec2 map_position = position.xy;
#ifdef CASCADES
    map_position = from_cascade(map_position, layer);
#endif
    float depth_above_ground = max(dot(frame.shadow_ground_plane.xy, map_position) + frame.shadow_ground_plane.z - position.z, 0.0);
    float gradient_difference = DEVIATION * length(receiver_plane_gradient(normal, layer) - receiver_plane_gradient(frame.up.xyz, layer));
    float proximity = 1.0 - 0.5 * depth_above_ground / max(gradient_difference, 1e-12);
    return proximity > 0.0 ? 0.4 * gradient_difference * proximity * proximity : 0.0;
}

#ifdef PCF_FALLBACK
// Whether the moments show that no occluder is in front of the surface within the filter: the mean is not in front of
// the surface by more than the bias of a comparison, and the variance is that of the surface plane. The factor 1.5
// covers curvature and interpolated normals.
bool has_moments_of_surface(float excess_depth, float variance, int layer, vec3 normal) {
    vec2 slope = DEVIATION * receiver_plane_gradient(normal, layer);
    return !(excess_depth > depth_bias(layer)) && !(variance > 1.5 * dot(slope, slope) + ROUNDING_VARIANCE);
}
#endif

// `frame.shadow.y` is the light bleeding reduction.
float reduce_bleeding(float visibility) { return clamp((visibility - frame.shadow.y) / (1.0 - frame.shadow.y), 0.0, 1.0); }

// Chebyshev's bound from the blurred moments of depth (equation 3.10 with the variance M2 - M1 M1). Depth is measured
// from the center of its range, which reduces rounding errors. The bound is exact for one occluder depth in front of the
// surface, and too large for several: light would bleed. So the moments only decide that a point is in full shadow or
// fully lit. At all other points, percentage-closer filtering of the depths replaces the bound if it is smaller.
float shadow_visibility(vec3 position, int layer, vec3 normal) {
    vec2 moments = textureLod(shadow_moments, vec3(position.xy, float(layer)), 0.0).xy;
    float excess_depth = clamp(position.z, 0.0, 1.0) - 0.5 - moments.x - contact_bias(position, layer, normal);
    float variance = moments.y - moments.x * moments.x, bound = 1.0;
    if (excess_depth > 0.0) {
        float clamped_variance = max(variance, frame.shadow.x); // `frame.shadow.x`: minimum variance
        bound = clamped_variance / (clamped_variance + excess_depth * excess_depth);
    }
    float visibility = reduce_bleeding(bound);
#ifdef PCF_FALLBACK
    if (visibility > 0.0 && !has_moments_of_surface(excess_depth, variance, layer, normal)) {
        // Software rasterizers execute unrolled loops also where no lane is in this branch. A number of rows that depends
        // on a uniform prevents unrolling.
        int rows = frame.shadow.w > 0.0 ? GATHERS : 0;
        float filtered = percentage_closer_visibility(position, layer, normal, rows);
        // Filtered depths leak no light, unless texels are skipped: then penumbrae are a few percent too bright or dark.
        visibility = min(visibility, GATHER_SPACING > 2 ? reduce_bleeding(filtered) : filtered);
    }
#endif
    return visibility;
}
#endif

float sun_visibility(vec3 world, vec3 normal) {
    vec3 position = (frame.shadow_from_world * vec4(world, 1.0)).xyz;
    int layer = 0;
#ifdef CASCADES
    layer = cascade_of(world);
    position.xy = to_cascade(position.xy, layer);
#endif
    // No caster is near the edge of the map. Its outermost texels are not used, because filtering repeats them.
    vec2 edge_distance = min(position.xy, 1.0 - position.xy) * frame.shadow.w;
    if (!(min(edge_distance.x, edge_distance.y) >= 1.0)) return 1.0;
    return shadow_visibility(position, layer, normal);
}
#else
float sun_visibility(vec3 world, vec3 normal) { return 1.0; }
#endif
