// One corner as the camera sees it: its vertex of the deformed positions, and what a cut-out is cut by.
layout(location = 0) in uint vertex;
layout(binding = 13) uniform samplerBuffer positions;
#if defined(MASK) && defined(TEXTURES)
layout(location = 2) in vec2 uv;
centroid out vec2 uv_image;
#endif

void main() {
    vec3 world = texelFetch(positions, int(vertex)).xyz;
    gl_Position = to_clip(world);
#if defined(MASK) && defined(TEXTURES)
    uv_image = uv;
#endif
}
