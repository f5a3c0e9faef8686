// Clip-space position of a vertex. A vertex that overflows is placed outside the view volume, and its world position at
// the origin: no NaN reaches the rasterizer, and shading uses the same position as rasterization.
vec4 to_clip(inout vec3 world) {
    vec4 clip = frame.clip_from_world * vec4(world, 1.0);
    bool bad = any(isnan(clip)) || any(isinf(clip));
    if (bad) world = vec3(0.0);
    return bad ? vec4(0.0, 0.0, -2.0, 1.0) : clip;
}
