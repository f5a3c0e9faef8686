// `shade_triangle`: color and alpha of a triangle at an image point.
#ifdef UVS
layout(binding = 19) uniform samplerBuffer uvs;
#endif
#ifdef NORMAL_MAPS
layout(binding = 20) uniform samplerBuffer tangents;
#endif

vec2 finite_or_zero(vec2 slope) { return any(isnan(slope)) || any(isinf(slope)) ? vec2(0.0) : slope; }

// Unit normal of the plane of a triangle; 0 if its area is 0.
vec3 face_normal(Triangle triangle) {
    vec3 edge = safe_normalize(triangle.world[1] - triangle.world[0]);
    return safe_normalize(cross(edge, safe_normalize(triangle.world[2] - triangle.world[0])));
}

// The receiver of shadows at a point of a triangle. `normal` is the interpolated normal. `facing` is 1 if the front
// side is visible, else -1.
//
// On a triangle that faces the sun, it is the triangle itself: no part of it is in front of its plane. The interpolated
// normals of a coarse mesh have other planes, in which the triangle would shade itself.
//
// The interpolated normals describe a smooth surface. The sun lights a part of it that lies on triangles which face
// away from the sun. These triangles are in their own shadow, so that dark triangles would show where the light ends
// (the shadow terminator). Their receiver is therefore the smooth surface: the point is moved out of the tangent planes
// of the corners (J. Hanika, "Hacking the Shadow Terminator", Ray Tracing Gems II, 2021). The offset is 0 where all
// corners have the normal of the triangle.
ShadowReceiver shadow_receiver(Triangle triangle, vec3 weights, vec3 world, vec3 normal, float facing) {
#ifdef SHADOWS
    // Cosine of the angle between the sun and the triangle's normal above which the triangle faces the sun.
    const float FACING_COSINE = 0.25;
    vec3 face = face_normal(triangle);
    face *= dot(face, normal) < 0.0 ? -1.0 : 1.0;
    float smoothness = clamp(1.0 - facing * dot(face, frame.to_sun.xyz) / FACING_COSINE, 0.0, 1.0);
    vec3 offset = vec3(0.0);
    for (int corner = 0; corner < 3; corner++) {
        vec3 outside = facing * safe_normalize(triangle.normal[corner]);
        offset -= weights[corner] * min(dot(world - triangle.world[corner], outside), 0.0) * outside;
    }
    return ShadowReceiver(world + smoothness * offset, mix(face, normal, smoothness));
#else
    return ShadowReceiver(world, normal);
#endif
}

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
    float facing = bary.is_front_facing ? 1.0 : -1.0;
    shading_normal *= facing;
    vec3 world = triangle.world * bary.weights;
    ShadowReceiver receiver = shadow_receiver(triangle, bary.weights, world, geometric_normal, facing);
    float ambient_visibility = 1.0;
#ifdef AMBIENT_OCCLUSION
    ambient_visibility = ambient_visibility_of(world, face_normal(triangle), ndc);
#endif
    vec3 light = phong(material, tint.rgb, shading_normal, world, receiver, ambient_visibility);
#ifdef MESH_EDGES
    light = mix(light, frame.edges.rgb, edge_coverage(triangle, triangle_index, pixel_size));
#endif
    return vec4(light, material.ambient.a * tint.a);
}
