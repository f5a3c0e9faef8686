// `shade_triangle`: color and alpha of a triangle at an image point.
#ifdef UVS
layout(binding = 19) uniform samplerBuffer uvs;
#endif
#ifdef NORMAL_MAPS
layout(binding = 20) uniform samplerBuffer tangents;
#endif

vec2 finite_or_zero(vec2 slope) { return any(isnan(slope)) || any(isinf(slope)) ? vec2(0.0) : slope; }

vec4 shade_triangle(int triangle_index, vec2 ndc, vec2 pixel_size) {
    Triangle triangle = fetch_triangle(triangle_index, ndc);
    Barycentrics bary = compute_barycentrics(triangle.clip[0], triangle.clip[1], triangle.clip[2], pixel_size);
    Material material = material_of(triangle_index);
    vec4 tint = vec4(1.0);
    vec3 geometric_normal = safe_normalize(triangle.normal * bary.weights), shading_normal = geometric_normal;
#ifdef UVS
    mat3x2 corner_uvs;
    for (int corner = 0; corner < 3; corner++) corner_uvs[corner] = texelFetch(uvs, triangle.corners[corner]).xy;
    vec2 uv = corner_uvs * bary.weights;
    vec2 uv_ddx = finite_or_zero(corner_uvs * bary.ddx), uv_ddy = finite_or_zero(corner_uvs * bary.ddy);
#endif
#ifdef TEXTURES
    vec4 texel = color_texel(material.images.xy, uv, uv_ddx, uv_ddy);
    if (material.images.x >= 0) tint = texel;
#endif
#ifdef NORMAL_MAPS
    mat3x4 corner_tangents;
    for (int corner = 0; corner < 3; corner++) corner_tangents[corner] = texelFetch(tangents, triangle.corners[corner]);
    vec3 normal_map_texel = normal_texel(material.images.zw, uv, uv_ddx, uv_ddy).xyz;
    if (material.images.z >= 0) shading_normal = apply_normal_map(shading_normal, corner_tangents * bary.weights, normal_map_texel);
#endif
    shading_normal = bary.is_front_facing ? shading_normal : -shading_normal;
    vec3 light = phong(material, tint.rgb, shading_normal, geometric_normal, triangle.world * bary.weights);
#ifdef MESH_EDGES
    light = mix(light, frame.edges.rgb, edge_coverage(triangle, triangle_index, pixel_size));
#endif
    return vec4(light, material.ambient.a * tint.a);
}
