// Material of a triangle, by the triangle's index in the draw order. Twin: `PackedMaterial` in
// src/render/scene_buffers.rs.
//   materials           [materials][4]  RGBA32F: ambient color and array of the normal map; diffuse color and layer of
//                                       the normal map; specular color and exponent; array and layer of the color
//                                       texture, alpha, cutoff
//   triangle_materials  [triangles]     R32UI; not read if all triangles of the draw have one material
// Both are buffer textures, because a software rasterizer fetches eight texels at once, but storage words one by one.
struct Material {
    vec4 ambient;   // w: alpha
    vec4 diffuse;   // w: cutoff of a mask
    vec4 specular;  // w: exponent
    ivec4 images;   // array and layer of the color texture, array and layer of the normal map; -1 for none
};

layout(binding = 14) uniform samplerBuffer materials;
#ifdef MATERIAL_TABLE
layout(binding = 15) uniform usamplerBuffer triangle_materials;
#endif

Material material_of(int triangle) {
#ifdef MATERIAL_TABLE
    int first = MATERIAL_STRIDE * int(texelFetch(triangle_materials, triangle).x);
#else
    const int first = MATERIAL_STRIDE * SINGLE_MATERIAL;
#endif
    vec4 ambient = texelFetch(materials, first), diffuse = texelFetch(materials, first + 1);
    vec4 specular = texelFetch(materials, first + 2), cut_out = texelFetch(materials, first + 3);
    ivec4 images = ivec4(cut_out.xy, ambient.a, diffuse.a);
    return Material(vec4(ambient.rgb, cut_out.z), vec4(diffuse.rgb, cut_out.w), specular, images);
}
