/** GLSL sources. Positions are in scene units relative to the render origin; colors are linear. */

import { AMBIENT_LIGHT, AMBIENT_VISIBILITY } from "./ambient_shaders";
import { DECODE_OCTAHEDRAL, FETCH_VERTEX, PRECISION, TABLE_LOOKUP } from "./shader_parts";
import { WIDTH } from "./texture_tables";

/** A triangle that covers the viewport. */
export const FULLSCREEN_VERTEX = `${PRECISION}
out vec2 ndc;
void main() {
    ndc = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(ndc, 0.0, 1.0);
}
`;

/**
 * Computes x = T (x0 + U q), one fragment per vertex of the scene. The fourth component is the value of the color map.
 * Defines: I16 (U is stored in integers), MODE_SHAPE (the value is the norm of one column of U).
 */
export const DEFORM_FRAGMENT = `${PRECISION}
uniform usampler2D vertex_domains;   // domain of each vertex; NO_DOMAIN in the padding
uniform sampler2D rest_positions;    // x0 of each vertex of each shape
uniform isampler2D domain_table;     // see DomainTable
uniform sampler2D transforms;        // rows of T; flags
uniform sampler2D coordinates;       // q, four modes per texel, times the scales of the packed U
#ifdef MODE_SHAPE
uniform sampler2D shown_coordinates; // the same, with q = 1 for the shown mode and 0 for all others
#endif
#ifdef I16
uniform isampler2D modes;
#else
uniform sampler2D modes;
#endif
out vec4 position;
${TABLE_LOOKUP}
const uint NO_DOMAIN = 0xffffffffu;

vec4 modes_texel(int index) { return vec4(texelFetch(modes, table_texel(index), 0)); }

vec3 displacement(sampler2D q, ivec4 entry, int shape_vertex) {
    vec3 sum = vec3(0.0);
    int texel = entry.y + 3 * entry.z * shape_vertex;
    for (int group = 0; group < entry.z; group++, texel += 3) {
        vec4 factors = texelFetch(q, table_texel(entry.w + group), 0);
        sum += vec3(dot(modes_texel(texel), factors), dot(modes_texel(texel + 1), factors), dot(modes_texel(texel + 2), factors));
    }
    return sum;
}

void main() {
    uint domain = texelFetch(vertex_domains, ivec2(gl_FragCoord.xy), 0).x;
    position = vec4(0.0);
    if (domain == NO_DOMAIN) return;
    ivec4 entry = texelFetch(domain_table, table_texel(int(domain)), 0);
    vec4 rows[3];
    for (int row = 0; row < 3; row++) rows[row] = texelFetch(transforms, table_texel(4 * int(domain) + row), 0);
    // All triangles of a hidden domain have no area.
    if (texelFetch(transforms, table_texel(4 * int(domain) + 3), 0).x == 0.0) {
        position = vec4(rows[0].w, rows[1].w, rows[2].w, 0.0);
        return;
    }
    int shape_vertex = int(gl_FragCoord.y) * ${WIDTH} + int(gl_FragCoord.x) - entry.x;
    vec3 u = displacement(coordinates, entry, shape_vertex);
    vec4 local = vec4(texelFetch(rest_positions, table_texel(shape_vertex), 0).xyz + u, 1.0);
#ifdef MODE_SHAPE
    float value = length(displacement(shown_coordinates, entry, shape_vertex));
#else
    float value = length(vec3(dot(rows[0].xyz, u), dot(rows[1].xyz, u), dot(rows[2].xyz, u)));
#endif
    position = vec4(dot(rows[0], local), dot(rows[1], local), dot(rows[2], local), value);
}
`;

/** Vertices of surfaces. */
export const SURFACE_VERTEX = `${PRECISION}
${FETCH_VERTEX}
in vec2 normal;                      // octahedral
in vec2 uv;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
out vec3 world;
out vec3 world_normal;
out vec2 texture_uv;
out float map_value;
flat out float highlight;

${DECODE_OCTAHEDRAL}
void main() {
    vec4 position = fetch_position();
    int row = 4 * int(vertex.y);
    vec3 a = texelFetch(transforms, table_texel(row), 0).xyz, b = texelFetch(transforms, table_texel(row + 1), 0).xyz;
    vec3 c = texelFetch(transforms, table_texel(row + 2), 0).xyz, n = decode_octahedral(normal);
    // The inverse transpose of the linear part, times its determinant.
    vec3 cofactors[3] = vec3[3](cross(b, c), cross(c, a), cross(a, b));
    float mirror = dot(a, cofactors[0]) < 0.0 ? -1.0 : 1.0;
    world_normal = mirror * vec3(dot(cofactors[0], n), dot(cofactors[1], n), dot(cofactors[2], n));
    world = position.xyz;
    texture_uv = uv;
    map_value = position.w;
    highlight = texelFetch(transforms, table_texel(row + 3), 0).y;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position.xyz, 1.0);
}
`;

const SRGB = `
vec3 encode_srgb(vec3 linear) {
    vec3 curve = 1.055 * pow(max(linear, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055;
    return mix(curve, 12.92 * linear, vec3(lessThanEqual(linear, vec3(0.0031308))));
}
`;

const TONE = `
uniform float exposure;
uniform int tone;                    // 0: none, 1: Reinhard, 2: ACES
vec3 displayed(vec3 light) {
    light = min(light * exposure, vec3(65504.0));
    if (tone == 1) light = light / (1.0 + light);
    if (tone == 2) light = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14);
    return min(light, vec3(1.0));
}
`;

/** From light to the color of a pixel. With LINEAR_OUTPUT, light is written, and `Transparency` makes the colors. */
const PIXEL_COLOR = `
${TONE}
${SRGB}
#ifdef LINEAR_OUTPUT
vec3 apply_tone_curve(vec3 light) { return min(light, vec3(65504.0)); }
vec3 encode_pixel(vec3 light) { return light; }
#else
vec3 apply_tone_curve(vec3 light) { return displayed(light); }
vec3 encode_pixel(vec3 light) { return encode_srgb(light); }
#endif
`;

const SHADOW_LOOKUP = `
#ifdef SHADOWS
uniform sampler2DShadow shadow_map;
uniform mat4 shadow_from_world;
uniform float shadow_texel;          // side of a texel in scene units
uniform float shadow_bias;           // in units of the map's depth
uniform vec3 to_sun;
// Part of the sun that is visible: the mean of nine bilinear comparisons, or one on the CPU (SINGLE_LOOKUP), at a point that is moved along the normal, so
// that a surface does not shadow itself.
float sun_visibility(vec3 world, vec3 normal) {
    float cosine = clamp(dot(normal, to_sun), 0.0, 1.0);
    vec3 moved = world + normal * shadow_texel * (0.6 + 2.4 * sqrt(1.0 - cosine * cosine));
    vec3 place = (shadow_from_world * vec4(moved, 1.0)).xyz;
    if (any(lessThan(place.xy, vec2(0.0))) || any(greaterThan(place.xy, vec2(1.0)))) return 1.0;
    // The ground lies behind the far plane of the map.
    float depth = clamp(place.z - shadow_bias, 0.0, 1.0);
#ifdef SINGLE_LOOKUP
    return texture(shadow_map, vec3(place.xy, depth));
#else
    float texel = 1.0 / float(textureSize(shadow_map, 0).x), sum = 0.0;
    for (int y = -1; y <= 1; y++) {
        for (int x = -1; x <= 1; x++) sum += texture(shadow_map, vec3(place.xy + texel * vec2(x, y), depth));
    }
    return sum / 9.0;
#endif
}
#else
uniform vec3 to_sun;
float sun_visibility(vec3 world, vec3 normal) { return 1.0; }
#endif
`;

/**
 * Phong shading with the formula of MaterialDescription, or a color map. Blended surfaces have no ambient occlusion.
 * Defines: SHADOWS, STUDIO, AMBIENT_OCCLUSION, COLOR_TEXTURE, NORMAL_TEXTURE, MASK, COLOR_MAP, LINEAR_OUTPUT, and BLEND
 * for a layer of blended surfaces (see `Transparency`), whose color is premultiplied.
 */
export const SURFACE_FRAGMENT = `${PRECISION}
in vec3 world;
in vec3 world_normal;
in vec2 texture_uv;
in float map_value;
flat in float highlight;
uniform mat4 world_from_ndc;         // from (x, y, 1) to the direction of a view ray
uniform vec3 eye;
uniform vec3 sunlight;
uniform vec3 ambient;
uniform vec3 diffuse;
uniform vec3 specular;
uniform float shininess;
uniform float alpha;
uniform float cutoff;
uniform sampler2D color_texture;
uniform sampler2D normal_texture;
uniform float map_scale;             // 1 / value at the bright end of the color map
out vec4 color;
#ifdef BLEND
uniform int layer;                   // 0: the nearest layer
uniform sampler2D opaque_depth;
uniform sampler2D nearer_depth;      // of the previous layer
// Whether an opaque surface hides the fragment, or an earlier layer has drawn it.
bool is_hidden() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    return gl_FragCoord.z >= texelFetch(opaque_depth, pixel, 0).x ||
        layer > 0 && gl_FragCoord.z <= texelFetch(nearer_depth, pixel, 0).x;
}
#endif
${SHADOW_LOOKUP}
${AMBIENT_LIGHT}
${AMBIENT_VISIBILITY}
${PIXEL_COLOR}
#ifdef COLOR_MAP
// viridis: Matt Zucker's polynomial (shadertoy.com/view/WlfXRN, CC0), as the server's color maps.
vec3 viridis(float t) {
    const vec3 c[7] = vec3[7](vec3(0.27772733, 0.0054073445, 0.3340998), vec3(0.10509304, 1.4046135, 1.3845902),
        vec3(-0.33086183, 0.21484756, 0.09509516), vec3(-4.6342305, -5.799101, -19.332441), vec3(6.22827, 14.179933, 56.69055),
        vec3(4.776385, -13.745145, -65.35303), vec3(-5.435456, 4.6458526, 26.312435));
    vec3 value = vec3(0.0);
    for (int i = 6; i >= 0; i--) value = value * t + c[i];
    return clamp(value, 0.0, 1.0);
}
vec3 decode_srgb(vec3 encoded) {
    return mix(pow((encoded + 0.055) / 1.055, vec3(2.4)), encoded / 12.92, vec3(lessThanEqual(encoded, vec3(0.04045))));
}
#endif

#ifdef NORMAL_TEXTURE
// The tangent frame follows from the derivatives of position and texture coordinates.
vec3 mapped_normal(vec3 n) {
    vec3 dx = dFdx(world), dy = dFdy(world);
    vec2 du = dFdx(texture_uv), dv = dFdy(texture_uv);
    vec3 across = cross(dy, n), along = cross(n, dx);
    vec3 tangent = across * du.x + along * dv.x, bitangent = across * du.y + along * dv.y;
    float size = max(dot(tangent, tangent), dot(bitangent, bitangent));
    if (!(size > 0.0)) return n;
    vec3 texel = (texture(normal_texture, texture_uv).xyz * 255.0 - 128.0) / 127.0;
    // v increases downwards in the image, and y of the map points up. Both tangents are reversed on back faces.
    float side = gl_FrontFacing ? 1.0 : -1.0;
    return normalize((tangent * texel.x - bitangent * texel.y) * (side * inversesqrt(size)) + n * texel.z);
}
#endif

void main() {
    float sky_visibility = 1.0;
#if defined(AMBIENT_OCCLUSION) && !defined(BLEND)
    sky_visibility = ambient_visibility_of(world - eye, face_normal(dFdx(world), dFdy(world)), 1.0 / gl_FragCoord.w);
#endif
    vec4 tint = vec4(1.0);
#ifdef COLOR_TEXTURE
    tint = texture(color_texture, texture_uv);
#endif
    float opacity = alpha * tint.a;
#ifdef MASK
    if (opacity < cutoff) discard;
#endif
#ifdef BLEND
    if (!(opacity > 0.0) || is_hidden()) discard;
    opacity = min(opacity, 1.0);
#endif
    vec3 surface_normal = normalize(world_normal);
    vec3 shading_normal = surface_normal;
#ifdef NORMAL_TEXTURE
    shading_normal = mapped_normal(surface_normal);
#endif
    if (!gl_FrontFacing) shading_normal = -shading_normal;
    vec3 to_eye = normalize(eye - world);
#ifdef COLOR_MAP
    float facing = 0.62 + 0.38 * abs(dot(shading_normal, to_eye));
    vec3 light = facing * decode_srgb(viridis(clamp(map_value * map_scale, 0.0, 1.0)));
    opacity = 1.0;
#else
    vec3 light = sky_visibility * ambient_light(shading_normal) * ambient * tint.rgb;
#ifdef STUDIO
    light += max(dot(shading_normal, to_eye), 0.0) * fill * diffuse * tint.rgb;
#endif
    float cosine = dot(shading_normal, to_sun);
    if (cosine > 0.0) {
        float reflected = dot(2.0 * dot(to_eye, shading_normal) * shading_normal - to_eye, to_sun);
        float shine = reflected > 0.0 ? pow(reflected, shininess) : 0.0;
        vec3 shadow_normal = gl_FrontFacing ? surface_normal : -surface_normal;
        light += sun_visibility(world, shadow_normal) * sunlight * (cosine * diffuse * tint.rgb + shine * specular);
    }
    light = apply_tone_curve(light);
#endif
    light = mix(light, vec3(1.0, 0.55, 0.1), 0.45 * highlight);
#ifndef BLEND
    opacity = 1.0;
#endif
    color = vec4(opacity * encode_pixel(light), opacity);
}
`;

/**
 * Sky and ground behind all surfaces, as the server draws them.
 * Defines: SHADOWS, STUDIO, AMBIENT_OCCLUSION, GROUND, COLOR_MAP, LINEAR_OUTPUT.
 */
export const BACKGROUND_FRAGMENT = `${PRECISION}
in vec2 ndc;
uniform mat4 world_from_ndc;         // from (x, y, 1) to the direction of a view ray
uniform vec3 eye;
uniform vec3 up;
uniform vec3 zenith;
uniform vec3 horizon;
uniform vec3 sunlight;
uniform vec4 ground;                 // color; w: fade length D: the weight at distance d is exp(-(d / D)^2)
uniform vec4 ground_center;          // w: height along the up axis
out vec4 color;
${SHADOW_LOOKUP}
${AMBIENT_LIGHT}
${AMBIENT_VISIBILITY}
${PIXEL_COLOR}
void main() {
    vec3 direction = mat3(world_from_ndc) * vec3(ndc, 1.0);
    float sine = max(dot(normalize(direction), up), 0.0);
    vec3 light = mix(horizon, zenith, 1.0 - exp(-6.0 * sine * sine / (sine + 0.06)));
#ifdef GROUND
    float descent = -dot(direction, up), height = dot(eye, up) - ground_center.w;
    if (descent > 0.0 && height > 0.0) {
        float depth = height / descent;
        vec3 world = eye + depth * direction;
        vec3 offset = world - ground_center.xyz;
        offset -= dot(offset, up) * up;
        float weight = exp(-min(dot(offset, offset) / (ground.w * ground.w), 80.0));
        vec3 ambient = ambient_light(up);
#ifdef AMBIENT_OCCLUSION
        ambient *= ambient_visibility_of(depth * direction, up, depth);
#endif
        vec3 ground_light = ambient + sun_visibility(world, up) * max(dot(up, to_sun), 0.0) * sunlight;
        light = mix(horizon, ground_light * ground.rgb, weight);
    }
#endif
#ifdef COLOR_MAP
    // Blended color maps have no tone curve.
    light = displayed(light);
#else
    light = apply_tone_curve(light);
#endif
    color = vec4(encode_pixel(light), 1.0);
}
`;

/** The background of color maps. Defines: LINEAR_OUTPUT. */
export const PLAIN_FRAGMENT = `${PRECISION}
uniform vec3 plain;
out vec4 color;
${PIXEL_COLOR}
void main() { color = vec4(encode_pixel(plain), 1.0); }
`;

/** Copies a texture of the same size. */
export const COPY_FRAGMENT = `${PRECISION}
uniform sampler2D source;
out vec4 color;
void main() { color = texelFetch(source, ivec2(gl_FragCoord.xy), 0); }
`;

/** Blended layers (premultiplied) over opaque surfaces: one sample of a pixel after the tone curve, times its weight. */
export const BLEND_FRAGMENT = `${PRECISION}
uniform sampler2D opaque;
uniform sampler2D layers;
uniform float weight;
out vec4 color;
${TONE}
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 front = texelFetch(layers, pixel, 0);
    color = vec4(weight * displayed(front.rgb + (1.0 - front.a) * texelFetch(opaque, pixel, 0).rgb), 1.0);
}
`;

/** From linear light to the canvas. */
export const ENCODE_FRAGMENT = `${PRECISION}
uniform sampler2D source;
out vec4 color;
${SRGB}
void main() { color = vec4(encode_srgb(texelFetch(source, ivec2(gl_FragCoord.xy), 0).rgb), 1.0); }
`;

/** Depth in the shadow map. Defines: CUT_OUT (fragments below the cutoff cast no shadow). */
export const SHADOW_VERTEX = `${PRECISION}
${FETCH_VERTEX}
in vec2 uv;
uniform mat4 clip_from_world;
out vec2 texture_uv;
void main() {
    texture_uv = uv;
    gl_Position = clip_from_world * vec4(fetch_position().xyz, 1.0);
}
`;

export const SHADOW_FRAGMENT = `${PRECISION}
in vec2 texture_uv;
uniform sampler2D color_texture;
uniform float alpha;
uniform float cutoff;
out vec4 color;
void main() {
#ifdef CUT_OUT
    if (alpha * texture(color_texture, texture_uv).a < cutoff) discard;
#endif
    color = vec4(1.0);
}
`;

/** Index of the domain plus 1; 0 where there is no surface. Defines: MASK. */
export const DOMAIN_VERTEX = `${PRECISION}
${FETCH_VERTEX}
in vec2 uv;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
out vec2 texture_uv;
flat out uint domain;
void main() {
    texture_uv = uv;
    domain = vertex.y;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(fetch_position().xyz, 1.0);
}
`;

export const DOMAIN_FRAGMENT = `${PRECISION}
in vec2 texture_uv;
flat in uint domain;
uniform sampler2D color_texture;
uniform float alpha;
uniform float cutoff;
out uvec4 id;
void main() {
#ifdef MASK
    if (alpha * texture(color_texture, texture_uv).a < cutoff) discard;
#endif
    id = uvec4(domain + 1u, 0u, 0u, 1u);
}
`;

/** Lines along mesh edges. They are moved towards the eye, so that they are in front of their surface. */
export const EDGE_VERTEX = `${PRECISION}
${FETCH_VERTEX}
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
void main() {
    vec4 position = modelViewMatrix * vec4(fetch_position().xyz, 1.0);
    gl_Position = projectionMatrix * vec4(0.9985 * position.xyz, 1.0);
}
`;

/** The light of the server's lines. */
export const EDGE_FRAGMENT = `${PRECISION}
out vec4 color;
void main() { color = vec4(vec3(0.02), 0.85); }
`;
