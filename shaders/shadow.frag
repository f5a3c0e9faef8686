// Discards cut-out texels and nearly transparent fragments, which cast no shadow (the thesis's t_alpha).
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
