// Accumulates the samples of a pixel. The tone curve (a clamp if the look names none) is applied to each sample, so
// that the pixel is the mean of the displayed samples and one bright sample does not whiten an edge. The curve removes
// light above 1, so bloom takes its bright light from each sample before.
struct PixelAccumulator {
    vec3 shown;
    vec3 glow;
};

#ifdef BLOOM
// The part of the light above the threshold, as measured by the brightest channel, with unchanged hue.
vec3 bloom_part(vec3 light) {
    float most = max(light.r, max(light.g, light.b));
    return light * (max(most - BLOOM_THRESHOLD, 0.0) / max(most, 1e-6));
}
#endif

void accumulate_sample(inout PixelAccumulator sum, vec3 light, float count) {
#ifdef EXPOSURE
    light *= EXPOSURE;
#endif
    // A NaN fails the comparison and becomes black.
    bvec3 some = greaterThan(light, vec3(0.0));
#ifdef BLOOM
    // Clamped far above white, so that one sample does not overflow.
    light = mix(vec3(0.0), min(light, vec3(MAX_RADIANCE)), some);
    vec3 glow = bloom_part(light);
    sum.glow += count * glow;
    light -= BLOOM_STRENGTH * glow;
#endif
    sum.shown += count * mix(vec3(0.0), tone_map(light), some);
}
