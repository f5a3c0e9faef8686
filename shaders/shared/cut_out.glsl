// Which samples of a pixel a cut-out surface covers: those where alpha, continued from the pixel by its slope, reaches the
// cutoff. Integer targets switch alpha to coverage off, and samples that lie side by side cover more truly anyhow. Where
// alpha changes fast, as on a leaf seen edge on, the slope is bounded so that 0 still covers nothing and 1 everything.
int reached(float alpha, float cutoff) {
#if SAMPLES > 1
    vec2 slope = vec2(dFdx(alpha), dFdy(alpha));
    float most = 2.0 * min(cutoff, 1.0 - cutoff);
    slope *= min(1.0, most / max(abs(slope.x) + abs(slope.y), 1e-6));
    int kept = 0;
    for (int index = 0; index < SAMPLES; index++) {
        float there = alpha + dot(slope, SAMPLE_PLACES[index] - 0.5);
        if (there >= cutoff) kept |= 1 << index;
    }
    return kept;
#else
    return alpha >= cutoff ? 1 : 0;
#endif
}

// Keeps those samples alone.
void cut_out(float alpha, float cutoff) {
    int kept = reached(alpha, cutoff);
    if (kept == 0) discard;
#if SAMPLES > 1
    gl_SampleMask[0] = kept;
#endif
}

// Keeps the others.
void cut_in(float alpha, float cutoff) {
    int kept = (1 << SAMPLES) - 1 & ~reached(alpha, cutoff);
    if (kept == 0) discard;
#if SAMPLES > 1
    gl_SampleMask[0] = kept;
#endif
}
