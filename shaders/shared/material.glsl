// The material of the triangle that this fragment belongs to. Twin: `PackedMaterial` in src/render/scene_buffers.rs.
struct Material {
    vec4 ambient;   // and alpha
    vec4 diffuse;   // and the cutoff of a mask
    vec4 specular;  // and the exponent
    ivec4 images;   // array and layer of the colour texture, array and layer of the normal map; -1 for none
};

layout(std430, binding = 2) readonly buffer Materials { Material materials[]; };

#ifdef MATERIALS
layout(std430, binding = 1) readonly buffer TriangleMaterials { uint triangle_materials[]; };
layout(location = 0) uniform uint first_triangle;
Material own_material() { return materials[triangle_materials[first_triangle + uint(gl_PrimitiveID)]]; }
#else
Material own_material() { return materials[ONLY_MATERIAL]; }
#endif
