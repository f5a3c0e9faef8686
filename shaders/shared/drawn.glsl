// Which triangle of the scene a fragment belongs to; one draw call begins at `first_triangle`. A call that draws from a list
// of triangles gives the complement of where its list begins.
layout(location = 0) uniform int first_triangle;
#ifdef CULLED
layout(binding = 25) uniform usamplerBuffer names;

int own_triangle() {
    if (first_triangle >= 0) return first_triangle + gl_PrimitiveID;
    return int(texelFetch(names, ~first_triangle + gl_PrimitiveID).x);
}
#else
int own_triangle() { return first_triangle + gl_PrimitiveID; }
#endif
