// Discards fragments that cast no shadow. Their alpha is below the cutoff of a cut-out material (MASK), or below the
// threshold `frame.shadow.z` of blended materials (t_alpha of the thesis).
void main() {
    Material material = material_of(current_triangle());
#ifdef MASK
    float min_alpha = material.diffuse.a;
#else
    float min_alpha = frame.shadow.z;
#endif
    if (fragment_alpha(material) < min_alpha) discard;
}
