// Lines along the edges of a triangle, with a constant width in pixels.
#ifdef INNER_EDGES
// [triangles / 8] Four bits per triangle in the draw order: bit i is 1 if the edge opposite to corner i is inside of a
// polygon. Such an edge has no line.
layout(std430, binding = 2) readonly buffer InnerEdgeBlock { uint inner_edges[]; };
#endif

// Part of a pixel that the lines of a triangle cover. For the corners b and c relative to the image point, (b x c).z is
// linear in the image point, and zero on the edge from b to c. Divided by the length of its gradient, it is the
// distance to that edge. At corner a, this distance is the height of the triangle over the edge. Lines fade out where a
// triangle is lower than four widths, because the lines of smaller triangles would cover the surface.
float edge_coverage(Triangle triangle, int triangle_index, vec2 pixel_size) {
    vec3 a = triangle.clip[0], b = triangle.clip[1], c = triangle.clip[2];
    float scale = 1.0 / max(max(abs(a.z), abs(b.z)), max(abs(c.z), 1e-30));
    a *= scale, b *= scale, c *= scale;
    mat3 edges = mat3(cross(b, c), cross(c, a), cross(a, b));
    float determinant = abs(dot(a, edges[0]));
    vec3 corner_depths = abs(vec3(a.z, b.z, c.z));
    float width = frame.edges.w, coverage = 0.0;
    uint inner = 0u;
#ifdef INNER_EDGES
    inner = inner_edges[triangle_index >> 3] >> (4 * (triangle_index & 7));
#endif
    for (int edge = 0; edge < 3; edge++) {
        float slope = max(length(edges[edge].xy * pixel_size), 1e-30);
        float distance_in_pixels = abs(edges[edge].z) / slope;
        float height = determinant / max(corner_depths[edge] * slope, 1e-30);
        float line = clamp(0.5 * width + 0.5 - distance_in_pixels, 0.0, 1.0) * clamp(height / (4.0 * width), 0.0, 1.0);
        if ((inner >> edge & 1u) == 0u) coverage = max(coverage, line);
    }
    return coverage;
}
