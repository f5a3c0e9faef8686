// AOV (arbitrary output variable) readback of one field: DEPTH, DEPTH_WITH_GROUND, NORMALS or VALUES. The macro of
// that name is defined. SAMPLES is 1 except with VALUES. HAS_GROUND is defined with DEPTH_WITH_GROUND in scenes that
// have a ground plane.
//   ids      (in)  [height][width][SAMPLES]  R32UI, bottom row first; NO_ID where no surface is visible
//   values   (in)  [vertices]                a scalar per vertex, with VALUES
//   words    (out) top row first, one of
//     DEPTH    [height][width]           f32: depth along the view axis times `scale`, in meters; infinite with NO_ID.
//                                        With DEPTH_WITH_GROUND, NO_ID has the depth of visible ground.
//     NORMALS  [height][width][3]        f32: unit normal of the visible side; zeros with NO_ID
//     VALUES   [height][width][SAMPLES]  two 16-bit fixed-point numbers from 0 to 1. Low half: value times `scale`.
//                                        High half: cosine between the normal and the direction to the eye, at least
//                                        1 / 65535 (the smallest nonzero number). Both are 0 with NO_ID.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(location = 0) uniform int scale_bits; // `scale` as the bits of a float
layout(std430, binding = 0) writeonly buffer Words { uint words[]; };
#ifdef VALUES
layout(binding = 24) uniform samplerBuffer values;
#endif

// A triangle, evaluated at an image point.
struct SurfacePoint {
    vec3 weights;    // barycentric coordinates
    vec3 depths;     // of the corners, along the view axis
    vec3 world;
    vec3 normal;     // on the visible side; not normalized
    ivec3 vertices;  // indices of the corners' vertices
};

SurfacePoint interpolate_surface(int triangle_index, vec2 ndc) {
    Triangle triangle = fetch_triangle(triangle_index, ndc);
    // The derivatives are not used, so the pixel size is 0.
    Barycentrics bary = compute_barycentrics(triangle.clip[0], triangle.clip[1], triangle.clip[2], vec2(0.0));
    SurfacePoint surface;
    surface.weights = bary.weights;
    // A column of `clip` is (x, y, w), and w is the depth along the view axis.
    surface.depths = vec3(triangle.clip[0].z, triangle.clip[1].z, triangle.clip[2].z);
    surface.world = triangle.world * surface.weights;
    vec3 normal = triangle.normal * surface.weights;
    surface.normal = bary.is_front_facing ? normal : -normal;
    surface.vertices = triangle.vertices;
    return surface;
}

vec3 normalize_or_zero(vec3 v) {
    float max_component = max(max(abs(v.x), abs(v.y)), abs(v.z));
    return max_component > 0.0 && !isinf(max_component) ? normalize(v / max_component) : vec3(0.0);
}

#if defined(DEPTH) || defined(DEPTH_WITH_GROUND)
float depth_of(uint id, vec2 ndc) {
#ifdef HAS_GROUND
    // `eye.w` is 1 if the camera is above the ground.
    vec3 direction = view_ray(ndc);
    if (id == NO_ID && frame.eye.w > 0.0 && ray_hits_ground(direction)) return ground_ray_depth(direction);
#endif
    if (id == NO_ID) return uintBitsToFloat(0x7F800000u); // infinity
    SurfacePoint surface = interpolate_surface(int(id - 1u), ndc);
    return dot(surface.depths, surface.weights);
}
#endif

#ifdef NORMALS
vec3 normal_of(uint id, vec2 ndc) {
    if (id == NO_ID) return vec3(0.0);
    return normalize_or_zero(interpolate_surface(int(id - 1u), ndc).normal);
}
#endif

#ifdef VALUES
uint value_of(uint id, vec2 ndc, float scale) {
    if (id == NO_ID) return 0u;
    SurfacePoint surface = interpolate_surface(int(id - 1u), ndc);
    vec3 corner_values = vec3(0.0);
    for (int corner = 0; corner < 3; corner++) corner_values[corner] = texelFetch(values, surface.vertices[corner]).x;
    float facing = dot(normalize_or_zero(surface.normal), normalize_or_zero(frame.eye.xyz - surface.world));
    return packUnorm2x16(vec2(dot(corner_values, surface.weights) * scale, max(facing, 1.0 / 65535.0)));
}
#endif

void main() {
    ivec2 size = id_image_size();
    ivec2 pixel = image_pixel();
    if (pixel.x >= size.x) return;
    uint output_index = uint(size.y - 1 - pixel.y) * uint(size.x) + uint(pixel.x);
    float scale = intBitsToFloat(scale_bits);
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
        // `load_id` checks the depth because multisampled ids are normally not cleared and may be stale. The id image
        // of this pass is cleared, so the check is not needed.
        uint id = texelFetch(ids, pixel, sample_index).x;
        vec2 ndc = 2.0 * (vec2(pixel) + SAMPLE_POSITIONS[sample_index]) / vec2(size) - 1.0;
#if defined(DEPTH) || defined(DEPTH_WITH_GROUND)
        words[output_index] = floatBitsToUint(scale * depth_of(id, ndc));
#endif
#ifdef NORMALS
        vec3 normal = normal_of(id, ndc);
        for (int axis = 0; axis < 3; axis++) words[3u * output_index + uint(axis)] = floatBitsToUint(normal[axis]);
#endif
#ifdef VALUES
        words[uint(SAMPLES) * output_index + uint(sample_index)] = value_of(id, ndc, scale);
#endif
    }
}
