// The material of a triangle, by its number in the index buffer. Twin: `PackedMaterial` in src/render/scene_buffers.rs.
//   materials           [materials][STRIDE]  RGBA32F, fetched and never filtered: ambient with the array of the normal map,
//                                            diffuse with its layer, specular with the exponent; and all that a cut-out asks
//                                            for: array and layer of the colour texture, alpha, cutoff
//   triangle_materials  [triangles]          R32UI; not read where all these triangles have one
// Buffer textures: a software rasteriser fetches eight of their texels at once, but storage words one by one.
struct Material {
    vec4 ambient;   // and alpha
    vec4 diffuse;   // and the cutoff of a mask
    vec4 specular;  // and the exponent
    ivec4 images;   // array and layer of the colour texture, array and layer of the normal map; -1 for none
};

layout(binding = 14) uniform samplerBuffer materials;
#ifdef LOOK_UP
layout(binding = 15) uniform usamplerBuffer triangle_materials;
#endif

Material material_of(int number) {
#ifdef LOOK_UP
    int first = STRIDE * int(texelFetch(triangle_materials, number).x);
#else
    const int first = STRIDE * ONLY_MATERIAL;
#endif
    vec4 ambient = texelFetch(materials, first), diffuse = texelFetch(materials, first + 1);
    vec4 specular = texelFetch(materials, first + 2), cut = texelFetch(materials, first + 3);
    ivec4 images = ivec4(cut.xy, ambient.a, diffuse.a);
    return Material(vec4(ambient.rgb, cut.z), vec4(diffuse.rgb, cut.w), specular, images);
}
