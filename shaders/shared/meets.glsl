// Whether a ray from the eye meets the ground: its plane from above, within a square about the scene. A ray that is too level
// to be told where fails the comparison. Twin: `Frame::meets_ground` in src/render/frame.rs.
bool meets_ground(vec3 direction) {
    float fall = -dot(direction, frame.up.xyz), above = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    vec3 aside = abs(frame.eye.xyz - frame.ground_centre.xyz + above / fall * direction) * (1.0 - frame.up.xyz);
    return fall > 0.0 && above > 0.0 && all(lessThanEqual(aside, vec3(frame.ground_centre.w)));
}

// A direction in the world, as long as it takes to go one unit of depth.
vec3 towards(vec2 image) { return mat3(frame.world_from_image) * vec3(image, 1.0); }

// Depth of the ground's plane in clip space, over w, at a place of the picture: linear in it, above the horizon too. `slope`
// is by how much it changes from there to one unit aside, in x and in y.
float ground_depth(vec2 image, out vec2 slope) {
    float above = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    // One over the way to the plane.
    vec3 falls = -frame.up.xyz * mat3(frame.world_from_image) / above;
    vec2 from = (frame.clip_from_world * vec4(frame.eye.xyz, 1.0)).zw;
    vec2 there = (frame.clip_from_world * vec4(towards(image), 0.0)).zw + dot(falls, vec3(image, 1.0)) * from;
    slope = from.x / there.y * falls.xy;
    return there.x / there.y;
}
