// Bit mask of the samples of a pixel that a cut-out surface covers. A sample is covered if its alpha, extrapolated from
// the pixel center by screen-space derivatives, reaches the cutoff. Alpha to coverage is not available for integer
// render targets. Where alpha changes fast, as on a leaf seen edge-on, the slope is clamped, so that alpha 0 still
// covers no sample and alpha 1 covers all of them.
int covered_samples(float alpha, float cutoff) {
#if SAMPLES > 1
    vec2 slope = vec2(dFdx(alpha), dFdy(alpha));
    // A sample is at most half a pixel from the center in x and in y. So with the clamped slope, its alpha differs from
    // `alpha` by at most half of `max_slope`: by the cutoff or 1 - cutoff, whichever is less.
    float max_slope = 2.0 * min(cutoff, 1.0 - cutoff);
    slope *= min(1.0, max_slope / max(abs(slope.x) + abs(slope.y), 1e-6));
    int mask = 0;
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
        float sample_alpha = alpha + dot(slope, SAMPLE_POSITIONS[sample_index] - 0.5);
        if (sample_alpha >= cutoff) mask |= 1 << sample_index;
    }
    return mask;
#else
    return alpha >= cutoff ? 1 : 0;
#endif
}

// Restricts a fragment to the samples that reach the cutoff.
void keep_covered_samples(float alpha, float cutoff) {
    int mask = covered_samples(alpha, cutoff);
    if (mask == 0) discard;
#if SAMPLES > 1
    gl_SampleMask[0] = mask;
#endif
}

// Restricts a fragment to the samples that do not reach the cutoff.
void keep_uncovered_samples(float alpha, float cutoff) {
    const int all_samples = (1 << SAMPLES) - 1;
    int mask = all_samples & ~covered_samples(alpha, cutoff);
    if (mask == 0) discard;
#if SAMPLES > 1
    gl_SampleMask[0] = mask;
#endif
}
