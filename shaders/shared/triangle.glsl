// Color and alpha of a triangle at an image point.
#ifdef UVS
layout(binding = 19) uniform samplerBuffer uvs;
#endif
#ifdef NORMAL_MAPS
layout(binding = 20) uniform samplerBuffer tangents;
#endif

vec2 finite(vec2 slope) { return any(isnan(slope)) || any(isinf(slope)) ? vec2(0.0) : slope; }

vec4 triangle_seen(int number, vec2 image, vec2 texel) {
    ivec3 corners = ivec3(texelFetch(triangle_corners, number).xyz);
    ivec3 vertices = ivec3(texelFetch(triangle_vertices, number).xyz);
    mat3 world, clip, normal;
    for (int index = 0; index < 3; index++) {
        world[index] = texelFetch(positions, vertices[index]).xyz;
        vec4 there = to_clip(world[index]);
        clip[index] = vec3(there.xy - image * there.w, there.w);
        normal[index] = texelFetch(normals, corners[index]).xyz;
    }
    Shares share = shares(clip[0], clip[1], clip[2], texel);
    Material material = material_of(number);
    vec4 tint = vec4(1.0);
    vec3 unbumped = unit(normal * share.at), facing = unbumped;
#ifdef UVS
    mat3x2 uv;
    for (int index = 0; index < 3; index++) uv[index] = texelFetch(uvs, corners[index]).xy;
    vec2 place = uv * share.at, by_x = finite(uv * share.along_x), by_y = finite(uv * share.along_y);
#endif
#ifdef TEXTURES
    vec4 colour = colour_texel(material.images.xy, place, by_x, by_y);
    if (material.images.x >= 0) tint = colour;
#endif
#ifdef NORMAL_MAPS
    mat3x4 along_u;
    for (int index = 0; index < 3; index++) along_u[index] = texelFetch(tangents, corners[index]);
    vec3 bump = normal_texel(material.images.zw, place, by_x, by_y).xyz;
    if (material.images.z >= 0) facing = bumped(facing, along_u * share.at, bump);
#endif
    vec3 light = phong(material, tint.rgb, share.front ? facing : -facing, unbumped, world * share.at);
    return vec4(light, material.ambient.a * tint.a);
}
