// What samples give to their pixel. Each goes through the tone curve by itself (a clamp, where none is named), so that the
// pixel is the mean of what the screen would show of each, and one bright sample does not whiten an edge. Light above 1 is
// gone then: what glows is taken of each sample before.
struct Gathered {
    vec3 shown;
    vec3 glow;
};

#ifdef BLOOM
// What the brightest channel has above the threshold, in its own hue.
vec3 glowing(vec3 light) {
    float most = max(light.r, max(light.g, light.b));
    return light * (max(most - THRESHOLD, 0.0) / max(most, 1e-6));
}
#endif

void gather(inout Gathered sum, vec3 light, float count) {
#ifdef EXPOSURE
    light *= EXPOSURE;
#endif
    // A NaN fails the comparison and is black.
    bvec3 some = greaterThan(light, vec3(0.0));
#ifdef BLOOM
    // Far above white, so that one sample does not overflow.
    light = mix(vec3(0.0), min(light, vec3(MOST_LIGHT)), some);
    vec3 glow = glowing(light);
    sum.glow += count * glow;
    light -= STRENGTH * glow;
#endif
    sum.shown += count * mix(vec3(0.0), toned(light), some);
}
