// A triangle at a place of the picture, fetched from the scene's buffers: perspective-correct shares of its corners with
// their analytic slopes, and the colour and alpha there.
layout(binding = 13) uniform samplerBuffer positions;
layout(binding = 16) uniform samplerBuffer normals;
layout(binding = 17) uniform usamplerBuffer triangle_corners;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;
#ifdef UVS
layout(binding = 19) uniform samplerBuffer uvs;
#endif
#ifdef NORMAL_MAPS
layout(binding = 20) uniform samplerBuffer tangents;
#endif

// Shares of the three corners; their slopes along x and y of the picture, per pixel; and whether the front is seen.
struct Shares {
    vec3 at;
    vec3 along_x;
    vec3 along_y;
    bool front;
};

// With c_i = (x, y, w) of the corners on the screen, seen from the place, corner i has the share (c_j x c_k).z of their sum:
// homogeneous, so that corners behind the camera need no clipping. Taking the place off first keeps the digits that tell
// small triangles apart.
Shares shares(vec3 a, vec3 b, vec3 c, vec2 texel) {
    float scale = 1.0 / max(max(abs(a.z), abs(b.z)), max(abs(c.z), 1e-30));
    a *= scale, b *= scale, c *= scale;
    mat3 edges = mat3(cross(b, c), cross(c, a), cross(a, b));
    vec3 inside = vec3(edges[0].z, edges[1].z, edges[2].z);
    float sum = inside.x + inside.y + inside.z;
    Shares found;
    found.front = sum > 0.0;
    // The place lies inside but for rounding. A triangle without area has no sum: any share is right.
    found.at = clamp(inside / sum, 0.0, 1.0);
    float whole = found.at.x + found.at.y + found.at.z;
    found.at = whole > 0.5 ? found.at / whole : vec3(1.0 / 3.0);
    vec3 by_x = texel.x * vec3(edges[0].x, edges[1].x, edges[2].x);
    vec3 by_y = texel.y * vec3(edges[0].y, edges[1].y, edges[2].y);
    found.along_x = (by_x - found.at * (by_x.x + by_x.y + by_x.z)) / sum;
    found.along_y = (by_y - found.at * (by_y.x + by_y.y + by_y.z)) / sum;
    return found;
}

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
    vec3 facing = unit(normal * share.at);
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
    vec3 light = phong(material, tint.rgb, share.front ? facing : -facing, world * share.at);
    return vec4(light, material.ambient.a * tint.a);
}
