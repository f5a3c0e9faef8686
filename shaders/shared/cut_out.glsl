// The share of a pixel that a cut-out surface covers. With several samples that share becomes coverage, the edge
// sharpened to one pixel's width; with one sample it is all or nothing. Where alpha changes faster than that, as on a
// leaf seen edge on, the width is bounded so that 0 still covers nothing and 1 everything.
float covered(float alpha, float cutoff) {
#ifdef MULTISAMPLED
    float width = min(fwidth(alpha), 2.0 * min(cutoff, 1.0 - cutoff));
    alpha = (alpha - cutoff) / max(width, 1e-4) + 0.5;
    if (!(alpha > 0.0)) discard;
    return min(alpha, 1.0);
#else
    if (alpha < cutoff) discard;
    return 1.0;
#endif
}
