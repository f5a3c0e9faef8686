// Clip-space position of a vertex. Depth z / w is reversed: 1 at the near plane, 0 at the far plane. If the position
// overflows, the vertex is placed behind the far plane (z < 0), so that no NaN reaches the rasterizer. Its world
// position is set to the origin, so that no NaN reaches the shading either.
vec4 to_clip(inout vec3 world) {
    vec4 clip = frame.clip_from_world * vec4(world, 1.0);
    bool is_not_finite = any(isnan(clip)) || any(isinf(clip));
    if (is_not_finite) world = vec3(0.0);
    return is_not_finite ? vec4(0.0, 0.0, -2.0, 1.0) : clip;
}
