// Writes the id of a triangle. With MASK, only to the samples that the cut-out surface covers.
layout(location = 0) out uint id;

void main() {
    id = uint(current_triangle()) + 1u;
#ifdef MASK
    Material material = material_of(current_triangle());
    keep_covered_samples(fragment_alpha(material), material.diffuse.a);
#endif
}
