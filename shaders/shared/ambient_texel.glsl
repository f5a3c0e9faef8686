// Texels of the ambient occlusion. A texel represents AMBIENT_SCALE x AMBIENT_SCALE pixels by the first sample of the
// lower left one.
#define AMBIENT_CENTER (SAMPLE_POSITIONS[0] / float(AMBIENT_SCALE))

// Size of the frame in texels. It need not be an integer.
vec2 ambient_extent() { return vec2(id_image_size()) / float(AMBIENT_SCALE); }

// Matrix from the coordinates (x, y, 1) of a texel to its view ray, whose length along the view axis is 1.
mat3 ambient_rays() {
    mat3 rays = mat3(frame.world_from_ndc);
    vec2 scale = 2.0 / ambient_extent();
    vec2 origin = scale * AMBIENT_CENTER - 1.0;
    return mat3(scale.x * rays[0], scale.y * rays[1], origin.x * rays[0] + origin.y * rays[1] + rays[2]);
}

// Whether the ambient light of a point on the ground may be occluded. The bounds of all surfaces are farther than the
// radius of the ambient occlusion from other points.
bool is_near_surfaces(vec3 world) {
    vec3 offset = world - frame.occlusion_sphere.xyz;
    return dot(offset, offset) <= frame.occlusion_sphere.w;
}

// A plane in image space. The inverse depth is linear in the texel coordinates: 1 / depth = (n . ray) / (n . offset),
// with the unit normal n and the offset of a point of the plane from the eye.
struct AmbientPlane {
    vec3 slope;       // dot(slope, (x, y, 1)) is 1 / depth
    float sharpness;  // 1 / tolerance of 1 / depth
};

// `depth`: distance of the point along the view axis.
AmbientPlane ambient_plane(mat3 rays, vec3 normal, vec3 offset, float depth) {
    float plane_distance = dot(normal, offset);
    vec3 slope = (normal * rays) / (abs(plane_distance) > 1e-30 ? plane_distance : 1e-30);
    // The tolerance of depths is 5 % of the radius, and more than the rounding errors of f32.
    return AmbientPlane(slope, depth * depth / max(0.05 * frame.to_sun.w, 1e-6 * depth));
}

// Weight of a texel in a mean over a plane: 1 if its depth is that of the plane, and almost 0 on other surfaces.
float ambient_weight(AmbientPlane plane, vec2 texel, float inverse_depth) {
    float difference = inverse_depth - dot(plane.slope, vec3(texel, 1.0));
    return clamp(1.5 - abs(difference) * plane.sharpness, 0.0, 1.0) + 1e-5;
}
