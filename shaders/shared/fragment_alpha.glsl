// Alpha of a fragment: alpha of the material times alpha of the texel.
#ifdef TEXTURES
// Centroid sampling: the center of a pixel at the edge of a triangle may lie outside of the triangle. Texture
// coordinates extrapolated to this center could be wrong.
centroid in vec2 image_uv;
#endif

float fragment_alpha(Material material) {
    float alpha = material.ambient.a;
#ifdef TEXTURES
    // Fetched on every path: implicit derivatives are undefined in divergent control flow.
    vec4 texel = color_texel(material.images.xy, image_uv);
    if (material.images.x >= 0) alpha *= texel.a;
#endif
    return alpha;
}
