// Blends a translucent surface over the surfaces drawn before it. The render target accumulates light in rgb and
// transmittance in alpha. Shading is the same as for opaque surfaces.
in vec3 world;
// Centroid sampling: the center of a pixel at the edge of a triangle may lie outside of the triangle. Attributes
// extrapolated to this center could be wrong.
centroid in vec3 normal_world;
#ifdef UVS
centroid in vec2 image_uv;
#endif
#ifdef NORMAL_MAPS
centroid in vec4 tangent_world;
#endif
layout(location = 0) out vec4 color;

void main() {
    Material material = material_of(current_triangle());
    vec4 tint = vec4(1.0);
#ifdef TEXTURES
    vec4 texel = color_texel(material.images.xy, image_uv);
    if (material.images.x >= 0) tint = texel;
#endif
    vec3 geometric_normal = safe_normalize(normal_world), normal = geometric_normal;
#ifdef NORMAL_MAPS
    vec3 normal_map_texel = normal_texel(material.images.zw, image_uv).xyz;
    if (material.images.z >= 0) normal = apply_normal_map(normal, tangent_world, normal_map_texel);
#endif
    normal = gl_FrontFacing ? normal : -normal;
#ifdef OPAQUE_PARTS
    // Samples whose alpha reaches the threshold `diffuse.a` were already drawn as opaque.
    keep_uncovered_samples(material.ambient.a * tint.a, material.diffuse.a);
#endif
    color = vec4(phong(material, tint.rgb, normal, world, ShadowReceiver(world, geometric_normal), 1.0), material.ambient.a * tint.a);
}
