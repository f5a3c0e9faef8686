// Projects a corner of a triangle to the shadow map. A corner is a vertex with texture coordinates. With POSITION_ONLY,
// the index list contains vertices instead of corners, and the vertex buffer contains positions.
#ifdef POSITION_ONLY
layout(location = 0) in vec3 position;
#else
layout(location = 0) in uint vertex;
layout(binding = 13) uniform samplerBuffer positions;
#endif
#if defined(TEXTURES) && !defined(POSITION_ONLY)
layout(location = 2) in vec2 uv;
centroid out vec2 image_uv;
#endif
#ifdef CASCADES
layout(location = 1) uniform int layer;
#endif

void main() {
#ifdef POSITION_ONLY
    vec3 world = position;
#else
    vec3 world = texelFetch(positions, int(vertex)).xyz;
#endif
    vec3 map_position = (frame.shadow_from_world * vec4(world, 1.0)).xyz;
#ifdef CASCADES
    map_position.xy = to_cascade(map_position.xy, layer);
#endif
    // Depth is reversed, as for the camera: 1 nearest to the sun. A vertex that is not finite is placed outside the
    // view volume, as in `to_clip`.
    bool is_not_finite = any(isnan(map_position)) || any(isinf(map_position));
    vec4 clip = vec4(2.0 * map_position.xy - 1.0, 1.0 - map_position.z, 1.0);
    gl_Position = is_not_finite ? vec4(0.0, 0.0, -2.0, 1.0) : clip;
#if defined(TEXTURES) && !defined(POSITION_ONLY)
    image_uv = uv;
#endif
}
