// Tone curve from light to displayed values, 0 to 1 per channel; sources are given at `ToneMapping` in
// src/model/scene/post_processing.rs. `inverse_tone_map` is its inverse.
#if defined(REINHARD)
// In this form, infinite light is white.
vec3 tone_map(vec3 light) { return 1.0 - 1.0 / (1.0 + light); }

// The curve never reaches 1 exactly, but rounding does.
vec3 inverse_tone_map(vec3 shown) { return shown / max(1.0 - shown, vec3(1.0 / MAX_RADIANCE)); }
#elif defined(ACES)
// White from 7.3 on; the clamp keeps the squares finite.
vec3 tone_map(vec3 light) {
    light = min(light, vec3(MAX_RADIANCE));
    return min(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), vec3(1.0));
}

// The nonnegative root of (2.51 - 2.43 y) x x + (0.03 - 0.59 y) x - 0.14 y.
vec3 inverse_tone_map(vec3 shown) {
    vec3 a = 2.51 - 2.43 * shown, b = 0.03 - 0.59 * shown;
    return max((sqrt(b * b + 0.56 * a * shown) - b) / (2.0 * a), vec3(0.0));
}
#else
vec3 tone_map(vec3 light) { return min(light, vec3(1.0)); }

vec3 inverse_tone_map(vec3 shown) { return shown; }
#endif
