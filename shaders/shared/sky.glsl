// Colour of the sky in a direction: from the horizon to the zenith with the square root of the sine of the elevation, so
// that a camera that sees only a low strip of the sky sees a gradient too.
vec3 sky(vec3 direction) {
    float sine = max(dot(normalize(direction), frame.up.xyz), 0.0);
    return mix(frame.horizon.rgb, frame.zenith.rgb, sqrt(sine));
}
