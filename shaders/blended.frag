// Blends a translucent surface over the layers drawn before: the layer accumulates their light, and in alpha the
// transmittance. Shading is the same as for opaque surfaces.
in vec3 world;
// Centroid sampling: at the edge of a triangle the pixel center may lie outside it, where texture coordinates wrap
// around and normals overshoot.
centroid in vec3 normal_world;
#ifdef UVS
centroid in vec2 uv_image;
#endif
#ifdef NORMAL_MAPS
centroid in vec4 tangent_world;
#endif
layout(location = 0) out vec4 colour;

void main() {
    Material material = material_of(own_triangle());
    vec4 tint = vec4(1.0);
#ifdef TEXTURES
    vec4 texel = colour_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) tint = texel;
#endif
    vec3 unbumped = unit(normal_world), normal = unbumped;
#ifdef NORMAL_MAPS
    vec3 bump = normal_texel(material.images.zw, uv_image).xyz;
    if (material.images.z >= 0) normal = bumped(normal, tangent_world, bump);
#endif
    normal = gl_FrontFacing ? normal : -normal;
#ifdef OPAQUE_PARTS
    // Samples that reach the threshold were drawn as opaque.
    cut_in(material.ambient.a * tint.a, material.diffuse.a);
#endif
    colour = vec4(phong(material, tint.rgb, normal, unbumped, world), material.ambient.a * tint.a);
}
