// A translucent surface over the layers before it: the layer keeps the light of all of them, and in alpha the share of
// what lies behind that still comes through. Shaded like all else.
in vec3 world;
// Centroids: at the rim of a triangle the middle of the pixel may lie outside it, where images repeat and normals overshoot.
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
    // What reaches the threshold was drawn as opaque.
    cut_in(material.ambient.a * tint.a, material.diffuse.a);
#endif
    colour = vec4(phong(material, tint.rgb, normal, unbumped, world), material.ambient.a * tint.a);
}
