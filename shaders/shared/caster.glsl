// Discards fragments whose alpha is below the threshold: they cast no shadow.
void cast_or_not(float alpha, float least) {
    if (alpha < least) discard;
}
