// Index of a fragment's triangle in the draw order. `first_triangle` is the first triangle of the draw call. For a list
// of visible triangles, it is the bitwise complement of the index of the list's first entry in `triangle_ids`.
layout(location = 0) uniform int first_triangle;
#ifdef CULLED
layout(binding = 25) uniform usamplerBuffer triangle_ids;

int current_triangle() {
    if (first_triangle >= 0) return first_triangle + gl_PrimitiveID;
    return int(texelFetch(triangle_ids, ~first_triangle + gl_PrimitiveID).x);
}
#else
int current_triangle() { return first_triangle + gl_PrimitiveID; }
#endif
