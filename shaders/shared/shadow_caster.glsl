// Discards a fragment whose alpha is below the threshold: it casts no shadow.
void discard_below(float alpha, float min_alpha) {
    if (alpha < min_alpha) discard;
}
