// Where a vertex is on the screen. One that overflowed is put behind the camera, and its place in the world at the origin:
// no NaN reaches the rasteriser, and what is shaded is what was rasterised.
vec4 to_clip(inout vec3 world) {
    vec4 clip = frame.clip_from_world * vec4(world, 1.0);
    bool bad = any(isnan(clip)) || any(isinf(clip));
    if (bad) world = vec3(0.0);
    return bad ? vec4(0.0, 0.0, -2.0, 1.0) : clip;
}
