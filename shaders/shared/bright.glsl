// The light of a pixel that glows: what its brightest channel has above the threshold, in its own hue.
vec3 bright(vec3 light) {
    float most = max(light.r, max(light.g, light.b));
    return light * (max(most - THRESHOLD, 0.0) / max(most, 1e-6));
}
