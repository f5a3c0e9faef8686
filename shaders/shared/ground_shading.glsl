// Color of the ground: Lambert shading with shadow, blended into the horizon's color with distance.
vec3 shade_ground(vec3 world) {
    float cosine = max(dot(frame.up.xyz, frame.to_sun.xyz), 0.0);
    vec3 light = frame.skylight.rgb + sun_visibility(world, frame.up.xyz) * cosine * frame.sunlight.rgb;
    vec3 offset = world - frame.ground_center.xyz;
    float squared_distance = dot(offset, offset) / (frame.ground.a * frame.ground.a);
    return mix(frame.horizon.rgb, light * frame.ground.rgb, exp(-squared_distance));
}
