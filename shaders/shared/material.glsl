// Material of a triangle, by the triangle's index in the draw order. Twin: `PackedMaterial` in
// src/render/layout/material.rs.
//   materials           [materials][MATERIAL_STRIDE]  RGBA32F, four texels:
//                         ambient color, texture array of the normal map
//                         diffuse color, layer of the normal map
//                         specular color, exponent
//                         texture array and layer of the color texture, alpha, cutoff
//   triangle_materials  [triangles]                   R32UI; not read if all triangles of the draw have one material
// Both are buffer textures, because a software rasterizer fetches eight texels at once, but reads storage buffers word
// by word.
struct Material {
    vec4 ambient;   // w: alpha
    vec4 diffuse;   // w: cutoff of a mask, or the alpha from which blended triangles are drawn as opaque
    vec4 specular;  // w: exponent
    ivec4 images;   // texture array and layer of the color texture, then of the normal map; -1 without texture
};

layout(binding = 14) uniform samplerBuffer materials;
#ifdef MATERIAL_TABLE
layout(binding = 15) uniform usamplerBuffer triangle_materials;
#endif

Material material_of(int triangle) {
#ifdef MATERIAL_TABLE
    int first_texel = MATERIAL_STRIDE * int(texelFetch(triangle_materials, triangle).x);
#else
    const int first_texel = MATERIAL_STRIDE * SINGLE_MATERIAL;
#endif
    vec4 ambient = texelFetch(materials, first_texel), diffuse = texelFetch(materials, first_texel + 1);
    vec4 specular = texelFetch(materials, first_texel + 2), texture_alpha = texelFetch(materials, first_texel + 3);
    ivec4 images = ivec4(texture_alpha.xy, ambient.a, diffuse.a);
    return Material(vec4(ambient.rgb, texture_alpha.z), vec4(diffuse.rgb, texture_alpha.w), specular, images);
}
