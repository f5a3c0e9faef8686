// The material of the triangle that this fragment belongs to. Twin: `PackedMaterial` in src/render/scene_buffers.rs.
struct Material {
    vec4 ambient;   // and alpha
    vec4 diffuse;   // and the cutoff of a mask
    vec4 specular;  // and the exponent
    ivec4 images;   // array and layer of the colour texture, array and layer of the normal map; -1 for none
};

#ifdef LOOK_UP
// Each triangle has its own. Buffer textures: a software rasteriser fetches eight of their texels at once, but storage
// words one by one.
layout(binding = 14) uniform samplerBuffer materials;
layout(binding = 15) uniform usamplerBuffer triangle_materials;
layout(location = 0) uniform int first_triangle;

Material own_material() {
    int first = STRIDE * int(texelFetch(triangle_materials, first_triangle + gl_PrimitiveID).x);
    ivec4 images = ivec4(texelFetch(materials, first + 3));
    return Material(texelFetch(materials, first), texelFetch(materials, first + 1), texelFetch(materials, first + 2), images);
}
#else
layout(std140, binding = 1) uniform MaterialBlock {
    vec4 ambient;
    vec4 diffuse;
    vec4 specular;
    vec4 images;
} drawn;

Material own_material() { return Material(drawn.ambient, drawn.diffuse, drawn.specular, ivec4(drawn.images)); }
#endif
