// Evaluates a triangle of the scene's buffers at an image point: perspective-correct barycentric coordinates with
// analytic derivatives.
layout(binding = 13) uniform samplerBuffer positions;
layout(binding = 16) uniform samplerBuffer normals;
layout(binding = 17) uniform usamplerBuffer triangle_corners;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;

struct Barycentrics {
    vec3 weights;         // of the three corners; their sum is 1
    vec3 ddx;             // derivative of the weights per pixel along x of the image
    vec3 ddy;             // the same along y
    bool is_front_facing; // whether the front side is visible
};

// `a`, `b`, `c`: the corners as c_i = (x, y, w) of clip space, relative to the image point. `pixel_size`: size of a
// pixel in normalized device coordinates. The weight of corner i is proportional to (c_j x c_k).z. These are
// homogeneous coordinates, so corners behind the camera need no clipping. Subtracting the image point first avoids
// cancellation for small triangles.
Barycentrics compute_barycentrics(vec3 a, vec3 b, vec3 c, vec2 pixel_size) {
    float scale = 1.0 / max(max(abs(a.z), abs(b.z)), max(abs(c.z), 1e-30));
    a *= scale, b *= scale, c *= scale;
    mat3 edges = mat3(cross(b, c), cross(c, a), cross(a, b));
    vec3 edge_values = vec3(edges[0].z, edges[1].z, edges[2].z);
    float sum = edge_values.x + edge_values.y + edge_values.z;
    Barycentrics result;
    result.is_front_facing = sum > 0.0;
    // The point lies inside except for rounding. For a triangle without area the sum is 0, and any weights are valid.
    result.weights = clamp(edge_values / sum, 0.0, 1.0);
    float weight_sum = result.weights.x + result.weights.y + result.weights.z;
    result.weights = weight_sum > 0.5 ? result.weights / weight_sum : vec3(1.0 / 3.0);
    vec3 edge_ddx = pixel_size.x * vec3(edges[0].x, edges[1].x, edges[2].x);
    vec3 edge_ddy = pixel_size.y * vec3(edges[0].y, edges[1].y, edges[2].y);
    result.ddx = (edge_ddx - result.weights * (edge_ddx.x + edge_ddx.y + edge_ddx.z)) / sum;
    result.ddy = (edge_ddy - result.weights * (edge_ddy.x + edge_ddy.y + edge_ddy.z)) / sum;
    return result;
}
