// Which triangle a sample sees. What is cut away discards before the id is written.
#if defined(MASK) && defined(TEXTURES)
// Centroids: at the rim of a triangle the middle of the pixel may lie outside it, where images repeat.
centroid in vec2 uv_image;
#endif
layout(location = 0) out uint id;

void main() {
    id = uint(own_triangle()) + 1u;
#ifdef MASK
    Material material = material_of(own_triangle());
    float alpha = material.ambient.a;
#ifdef TEXTURES
    vec4 texel = colour_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) alpha *= texel.a;
#endif
    cut_out(alpha, material.diffuse.a);
#endif
}
