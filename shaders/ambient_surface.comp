// Finds the surface at each texel of the ambient occlusion: depth along the view axis and face normal at one pixel.
//   ids      (in)   [height][width][SAMPLES]  R32UI; only the first sample of a pixel is read
//   surface  (out)  [height / AMBIENT_SCALE][width / AMBIENT_SCALE]  RG32UI: depth as the bits of a float, 0 for the
//                   sky, negative for the ground; normal in octahedral coordinates of two 16-bit numbers
// All images have the bottom row first.
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(rg32ui, binding = 0) uniform writeonly uimage2D surface;

void main() {
    ivec2 texel = image_pixel(), size = imageSize(surface), id_size = id_image_size();
    if (any(greaterThanEqual(texel, size))) return;
    ivec2 pixel = min(AMBIENT_SCALE * texel, id_size - 1);
    uint id = load_id(pixel, 0);
    vec2 ndc = 2.0 * (vec2(pixel) + SAMPLE_POSITIONS[0]) / vec2(id_size) - 1.0;
    vec3 direction = view_ray(ndc), normal = -direction;
    float depth = 0.0;
#ifdef HAS_GROUND
    if (id == NO_ID && frame.eye.w > 0.0 && ray_hits_ground(direction)) {
        float ground_depth = ground_ray_depth(direction);
        if (is_near_surfaces(frame.eye.xyz + ground_depth * direction)) depth = -ground_depth;
        normal = frame.up.xyz;
    }
#endif
    if (id != NO_ID) {
        ivec3 vertices = ivec3(texelFetch(triangle_vertices, int(id - 1u)).xyz);
        vec3 corners[3], corner_depths;
        for (int corner = 0; corner < 3; corner++) {
            corners[corner] = texelFetch(positions, vertices[corner]).xyz;
            corner_depths[corner] = to_clip(corners[corner]).w;
        }
        vec3 edge = safe_normalize(corners[1] - corners[0]);
        vec3 face = safe_normalize(cross(edge, safe_normalize(corners[2] - corners[0])));
        float cosine = dot(face, direction);
        if (abs(cosine) > 0.0) normal = cosine > 0.0 ? -face : face;
        // The view ray meets the plane of the triangle at this depth. It is clamped, because a grazing ray may miss.
        float nearest = min(corner_depths.x, min(corner_depths.y, corner_depths.z));
        float farthest = max(corner_depths.x, max(corner_depths.y, corner_depths.z));
        float plane_depth = dot(face, corners[0] - frame.eye.xyz) / cosine;
        // Comparisons with NaN are false.
        depth = plane_depth > nearest ? min(plane_depth, farthest) : nearest;
        depth = max(depth, 1e-30);
    }
    uint packed_normal = packSnorm2x16(encode_octahedral(normalize(normal)));
    imageStore(surface, texel, uvec4(floatBitsToUint(depth), packed_normal, 0u, 0u));
}
