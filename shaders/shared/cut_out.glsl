// The share of a pixel that a cut-out surface covers. With several samples that share becomes coverage, the edge
// sharpened to one pixel's width; with one sample it is all or nothing.
float covered(float alpha, float cutoff) {
#ifdef MULTISAMPLED
    alpha = (alpha - cutoff) / max(fwidth(alpha), 1e-4) + 0.5;
    if (!(alpha > 0.0)) discard;
    return min(alpha, 1.0);
#else
    if (alpha < cutoff) discard;
    return 1.0;
#endif
}
