// Projects a corner of a triangle to the screen. A corner is a vertex with texture coordinates. Without MASK, texture
// coordinates are not needed: the index list contains vertices instead of corners. There are fewer vertices, and more
// triangles share each of them.
#ifdef MASK
layout(location = 0) in uint vertex;
layout(binding = 13) uniform samplerBuffer positions;
#else
layout(location = 0) in vec3 position;
#endif
#if defined(MASK) && defined(TEXTURES)
layout(location = 2) in vec2 uv;
centroid out vec2 image_uv;
#endif

void main() {
#ifdef MASK
    vec3 world = texelFetch(positions, int(vertex)).xyz;
#else
    vec3 world = position;
#endif
    gl_Position = to_clip(world);
#if defined(MASK) && defined(TEXTURES)
    image_uv = uv;
#endif
}
