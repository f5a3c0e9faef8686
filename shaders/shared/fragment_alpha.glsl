// Alpha of a fragment: that of its material times that of its texel.
#ifdef TEXTURES
// Centroid sampling: at the edge of a triangle the pixel center may lie outside it, where texture coordinates wrap
// around.
centroid in vec2 uv_image;
#endif

float fragment_alpha(Material material) {
    float alpha = material.ambient.a;
#ifdef TEXTURES
    // Fetched on every path: implicit derivatives are undefined in divergent control flow.
    vec4 texel = color_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) alpha *= texel.a;
#endif
    return alpha;
}
