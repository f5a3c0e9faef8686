// Phong shading (equation 3.12) with clamped dot products:
//   C = s_a ambient Ca + fill (n . v_e) Cd + s_f sunlight ((n . v_l) Cd + (v_e' . v_l)^k Cs),
//   v_e' = 2 (v_e . n) n - v_e,
// with v_l to the sun, v_e to the eye, s_a the ambient visibility, s_f the sun visibility, and the ambient, diffuse and
// specular colors Ca, Cd and Cs. In the thesis v_e points away from the eye, which would put the highlight on the far
// side of the surface. If the material has a color image, its texel multiplies Ca and Cd (equation 3.14, whose printed
// s_tex is inverted). Outdoors, the ambient light is the skylight and there is no fill light.
#ifdef NORMAL_MAPS
// Perturbs a unit normal by a texel of a normal map. `raw_tangent`: interpolated direction of u, with the sign of the
// bitangent in w. If it is 0, the normal does not change.
vec3 apply_normal_map(vec3 normal, vec4 raw_tangent, vec3 texel) {
    if (dot(raw_tangent.xyz, raw_tangent.xyz) <= 0.0) return normal;
    texel = (texel * 255.0 - 128.0) / 127.0;
    vec3 tangent = safe_normalize(raw_tangent.xyz - normal * dot(normal, raw_tangent.xyz));
    vec3 bitangent = cross(normal, tangent) * (raw_tangent.w < 0.0 ? -1.0 : 1.0);
    return safe_normalize(tangent * texel.x + bitangent * texel.y + normal * texel.z);
}
#endif

// Point and plane of a surface whose sun visibility is looked up. Normal maps do not change them.
struct ShadowReceiver {
    vec3 point;
    vec3 normal;
};

vec3 phong(Material material, vec3 tint, vec3 normal, vec3 world, ShadowReceiver receiver, float ambient_visibility) {
    vec3 to_sun = frame.to_sun.xyz;
    vec3 light = ambient_visibility * ambient_light(normal) * material.ambient.rgb * tint;
#ifdef STUDIO
    vec3 to_eye = safe_normalize(frame.eye.xyz - world);
    float facing = dot(normal, to_eye);
    if (facing > 0.0) light += facing * FILL * material.diffuse.rgb * tint;
#endif
    float cosine = dot(normal, to_sun);
    if (cosine > 0.0) {
#ifndef STUDIO
        vec3 to_eye = safe_normalize(frame.eye.xyz - world);
#endif
        vec3 reflected = 2.0 * dot(to_eye, normal) * normal - to_eye;
        float highlight_cosine = dot(reflected, to_sun);
        float highlight = highlight_cosine > 0.0 ? pow(highlight_cosine, material.specular.a) : 0.0;
        vec3 reflectance = cosine * material.diffuse.rgb * tint + highlight * material.specular.rgb;
        light += sun_visibility(receiver.point, receiver.normal) * frame.sunlight.rgb * reflectance;
    }
    return light;
}
