// Tone curve from linear light to displayed values, 0 to 1 per channel, and its inverse. `ToneMapping` in
// src/model/scene/post_processing.rs cites the sources.
#if defined(REINHARD)
// x / (1 + x), written so that infinite light gives 1.
vec3 tone_map(vec3 light) { return 1.0 - 1.0 / (1.0 + light); }

// Rounding can give exactly 1, so the divisor has a lower bound.
vec3 inverse_tone_map(vec3 displayed) { return displayed / max(1.0 - displayed, vec3(1.0 / MAX_RADIANCE)); }
#elif defined(ACES)
// The result is 1 for light above 7.3. The clamp of the light keeps the squares finite.
vec3 tone_map(vec3 light) {
    light = min(light, vec3(MAX_RADIANCE));
    return min(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), vec3(1.0));
}

// The nonnegative root of (2.51 - 2.43 y) x x + (0.03 - 0.59 y) x - 0.14 y.
vec3 inverse_tone_map(vec3 displayed) {
    vec3 a = 2.51 - 2.43 * displayed, b = 0.03 - 0.59 * displayed;
    return max((sqrt(b * b + 0.56 * a * displayed) - b) / (2.0 * a), vec3(0.0));
}
#else
vec3 tone_map(vec3 light) { return min(light, vec3(1.0)); }

vec3 inverse_tone_map(vec3 displayed) { return displayed; }
#endif
