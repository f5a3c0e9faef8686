// Evaluates a triangle at an image point from the scene's buffers: perspective-correct barycentric coordinates of its
// corners with analytic derivatives.
layout(binding = 13) uniform samplerBuffer positions;
layout(binding = 16) uniform samplerBuffer normals;
layout(binding = 17) uniform usamplerBuffer triangle_corners;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;

// Barycentric coordinates; their derivatives along x and y of the image, per pixel; and whether the front side is
// visible.
struct Barycentrics {
    vec3 weights;
    vec3 ddx;
    vec3 ddy;
    bool front;
};

// With c_i = (x, y, w) of the corners in clip space relative to the image point, corner i has the share (c_j x c_k).z
// of their sum. This is homogeneous, so corners behind the camera need no clipping. Subtracting the image point first
// avoids the cancellation that small triangles would suffer.
Barycentrics barycentrics(vec3 a, vec3 b, vec3 c, vec2 texel) {
    float scale = 1.0 / max(max(abs(a.z), abs(b.z)), max(abs(c.z), 1e-30));
    a *= scale, b *= scale, c *= scale;
    mat3 edges = mat3(cross(b, c), cross(c, a), cross(a, b));
    vec3 inside = vec3(edges[0].z, edges[1].z, edges[2].z);
    float sum = inside.x + inside.y + inside.z;
    Barycentrics found;
    found.front = sum > 0.0;
    // The point lies inside except for rounding. A triangle without area has no sum; any coordinates are right.
    found.weights = clamp(inside / sum, 0.0, 1.0);
    float whole = found.weights.x + found.weights.y + found.weights.z;
    found.weights = whole > 0.5 ? found.weights / whole : vec3(1.0 / 3.0);
    vec3 by_x = texel.x * vec3(edges[0].x, edges[1].x, edges[2].x);
    vec3 by_y = texel.y * vec3(edges[0].y, edges[1].y, edges[2].y);
    found.ddx = (by_x - found.weights * (by_x.x + by_x.y + by_x.z)) / sum;
    found.ddy = (by_y - found.weights * (by_y.x + by_y.y + by_y.z)) / sum;
    return found;
}
