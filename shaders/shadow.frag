// Discards fragments that cast no shadow: below the cutoff of a cut-out material, or nearly transparent (t_alpha of the
// thesis).
#ifdef UVS
in vec2 uv_image;
#endif

void main() {
    Material material = material_of(current_triangle());
    float alpha = material.ambient.a;
#ifdef TEXTURES
    vec4 texel = color_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) alpha *= texel.a;
#endif
#ifdef MASK
    discard_below(alpha, material.diffuse.a);
#else
    discard_below(alpha, frame.shadow.z);
#endif
}
