// How much of the sun reaches a point: Chebyshev's bound on the blurred moments of depth (equation 3.10 with the variance
// M2 - M1 M1; depth is counted from the middle of its range, where floats are finest).
#ifdef SHADOWS
layout(binding = 0) uniform sampler2D moments_map;

float sunlit(vec3 world) {
    vec3 at = (frame.map_from_world * vec4(world, 1.0)).xyz;
    // The rim holds no caster; the outermost texels are left alone, where filtering repeats the edge.
    vec2 inside = min(at.xy, 1.0 - at.xy) * frame.shadow.w;
    if (min(inside.x, inside.y) < 1.0) return 1.0;
    vec2 moments = textureLod(moments_map, at.xy, 0.0).xy;
    float behind = clamp(at.z, 0.0, 1.0) - 0.5 - moments.x;
    if (behind <= 0.0) return 1.0;
    float variance = max(moments.y - moments.x * moments.x, frame.shadow.x);
    float bound = variance / (variance + behind * behind);
    return clamp((bound - frame.shadow.y) / (1.0 - frame.shadow.y), 0.0, 1.0);
}
#else
float sunlit(vec3 world) { return 1.0; }
#endif
