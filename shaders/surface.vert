// One corner: its vertex of the deformed positions, its deformed normal and tangent, its texture coordinates.
layout(location = 0) in uint vertex;
layout(location = 1) in vec3 normal;
layout(binding = 13) uniform samplerBuffer positions;

out vec3 world;
centroid out vec3 normal_world;
#ifdef UVS
layout(location = 2) in vec2 uv;
centroid out vec2 uv_image;
#endif
#ifdef NORMAL_MAPS
layout(location = 3) in vec4 tangent;
centroid out vec4 tangent_world;
#endif

void main() {
    world = texelFetch(positions, int(vertex)).xyz;
    normal_world = normal;
#ifdef UVS
    uv_image = uv;
#endif
#ifdef NORMAL_MAPS
    tangent_world = tangent;
#endif
    vec4 clip = frame.clip_from_world * vec4(world, 1.0);
    // A vertex that overflowed is put behind the camera: no NaN reaches the rasteriser.
    bool bad = any(isnan(clip)) || any(isinf(clip));
    gl_Position = bad ? vec4(0.0, 0.0, -2.0, 1.0) : clip;
    if (bad) world = vec3(0.0);
}
