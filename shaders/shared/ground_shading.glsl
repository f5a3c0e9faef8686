// Color of the ground: Lambert shading with shadow, fading into the horizon with distance.
vec3 shade_ground(vec3 world) {
    float facing = max(dot(frame.up.xyz, frame.to_sun.xyz), 0.0);
    vec3 light = frame.skylight.rgb + sun_visibility(world, frame.up.xyz) * facing * frame.sunlight.rgb;
    vec3 out_there = world - frame.ground_center.xyz;
    float share = dot(out_there, out_there) / (frame.ground.a * frame.ground.a);
    return mix(frame.horizon.rgb, light * frame.ground.rgb, exp(-share));
}
