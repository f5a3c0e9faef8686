// Color of the ground: Lambert shading with shadow and ambient occlusion, blended into the horizon's color with
// distance.
vec3 shade_ground(vec3 world, float ambient_visibility) {
    float cosine = max(dot(frame.up.xyz, frame.to_sun.xyz), 0.0);
    vec3 light = ambient_visibility * ambient_light(frame.up.xyz) + sun_visibility(world, frame.up.xyz) * cosine * frame.sunlight.rgb;
    vec3 offset = world - frame.ground_center.xyz;
    float squared_distance = dot(offset, offset) / (frame.ground.a * frame.ground.a);
    return mix(frame.horizon.rgb, light * frame.ground.rgb, exp(-squared_distance));
}
