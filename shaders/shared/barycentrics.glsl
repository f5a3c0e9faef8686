// The scene's buffers, and perspective-correct barycentric coordinates with analytic derivatives. A vertex has a
// position; a corner is a vertex with a normal and texture coordinates.
layout(binding = 13) uniform samplerBuffer positions;           // [vertices]
layout(binding = 16) uniform samplerBuffer normals;             // [corners]
layout(binding = 17) uniform usamplerBuffer triangle_corners;   // [triangles]: three corner indices
layout(binding = 18) uniform usamplerBuffer triangle_vertices;  // [triangles]: three vertex indices

struct Barycentrics {
    vec3 weights;         // of the three corners; their sum is 1
    vec3 ddx;             // derivative of the weights per pixel along x of the image
    vec3 ddy;             // the same along y
    bool is_front_facing; // whether the front side is visible
};

// `a`, `b`, `c`: (x, y, w) of the corners in clip space, relative to the image point p: (x - p.x w, y - p.y w, w).
// `pixel_size`: size of a pixel in normalized device coordinates. The weights of `a`, `b` and `c` are proportional to
// (b x c).z, (c x a).z and (a x b).z. These are homogeneous coordinates, so corners behind the camera need no clipping.
// Subtracting the image point first avoids cancellation for small triangles.
Barycentrics compute_barycentrics(vec3 a, vec3 b, vec3 c, vec2 pixel_size) {
    float scale = 1.0 / max(max(abs(a.z), abs(b.z)), max(abs(c.z), 1e-30));
    a *= scale, b *= scale, c *= scale;
    mat3 edges = mat3(cross(b, c), cross(c, a), cross(a, b));
    vec3 edge_values = vec3(edges[0].z, edges[1].z, edges[2].z);
    float sum = edge_values.x + edge_values.y + edge_values.z;
    Barycentrics result;
    result.is_front_facing = sum > 0.0;
    // The image point lies in the triangle except for rounding. For a triangle without area, the sum is 0, and the
    // weights become 1/3.
    result.weights = clamp(edge_values / sum, 0.0, 1.0);
    float weight_sum = result.weights.x + result.weights.y + result.weights.z;
    result.weights = weight_sum > 0.5 ? result.weights / weight_sum : vec3(1.0 / 3.0);
    // (b x c).z is linear in the image point; x and y of the cross product are its derivatives.
    vec3 edge_ddx = pixel_size.x * vec3(edges[0].x, edges[1].x, edges[2].x);
    vec3 edge_ddy = pixel_size.y * vec3(edges[0].y, edges[1].y, edges[2].y);
    result.ddx = (edge_ddx - result.weights * (edge_ddx.x + edge_ddx.y + edge_ddx.z)) / sum;
    result.ddy = (edge_ddy - result.weights * (edge_ddy.x + edge_ddy.y + edge_ddy.z)) / sum;
    return result;
}
