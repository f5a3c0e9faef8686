// Colour of the sky in a direction: with s the sine of its elevation, 1 - exp(-6 s s / (s + 0.06)) of the way from the
// horizon to the zenith. It leaves the horizon without a crease, and a camera that sees only a low strip sees a gradient.
vec3 sky(vec3 direction) {
    float sine = max(dot(normalize(direction), frame.up.xyz), 0.0);
    return mix(frame.horizon.rgb, frame.zenith.rgb, 1.0 - exp(-6.0 * sine * sine / (sine + 0.06)));
}
