// Whether a view ray hits the ground from above, within a square around the scene. If the ray is almost level, the
// intersection may not be finite; then the result is false. Twin: `FrameUniforms::ray_hits_ground` in
// src/render/uniforms/frame.rs.
bool ray_hits_ground(vec3 direction) {
    float descent = -dot(direction, frame.up.xyz), eye_height = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    // Distance of the intersection from the center of the square, per axis. The up direction is a coordinate axis, and
    // the last factor sets this component to 0.
    vec3 offset = abs(frame.eye.xyz - frame.ground_center.xyz + eye_height / descent * direction) * (1.0 - frame.up.xyz);
    return descent > 0.0 && eye_height > 0.0 && all(lessThanEqual(offset, vec3(frame.ground_center.w)));
}

// World-space direction of the view ray through an image point. Its length along the view axis is 1, so a distance in
// units of this vector is a depth.
vec3 view_ray(vec2 ndc) { return mat3(frame.world_from_ndc) * vec3(ndc, 1.0); }

#ifdef HAS_GROUND
// Depth along a view ray where it meets the ground plane. The ray must hit the ground.
float ground_ray_depth(vec3 direction) {
    // The ray points down, except for rounding.
    float ascent = min(dot(direction, frame.up.xyz), -1e-9 * length(direction));
    return (frame.up.w - dot(frame.eye.xyz, frame.up.xyz)) / ascent;
}
#endif
