// What a sample gives to its pixel, and with which weight. A NaN fails the comparison and is black.
// Without glow each sample goes through the curve (a clamp, where none is named) by itself: the pixel is then the mean of
// what the screen would show of each, and one bright sample does not whiten an edge. Glow needs the light above 1, so that
// its samples stay light, and a bright one counts by its inverse instead (Karis 2013, "Tone mapping"); where none is above
// 1 that is the mean.
vec4 resolved(vec3 light) {
#ifdef EXPOSURE
    light *= EXPOSURE;
#endif
#ifdef BLOOM
    // A cap far above white: one pixel must not overflow, nor whiten a picture alone.
    light = mix(vec3(0.0), min(light, vec3(1024.0)), greaterThan(light, vec3(0.0)));
    float weight = 1.0 / max(1.0, max(light.r, max(light.g, light.b)));
    return vec4(weight * light, weight);
#else
    return vec4(mix(vec3(0.0), toned(light), greaterThan(light, vec3(0.0))), 1.0);
#endif
}
