/**
 * GLSL sources of the ambient light and of the ambient occlusion, equivalent to the server's: see
 * shaders/shared/ambient_light.glsl, shaders/shared/ambient_visibility.glsl and shaders/ambient_*.comp.
 */

import { DECODE_OCTAHEDRAL, FETCH_VERTEX, PRECISION } from "./shader_parts";

/** Side in pixels of the square that one texel represents. Its center is the center of the lower left pixel. */
export const AMBIENT_SCALE = 2;
export const AMBIENT_CENTER = 0.5 / AMBIENT_SCALE;

/** Ambient light on a surface before occlusion, and the color of the fill light. Defines: STUDIO. */
export const AMBIENT_LIGHT = `
uniform vec3 skylight;
#ifdef STUDIO
// Sides +x, -x, +y, -y, +z and -z, weighted by the squared components of the normal.
uniform vec3 ambient_cube[6];
uniform vec3 fill;                   // light at the camera
vec3 ambient_light(vec3 normal) {
    vec3 weights = normal * normal;
    return weights.x * (normal.x < 0.0 ? ambient_cube[1] : ambient_cube[0])
        + weights.y * (normal.y < 0.0 ? ambient_cube[3] : ambient_cube[2])
        + weights.z * (normal.z < 0.0 ? ambient_cube[5] : ambient_cube[4]);
}
#else
vec3 ambient_light(vec3 normal) { return skylight; }
#endif
`;

/** Texels of the ambient occlusion, and planes in image space. */
const AMBIENT_TEXEL = `
const float SCALE = ${AMBIENT_SCALE.toFixed(1)}, CENTER = ${AMBIENT_CENTER};
uniform vec2 ambient_extent;         // size of the canvas in texels, which need not be an integer
uniform float ambient_radius;        // in scene units
vec2 ambient_ndc(ivec2 texel) { return 2.0 * (vec2(texel) + CENTER) / ambient_extent - 1.0; }

// Unit vector of a direction; shorter, and finite, for vectors of less than 1e-15.
vec3 safe_normalize(vec3 v) { return v * inversesqrt(max(dot(v, v), 1e-30)); }

// A plane as seen in the image: 1 / depth is linear in the image point, (n . ray) / (n . offset) for the unit normal n
// and the offset of a point of the plane from the eye.
struct AmbientPlane {
    vec3 slope;                      // times (ndc, 1): 1 / depth
    float sharpness;                 // 1 / tolerance of depths
};

// depth: distance of the point along the view axis.
AmbientPlane ambient_plane(vec3 normal, vec3 offset, float depth) {
    float plane_distance = dot(normal, offset);
    vec3 slope = (normal * mat3(world_from_ndc)) / (abs(plane_distance) > 1e-30 ? plane_distance : 1e-30);
    // The tolerance is 5 % of the radius, and more than the rounding errors of f32 depths.
    return AmbientPlane(slope, 1.0 / max(0.05 * ambient_radius, 1e-6 * depth));
}

// Weight of a texel in a mean over a plane: 1 if its depth is that of the plane, and almost 0 on other surfaces.
float ambient_weight(AmbientPlane plane, ivec2 texel, float texel_depth) {
    float depth = 1.0 / max(dot(plane.slope, vec3(ambient_ndc(texel), 1.0)), 1e-30);
    return clamp(1.5 - abs(texel_depth - depth) * plane.sharpness, 0.0, 1.0) + 1e-5;
}
`;

/**
 * `ambient_visibility_of`: the fraction of the ambient light that reaches a point, from its offset from the eye, the
 * unit normal of its face and its depth. It is interpolated between the four nearest texels. Texels on other planes
 * have almost no weight. Defines: AMBIENT_OCCLUSION.
 */
export const AMBIENT_VISIBILITY = `
#ifdef AMBIENT_OCCLUSION
${AMBIENT_TEXEL}
uniform sampler2D ambient_visibility; // visibility; depth, 0 for the sky
float ambient_visibility_of(vec3 offset, vec3 normal, float depth) {
    vec2 position = gl_FragCoord.xy / SCALE - CENTER;
    ivec2 last = textureSize(ambient_visibility, 0) - 1, base = ivec2(floor(position));
    vec2 fraction = position - vec2(base);
    AmbientPlane plane = ambient_plane(normal, offset, depth);
    float sum = 0.0, weight_sum = 0.0;
    for (int y = 0; y < 2; y++) {
        for (int x = 0; x < 2; x++) {
            ivec2 texel = clamp(base + ivec2(x, y), ivec2(0), last);
            vec2 tap = texelFetch(ambient_visibility, texel, 0).xy;
            float weight = ambient_weight(plane, texel, tap.y);
            weight *= (x == 0 ? 1.0 - fraction.x : fraction.x) * (y == 0 ? 1.0 - fraction.y : fraction.y) + 1e-3;
            sum += weight * tap.x;
            weight_sum += weight;
        }
    }
    return sum / max(weight_sum, 1e-9);
}
// Normal of a face from the derivatives of its points.
vec3 face_normal(vec3 dx, vec3 dy) { return safe_normalize(cross(safe_normalize(dx), safe_normalize(dy))); }
#endif
`;

/** Surfaces for the ambient occlusion: depth along the view axis as the bits of a float, and octahedral face normal. */
export const AMBIENT_SURFACE_VERTEX = `${PRECISION}
${FETCH_VERTEX}
in vec2 uv;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform vec3 eye;
out vec3 from_eye;
out vec2 texture_uv;
void main() {
    vec3 position = fetch_position().xyz;
    from_eye = position - eye;
    texture_uv = uv;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}
`;

/** Defines: MASK. */
export const AMBIENT_SURFACE_FRAGMENT = `${PRECISION}
in vec3 from_eye;
in vec2 texture_uv;
uniform sampler2D color_texture;
uniform float alpha;
uniform float cutoff;
out uvec2 surface;

vec2 encode_octahedral(vec3 n) {
    n /= abs(n.x) + abs(n.y) + abs(n.z);
    vec2 folded = (1.0 - abs(n.yx)) * vec2(n.x < 0.0 ? -1.0 : 1.0, n.y < 0.0 ? -1.0 : 1.0);
    return n.z < 0.0 ? folded : n.xy;
}

void main() {
    vec3 normal = cross(normalize(dFdx(from_eye)), normalize(dFdy(from_eye)));
#ifdef MASK
    if (alpha * texture(color_texture, texture_uv).a < cutoff) discard;
#endif
    if (dot(normal, from_eye) > 0.0) normal = -normal;
    // The comparison is false for NaN, which triangles without area may have.
    if (!(dot(normal, normal) > 0.0)) normal = -from_eye;
    surface = uvec2(floatBitsToUint(1.0 / gl_FragCoord.w), packSnorm2x16(encode_octahedral(normal)));
}
`;

/** Inputs of both texel passes. Defines: GROUND. */
const AMBIENT_SURFACE_LOOKUP = `
uniform usampler2D surface;
uniform mat4 world_from_ndc;
uniform vec3 eye;
uniform vec3 up;
uniform vec4 ground_center;          // w: height of the ground along the up axis
${AMBIENT_TEXEL}
// Side in texels of the square in which all directions differ: a power of two.
const int NOISE = 4;
vec3 view_ray(vec2 ndc) { return mat3(world_from_ndc) * vec3(ndc, 1.0); }
${DECODE_OCTAHEDRAL}

struct AmbientSurface {
    float depth;                     // 0 for the sky
    vec3 normal;
    bool is_ground;
};

AmbientSurface surface_at(ivec2 texel, vec3 direction) {
    uvec2 packed_surface = texelFetch(surface, texel, 0).xy;
    float depth = uintBitsToFloat(packed_surface.x);
#ifdef GROUND
    float descent = -dot(direction, up), height = dot(eye, up) - ground_center.w;
    if (depth == 0.0 && descent > 0.0 && height > 0.0) return AmbientSurface(height / descent, up, true);
#endif
    return AmbientSurface(depth, decode_octahedral(unpackSnorm2x16(packed_surface.y)), false);
}
`;

/**
 * Ambient occlusion by horizon angles: Jimenez, Wu, Pesce and Jarabo, "Practical Real-Time Strategies for Accurate
 * Indirect Occlusion", SIGGRAPH 2016 courses. shaders/ambient_occlusion.comp explains it. Writes the visibility and the
 * depth of each texel. Directions and distances differ within each square of NOISE x NOISE texels.
 * Defines: GROUND, SLICES, STEPS.
 */
export const AMBIENT_OCCLUSION_FRAGMENT = `${PRECISION}
out vec2 visibility_and_depth;
${AMBIENT_SURFACE_LOOKUP}
const float PI = 3.14159265;
// Odd, so that its multiples visit every texel of the square.
const int ROTATION_STRIDE = 7;
// The largest reach in the image, as a fraction of its height.
const float MAX_REACH = 0.35;
// Between two points of one surface, the depth changes by at most this multiple of their distance in the image plane.
const float MAX_SLOPE = 2.0;

// acos with an error of at most 7e-5 (Abramowitz and Stegun, 4.4.45).
float fast_acos(float x) {
    float y = abs(x);
    float angle = sqrt(max(1.0 - y, 0.0)) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 - 0.0187293 * y)));
    return x < 0.0 ? PI - angle : angle;
}

// A slice of the hemisphere. Angles are from the view vector, positive to the side of the axis.
struct Slice {
    vec2 axis;                       // in the image
    float normal_angle, normal_cosine, normal_sine;
};

// Cosine-weighted integral from the view vector to a horizon (equation 7 of the paper).
float visible_arc(Slice slice, float horizon, float cosine, float sine) {
    float double_cosine = (2.0 * cosine * cosine - 1.0) * slice.normal_cosine + 2.0 * cosine * sine * slice.normal_sine;
    return 0.25 * (slice.normal_cosine + 2.0 * horizon * slice.normal_sine - double_cosine);
}

// Occlusion by the ground, an exact plane, at this fraction of the radius above it. descent: cosine between the normal
// and the direction down. Exact for surfaces that face the ground or are upright, else within 0.015.
float ground_occlusion(float height, float descent) {
    float k = clamp(height, 1e-4, 1.0), k_squared = k * k;
    float facing = 1.0 - k_squared + 2.0 * k_squared * log(k);
    float upright = ((1.0 + 2.0 * k_squared) * fast_acos(k) - 3.0 * k * sqrt(1.0 - k_squared)) / PI;
    return max(upright + descent * (0.5 * facing + descent * (0.5 * facing - upright)), 0.0);
}

// The part of the integral of a slice that surface points on one side (1 or -1) of a point occlude.
// rise: MAX_SLOPE times the side of a texel at the depth of the point.
float lost_arc(Slice slice, float side, ivec2 texel, vec2 reach, float shift, vec3 point, vec3 to_eye, float own_depth,
    vec2 rise) {
    ivec2 size = textureSize(surface, 0);
    // Without occluders, the horizon is 90 degrees from the normal.
    float horizon_cosine = -side * slice.normal_sine, lost = 0.0;
    float horizon_weight = 0.0;      // of the point at the horizon; 0 without one
    float horizon_arc =
        visible_arc(slice, slice.normal_angle + side * 0.5 * PI, horizon_cosine, side * slice.normal_cosine);
    // Depths of the points: 0 for the sky and outside of the image.
    ivec2 taps[STEPS];
    float depths[STEPS], rises[STEPS];
    bool is_occluder[STEPS];
    for (int step = 0; step < STEPS; step++) {
        float part = (float(step) + shift) / float(STEPS);
        ivec2 move = ivec2(round(side * slice.axis * max(reach * part * part, vec2(float(step) + 1.0))));
        taps[step] = clamp(texel + move, ivec2(0), size - 1);
        AmbientSurface there = surface_at(taps[step], view_ray(ambient_ndc(taps[step])));
        depths[step] = texel + move == taps[step] ? there.depth : 0.0;
        is_occluder[step] = depths[step] > 0.0 && !there.is_ground;
        rises[step] = length(vec2(move) * rise);
    }
    float previous_bound = own_depth;
    for (int step = 0; step < STEPS; step++) {
        float depth = depths[step];
        vec3 offset = depth * view_ray(ambient_ndc(taps[step])) - point;
        float squared_distance = max(dot(offset, offset), 1e-30);
        float cosine = min(dot(offset, to_eye) * inversesqrt(squared_distance), 1.0);
        float weight = 1.0 - squared_distance / (ambient_radius * ambient_radius);
        // A point that is in front of both neighbors is on a thin surface, behind which light passes.
        float distant = depth == 0.0 ? 1e30 : depth;
        bool is_connected = distant + rises[step] > previous_bound;
        if (step + 1 < STEPS && depths[step + 1] > 0.0) {
            is_connected = is_connected || depths[step + 1] - rises[step + 1] < distant - rises[step];
        }
        previous_bound = distant + rises[step];
        // The sky and the ground occlude nothing.
        if (is_occluder[step] && weight > 0.0 && is_connected && cosine > horizon_cosine) {
            float sine = side * sqrt(max(1.0 - cosine * cosine, 0.0));
            float arc = visible_arc(slice, side * fast_acos(cosine), cosine, sine);
            lost += (horizon_weight > 0.0 ? 0.5 * (horizon_weight + weight) : weight) * (horizon_arc - arc);
            horizon_weight = weight;
            horizon_cosine = cosine;
            horizon_arc = arc;
        }
    }
    return lost;
}

float horizon_visibility(ivec2 texel, vec2 reach, vec3 point, vec3 normal, vec3 to_eye, float depth, vec2 rise) {
    vec3 right = normalize(world_from_ndc[0].xyz), image_up = normalize(world_from_ndc[1].xyz);
    ivec2 cell = texel & (NOISE - 1);
    // Every texel of the square has another rotation, and neighbors differ in their rotation and in their shift.
    const int CELLS = NOISE * NOISE;
    float rotation = (float((cell.x + NOISE * cell.y) * ROTATION_STRIDE % CELLS) + 0.5) / float(CELLS);
    float shift = (float((cell.x + cell.y) & (NOISE - 1)) + 0.5) / float(NOISE);
    float lost = 0.0, open = 0.0;
    for (int index = 0; index < SLICES; index++) {
        float angle = (float(index) + rotation) * (PI / float(SLICES));
        Slice slice;
        slice.axis = vec2(cos(angle), sin(angle));
        vec3 world_axis = slice.axis.x * right + slice.axis.y * image_up;
        vec3 slice_axis = world_axis - to_eye * dot(world_axis, to_eye);
        vec3 slice_normal = safe_normalize(cross(world_axis, to_eye));
        vec3 projected_normal = normal - slice_normal * dot(normal, slice_normal);
        float projected_length = length(projected_normal);
        slice.normal_cosine = clamp(dot(projected_normal, to_eye) / max(projected_length, 1e-6), -1.0, 1.0);
        slice.normal_angle = fast_acos(slice.normal_cosine) * (dot(slice_axis, projected_normal) < 0.0 ? -1.0 : 1.0);
        slice.normal_sine = sin(slice.normal_angle);
        lost += projected_length * (lost_arc(slice, -1.0, texel, reach, shift, point, to_eye, depth, rise)
            + lost_arc(slice, 1.0, texel, reach, shift, point, to_eye, depth, rise));
        open += projected_length * (slice.normal_cosine + slice.normal_angle * slice.normal_sine);
    }
    // The slices are not uniform around the view ray, so that the open integral is not exactly 1.
    return 1.0 - lost / max(open, 1e-6);
}

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 direction = view_ray(ambient_ndc(texel));
    AmbientSurface here = surface_at(texel, direction);
    // Side of a texel at the distance 1 along the view axis, in x and in y.
    vec2 texel_side = 2.0 * vec2(length(world_from_ndc[0].xyz), length(world_from_ndc[1].xyz)) / ambient_extent;
    vec2 reach = ambient_radius / (max(here.depth, 1e-30) * texel_side);
    reach *= min(MAX_REACH * ambient_extent.y / max(reach.y, 1e-30), 1.0);
    float visibility = 1.0;
    // Without a surface, or if the radius is less than a texel, nothing is occluded.
    if (here.depth > 0.0 && reach.y > 1.0) {
        // Moved along the normal by the rounding of f32, so that the surface does not occlude itself.
        vec3 point = here.depth * direction + (4e-6 * here.depth) * here.normal;
        visibility = horizon_visibility(texel, reach, point, here.normal, -normalize(direction), here.depth,
            (MAX_SLOPE * here.depth) * texel_side);
#ifdef GROUND
        if (!here.is_ground && dot(eye, up) > ground_center.w) {
            float height = dot(point + eye, up) - ground_center.w;
            visibility *= 1.0 - ground_occlusion(height / ambient_radius, -dot(here.normal, up));
        }
#endif
    }
    visibility_and_depth = vec2(clamp(visibility, 0.0, 1.0), here.depth);
}
`;

/**
 * Filters the noise of the ambient occlusion: averages a square with sides of NOISE texels. The square is centered at
 * the texel, so the texels along its border have half the weight. Defines: GROUND.
 */
export const AMBIENT_FILTER_FRAGMENT = `${PRECISION}
uniform sampler2D noisy_visibility;  // see AMBIENT_OCCLUSION_FRAGMENT
out vec2 visibility_and_depth;
${AMBIENT_SURFACE_LOOKUP}
void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy), last = textureSize(surface, 0) - 1;
    vec3 direction = view_ray(ambient_ndc(texel));
    AmbientSurface here = surface_at(texel, direction);
    float visibility = 1.0;
    if (here.depth > 0.0) {
        AmbientPlane plane = ambient_plane(here.normal, here.depth * direction, here.depth);
        float sum = 0.0, weight_sum = 0.0;
        for (int y = -NOISE / 2; y <= NOISE / 2; y++) {
            for (int x = -NOISE / 2; x <= NOISE / 2; x++) {
                ivec2 tap_texel = clamp(texel + ivec2(x, y), ivec2(0), last);
                vec2 tap = texelFetch(noisy_visibility, tap_texel, 0).xy;
                float weight = ambient_weight(plane, tap_texel, tap.y);
                weight *= (abs(x) == NOISE / 2 ? 0.5 : 1.0) * (abs(y) == NOISE / 2 ? 0.5 : 1.0);
                sum += weight * tap.x;
                weight_sum += weight;
            }
        }
        visibility = sum / weight_sum;
    }
    visibility_and_depth = vec2(visibility, here.depth);
}
`;
