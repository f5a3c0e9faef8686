// Accumulates the samples of a pixel. The tone curve (a clamp if the scene has none) is applied to each sample, so that
// one bright sample does not whiten an edge. The curve compresses bright light, so bloom light is extracted first.
struct PixelAccumulator {
    vec3 color;  // sum of the samples after the tone curve
    vec3 bloom;  // sum of the samples' light above the bloom threshold
};

#ifdef BLOOM
// The light above the threshold, measured by the brightest channel. The hue does not change.
vec3 extract_bloom(vec3 light) {
    float max_channel = max(light.r, max(light.g, light.b));
    return light * (max(max_channel - BLOOM_THRESHOLD, 0.0) / max(max_channel, 1e-6));
}
#endif

// Adds `count` samples that have the same light.
void accumulate_sample(inout PixelAccumulator sum, vec3 light, float count) {
#ifdef EXPOSURE
    light *= EXPOSURE;
#endif
    // NaN fails the comparison and becomes 0.
    bvec3 is_positive = greaterThan(light, vec3(0.0));
#ifdef BLOOM
    // Clamped far above white, so that one sample does not overflow.
    light = mix(vec3(0.0), min(light, vec3(MAX_RADIANCE)), is_positive);
    vec3 bloom = extract_bloom(light);
    sum.bloom += count * bloom;
    light -= BLOOM_STRENGTH * bloom;
#endif
    sum.color += count * mix(vec3(0.0), tone_map(light), is_positive);
}
