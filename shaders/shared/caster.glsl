// A fragment that is cut away, or too translucent, casts no shadow.
void cast_or_not(float alpha, float least) {
    if (alpha < least) discard;
}
