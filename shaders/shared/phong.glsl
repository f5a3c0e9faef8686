// Phong shading (equation 3.12) with clamped dot products and unshadowed ambient light:
//   C = skylight Ca + s_f sunlight ((n . v_l) Cd + (v_e' . v_l)^k Cs),  v_e' = 2 (v_e . n) n - v_e,
// with v_l to the sun, v_e to the eye, and s_f the share of the sun's light that arrives. In the thesis v_e points from
// the eye, so that v_e' points into the surface and the highlight lies on its far side. A texel multiplies Ca and Cd if
// the material has a color image (equation 3.14, whose printed s_tex is inverted): with white Ca and Cd it replaces
// them.
vec3 safe_normalize(vec3 v) { return v * inversesqrt(max(dot(v, v), 1e-30)); }

#ifdef NORMAL_MAPS
// Perturbs a unit normal by a texel of a normal map. Without a tangent the normal does not change.
vec3 apply_normal_map(vec3 normal, vec4 along_u, vec3 texel) {
    if (dot(along_u.xyz, along_u.xyz) <= 0.0) return normal;
    texel = (texel * 255.0 - 128.0) / 127.0;
    vec3 tangent = safe_normalize(along_u.xyz - normal * dot(normal, along_u.xyz));
    vec3 bitangent = cross(normal, tangent) * (along_u.w < 0.0 ? -1.0 : 1.0);
    return safe_normalize(tangent * texel.x + bitangent * texel.y + normal * texel.z);
}
#endif

// `geometric_normal` is the normal before normal mapping: the plane that the shadow lookup uses.
vec3 phong(Material material, vec3 tint, vec3 normal, vec3 geometric_normal, vec3 world) {
    vec3 to_sun = frame.to_sun.xyz;
    vec3 light = frame.skylight.rgb * material.ambient.rgb * tint;
    float facing = dot(normal, to_sun);
    if (facing > 0.0) {
        vec3 to_eye = safe_normalize(frame.eye.xyz - world);
        vec3 reflected = 2.0 * dot(to_eye, normal) * normal - to_eye;
        float gleam = dot(reflected, to_sun);
        float highlight = gleam > 0.0 ? pow(gleam, material.specular.a) : 0.0;
        vec3 answer = facing * material.diffuse.rgb * tint + highlight * material.specular.rgb;
        light += sun_visibility(world, geometric_normal) * frame.sunlight.rgb * answer;
    }
    return light;
}
