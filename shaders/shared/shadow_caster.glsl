// Discards fragments whose alpha is below the threshold: they cast no shadow.
void discard_below(float alpha, float least) {
    if (alpha < least) discard;
}
