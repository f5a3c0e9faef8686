// Projects a corner of a blended triangle: a vertex with normal and texture coordinates. Position, normal and tangent
// are already deformed.
layout(location = 0) in uint vertex;
layout(location = 1) in vec3 normal;
layout(binding = 13) uniform samplerBuffer positions;

out vec3 world;
centroid out vec3 normal_world;
#ifdef UVS
layout(location = 2) in vec2 uv;
centroid out vec2 image_uv;
#endif
#ifdef NORMAL_MAPS
layout(location = 3) in vec4 tangent;
centroid out vec4 tangent_world;
#endif

void main() {
    world = texelFetch(positions, int(vertex)).xyz;
    normal_world = normal;
#ifdef UVS
    image_uv = uv;
#endif
#ifdef NORMAL_MAPS
    tangent_world = tangent;
#endif
    gl_Position = to_clip(world);
}
