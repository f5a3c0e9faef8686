// Bit mask of the samples of a pixel that a cut-out surface covers: those where alpha, extrapolated from the pixel by
// its screen-space derivatives, reaches the cutoff. Integer render targets disable alpha to coverage, and contiguous
// samples match the shape better anyway. Where alpha changes fast, as on a leaf seen edge-on, the slope is clamped so
// that alpha 0 still covers no sample and alpha 1 all of them.
int covered_samples(float alpha, float cutoff) {
#if SAMPLES > 1
    vec2 slope = vec2(dFdx(alpha), dFdy(alpha));
    float most = 2.0 * min(cutoff, 1.0 - cutoff);
    slope *= min(1.0, most / max(abs(slope.x) + abs(slope.y), 1e-6));
    int kept = 0;
    for (int index = 0; index < SAMPLES; index++) {
        float there = alpha + dot(slope, SAMPLE_POSITIONS[index] - 0.5);
        if (there >= cutoff) kept |= 1 << index;
    }
    return kept;
#else
    return alpha >= cutoff ? 1 : 0;
#endif
}

// Keeps the samples that reach the cutoff.
void keep_covered_samples(float alpha, float cutoff) {
    int kept = covered_samples(alpha, cutoff);
    if (kept == 0) discard;
#if SAMPLES > 1
    gl_SampleMask[0] = kept;
#endif
}

// Keeps the samples that do not reach the cutoff.
void keep_uncovered_samples(float alpha, float cutoff) {
    int kept = (1 << SAMPLES) - 1 & ~covered_samples(alpha, cutoff);
    if (kept == 0) discard;
#if SAMPLES > 1
    gl_SampleMask[0] = kept;
#endif
}
