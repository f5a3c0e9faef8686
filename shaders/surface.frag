// Phong (equation 3.12) with clamped dots and unshadowed ambient light:
//   C = skylight Ca + s_f sunlight ((n . v_l) Cd + (v_e' . v_l)^k Cs),  v_e' = 2 (v_e . n) n - v_e,
// v_l to the sun, v_e to the eye, s_f the share of the sun that arrives.
in vec3 world;
// Centroids: at the rim of a triangle the middle of the pixel may lie outside it, where images repeat and normals overshoot.
centroid in vec3 normal_world;
#ifdef UVS
centroid in vec2 uv_image;
#endif
#ifdef NORMAL_MAPS
centroid in vec4 tangent_world;
#endif
layout(location = 0) out vec4 colour;

vec3 unit(vec3 v) { return v * inversesqrt(max(dot(v, v), 1e-30)); }

vec3 surface_normal(ivec2 place) {
    vec3 normal = unit(normal_world);
#ifdef NORMAL_MAPS
    vec3 texel = (normal_texel(place, uv_image).xyz * 255.0 - 128.0) / 127.0;
    if (place.x >= 0 && dot(tangent_world.xyz, tangent_world.xyz) > 0.0) {
        vec3 tangent = unit(tangent_world.xyz - normal * dot(normal, tangent_world.xyz));
        vec3 bitangent = cross(normal, tangent) * (tangent_world.w < 0.0 ? -1.0 : 1.0);
        normal = unit(tangent * texel.x + bitangent * texel.y + normal * texel.z);
    }
#endif
    return gl_FrontFacing ? normal : -normal;
}

void main() {
    Material material = own_material();
    vec4 tint = vec4(1.0);
#ifdef TEXTURES
    vec4 texel = colour_texel(material.images.xy, uv_image);
    if (material.images.x >= 0) tint = texel;
#endif
    float alpha = 1.0;
#ifdef MASK
    alpha = covered(material.ambient.a * tint.a, material.diffuse.a);
#endif
#ifdef BLEND
    alpha = material.ambient.a * tint.a;
#endif
    vec3 normal = surface_normal(material.images.zw);
    vec3 to_sun = frame.to_sun.xyz;
    vec3 light = frame.skylight.rgb * material.ambient.rgb * tint.rgb;
    float facing = dot(normal, to_sun);
    if (facing > 0.0) {
        vec3 to_eye = unit(frame.eye.xyz - world);
        vec3 reflected = 2.0 * dot(to_eye, normal) * normal - to_eye;
        float gleam = dot(reflected, to_sun);
        float highlight = gleam > 0.0 ? pow(gleam, material.specular.a) : 0.0;
        vec3 answer = facing * material.diffuse.rgb * tint.rgb + highlight * material.specular.rgb;
        light += lit(world, unit(normal_world)) * frame.sunlight.rgb * answer;
    }
    colour = vec4(light, alpha);
}
