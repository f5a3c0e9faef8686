// Color of the sky in a direction. With s the sine of the elevation, the weight of the zenith's color is
// 1 - exp(-6 s s / (s + 0.06)). The gradient is smooth at the horizon, and visible even in a low strip of sky.
vec3 sky(vec3 direction) {
    float sine = max(dot(normalize(direction), frame.up.xyz), 0.0);
    return mix(frame.horizon.rgb, frame.zenith.rgb, 1.0 - exp(-6.0 * sine * sine / (sine + 0.06)));
}
