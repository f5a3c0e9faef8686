// The ground: a square so large that its edge has long faded into the horizon, made from the vertex's number.
void main() {
    const vec2 corners[6] = vec2[](vec2(-1, -1), vec2(1, -1), vec2(1, 1), vec2(-1, -1), vec2(1, 1), vec2(-1, 1));
    vec2 corner = corners[gl_VertexID] * frame.ground_centre.w;
    // The up axis is a unit vector of the frame, so turning its components around gives the two others.
    vec3 world = frame.ground_centre.xyz + corner.x * frame.up.yzx + corner.y * frame.up.zxy;
    gl_Position = frame.clip_from_world * vec4(world, 1.0);
}
