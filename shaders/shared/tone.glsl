// The curve from light to what the screen shows, 0 to 1 in each channel: `Tone` in src/scene/post.rs says whose they are.
vec3 toned(vec3 light) {
#if defined(REINHARD)
    // So written, infinite light is white.
    return 1.0 - 1.0 / (1.0 + light);
#elif defined(ACES)
    // The curve is white from 7.3 on; a cap keeps its squares finite.
    light = min(light, vec3(1024.0));
    return min(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), vec3(1.0));
#else
    return min(light, vec3(1.0));
#endif
}
