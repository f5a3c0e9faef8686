// Discards cut-out texels and nearly transparent fragments, which cast no shadow (the thesis's t_alpha).
#ifdef UVS
in vec2 uv_image;
#endif

void main() {
    Material material = material_of(own_triangle());
    float alpha = material.ambient.a;
#ifdef TEXTURES
    vec4 texel = colour_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) alpha *= texel.a;
#endif
#ifdef MASK
    cast_or_not(alpha, material.diffuse.a);
#else
    cast_or_not(alpha, frame.shadow.z);
#endif
}
