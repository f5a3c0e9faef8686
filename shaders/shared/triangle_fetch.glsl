// Reads a triangle from the scene's buffers.
struct Triangle {
    ivec3 corners;   // indices of its corners
    ivec3 vertices;  // indices of the corners' vertices
    mat3 world;      // one column per corner: world position
    mat3 clip;       // one column per corner: (x, y, w) in clip space, relative to the image point
    mat3 normal;     // one column per corner: normal
};

Triangle fetch_triangle(int index, vec2 ndc) {
    Triangle triangle;
    triangle.corners = ivec3(texelFetch(triangle_corners, index).xyz);
    triangle.vertices = ivec3(texelFetch(triangle_vertices, index).xyz);
    for (int corner = 0; corner < 3; corner++) {
        triangle.world[corner] = texelFetch(positions, triangle.vertices[corner]).xyz;
        vec4 corner_clip = to_clip(triangle.world[corner]);
        triangle.clip[corner] = vec3(corner_clip.xy - ndc * corner_clip.w, corner_clip.w);
        triangle.normal[corner] = texelFetch(normals, triangle.corners[corner]).xyz;
    }
    return triangle;
}
