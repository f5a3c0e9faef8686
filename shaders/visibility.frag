// Writes the id of a triangle, for masked materials only to the samples that the cut-out surface covers.
#if defined(MASK) && defined(TEXTURES)
// Centroid sampling: at the edge of a triangle the pixel center may lie outside it, where texture coordinates wrap
// around.
centroid in vec2 uv_image;
#endif
layout(location = 0) out uint id;

void main() {
    id = uint(current_triangle()) + 1u;
#ifdef MASK
    Material material = material_of(current_triangle());
    float alpha = material.ambient.a;
#ifdef TEXTURES
    vec4 texel = color_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) alpha *= texel.a;
#endif
    keep_covered_samples(alpha, material.diffuse.a);
#endif
}
