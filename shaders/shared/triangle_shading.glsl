// Color and alpha of a triangle at an image point.
#ifdef UVS
layout(binding = 19) uniform samplerBuffer uvs;
#endif
#ifdef NORMAL_MAPS
layout(binding = 20) uniform samplerBuffer tangents;
#endif

vec2 finite_or_zero(vec2 slope) { return any(isnan(slope)) || any(isinf(slope)) ? vec2(0.0) : slope; }

vec4 shade_triangle(int number, vec2 image, vec2 texel) {
    ivec3 corners = ivec3(texelFetch(triangle_corners, number).xyz);
    ivec3 vertices = ivec3(texelFetch(triangle_vertices, number).xyz);
    mat3 world, clip, normal;
    for (int index = 0; index < 3; index++) {
        world[index] = texelFetch(positions, vertices[index]).xyz;
        vec4 there = to_clip(world[index]);
        clip[index] = vec3(there.xy - image * there.w, there.w);
        normal[index] = texelFetch(normals, corners[index]).xyz;
    }
    Barycentrics share = barycentrics(clip[0], clip[1], clip[2], texel);
    Material material = material_of(number);
    vec4 tint = vec4(1.0);
    vec3 geometric_normal = safe_normalize(normal * share.weights), facing = geometric_normal;
#ifdef UVS
    mat3x2 uv;
    for (int index = 0; index < 3; index++) uv[index] = texelFetch(uvs, corners[index]).xy;
    vec2 place = uv * share.weights, by_x = finite_or_zero(uv * share.ddx), by_y = finite_or_zero(uv * share.ddy);
#endif
#ifdef TEXTURES
    vec4 color = color_texel(material.images.xy, place, by_x, by_y);
    if (material.images.x >= 0) tint = color;
#endif
#ifdef NORMAL_MAPS
    mat3x4 along_u;
    for (int index = 0; index < 3; index++) along_u[index] = texelFetch(tangents, corners[index]);
    vec3 bump = normal_texel(material.images.zw, place, by_x, by_y).xyz;
    if (material.images.z >= 0) facing = apply_normal_map(facing, along_u * share.weights, bump);
#endif
    vec3 light = phong(material, tint.rgb, share.front ? facing : -facing, geometric_normal, world * share.weights);
    return vec4(light, material.ambient.a * tint.a);
}
