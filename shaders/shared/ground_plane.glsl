// Whether a view ray meets the ground: from above, within a square around the scene. A ray that is so level that the
// intersection is not finite fails the comparison. Twin: `FrameUniforms::ray_hits_ground` in src/render/frame_uniforms.rs.
bool ray_hits_ground(vec3 direction) {
    float fall = -dot(direction, frame.up.xyz), above = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    vec3 aside = abs(frame.eye.xyz - frame.ground_center.xyz + above / fall * direction) * (1.0 - frame.up.xyz);
    return fall > 0.0 && above > 0.0 && all(lessThanEqual(aside, vec3(frame.ground_center.w)));
}

// World-space direction of a view ray, one unit of depth long.
vec3 view_ray(vec2 image) { return mat3(frame.world_from_ndc) * vec3(image, 1.0); }

// Depth of the ground plane in normalized device coordinates at an image point. It is linear in the image, also above
// the horizon. `slope`: its change per unit of x and y.
float ground_plane_depth(vec2 image, out vec2 slope) {
    float above = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    // Inverse distance to the plane along a ray.
    vec3 falls = -frame.up.xyz * mat3(frame.world_from_ndc) / above;
    vec2 from = (frame.clip_from_world * vec4(frame.eye.xyz, 1.0)).zw;
    vec2 there = (frame.clip_from_world * vec4(view_ray(image), 0.0)).zw + dot(falls, vec3(image, 1.0)) * from;
    slope = from.x / there.y * falls.xy;
    return there.x / there.y;
}
