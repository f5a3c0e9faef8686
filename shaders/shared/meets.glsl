// Whether a ray from the eye meets the ground: its plane from above, within the square that would be drawn of it. A ray that
// is too level to be told where fails the comparison. Twin: `Frame::meets_ground` in src/render/frame.rs.
bool meets_ground(vec3 direction) {
    float fall = -dot(direction, frame.up.xyz), above = dot(frame.eye.xyz, frame.up.xyz) - frame.up.w;
    vec3 aside = abs(frame.eye.xyz - frame.ground_centre.xyz + above / fall * direction) * (1.0 - frame.up.xyz);
    return fall > 0.0 && above > 0.0 && all(lessThanEqual(aside, vec3(frame.ground_centre.w)));
}
