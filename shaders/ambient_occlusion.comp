// Ambient occlusion by horizon angles: Jimenez, Wu, Pesce and Jarabo, "Practical Real-Time Strategies for Accurate
// Indirect Occlusion", SIGGRAPH 2016 courses (GTAO). A slice is a plane through the view ray. The visible part of the
// hemisphere in a slice lies between two horizons, one on each side, and its cosine-weighted integral has a closed
// form. Each side samples STEPS surface points. A point above the horizon raises it, unless both of its neighbors are far
// behind it: then it is on a thin surface. A point at the distance d has the weight 1 - (d / R)^2. The arc between the old
// and the new horizon is occluded with the mean weight of the points at its ends. The visibility is the ratio of the
// integrals with and without occluders over SLICES slices.
//   surface           (in)   see ambient_surface.comp
//   noisy_visibility  (out)  of the same size  RG32F: visibility, 0 to 1; 1 / depth, 0 for the sky
// The directions and distances of the points differ within each square of AMBIENT_NOISE x AMBIENT_NOISE texels.
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(binding = 0) uniform usampler2D surface;
layout(rg32f, binding = 0) uniform writeonly image2D noisy_visibility;

const float PI = 3.14159265;
// Between two points of one surface, the depth changes by at most this multiple of their distance in the image plane.
const float MAX_SLOPE = 2.0;

// acos with an error of at most 7e-5 (Abramowitz and Stegun, 4.4.45).
float fast_acos(float x) {
    float y = abs(x);
    float angle = sqrt(max(1.0 - y, 0.0)) * (1.5707288 + y * (-0.2121144 + y * (0.0742610 - 0.0187293 * y)));
    return x < 0.0 ? PI - angle : angle;
}

// A slice of the hemisphere. Angles are measured from the view vector, and are positive towards the slice axis.
struct Slice {
    float normal_angle, normal_cosine, normal_sine;
};

// Cosine-weighted integral from the view vector to a horizon (equation 7 of the paper).
float visible_arc(Slice slice, float horizon, float cosine, float sine) {
    float double_cosine = (2.0 * cosine * cosine - 1.0) * slice.normal_cosine + 2.0 * cosine * sine * slice.normal_sine;
    return 0.25 * (slice.normal_cosine + 2.0 * horizon * slice.normal_sine - double_cosine);
}

// Occlusion by the ground, which is a plane. `height`: height above the ground as a fraction of the radius. `descent`:
// cosine between the normal and the direction down. The result is exact for surfaces that are upright or face the
// ground. Otherwise, its error is at most 0.015.
float ground_occlusion(float height, float descent) {
    float k = clamp(height, 1e-4, 1.0), k_squared = k * k;
    float facing = 1.0 - k_squared + 2.0 * k_squared * log(k);
    float upright = ((1.0 + 2.0 * k_squared) * fast_acos(k) - 3.0 * k * sqrt(1.0 - k_squared)) / PI;
    return max(upright + descent * (0.5 * facing + descent * (0.5 * facing - upright)), 0.0);
}

void main() {
    ivec2 texel = image_pixel(), size = imageSize(noisy_visibility);
    if (any(greaterThanEqual(texel, size))) return;
    uvec2 packed_surface = texelFetch(surface, texel, 0).xy;
    float signed_depth = uintBitsToFloat(packed_surface.x), depth = abs(signed_depth);
    float radius = frame.to_sun.w;
    vec2 extent = ambient_extent();
    // Side of a texel at the distance 1 along the view axis, in x and in y.
    vec2 texel_side = 2.0 * vec2(length(frame.world_from_ndc[0].xyz), length(frame.world_from_ndc[1].xyz)) / extent;
    vec2 reach = radius / (max(depth, 1e-30) * texel_side);
    reach *= min(MAX_REACH * extent.y / max(reach.y, 1e-30), 1.0);
    float visibility = 1.0;
    // Without a surface, or if the radius is less than a texel, nothing is occluded.
    if (depth > 0.0 && reach.y > 1.0) {
        mat3 rays = ambient_rays();
        vec3 direction = rays * vec3(texel, 1.0);
        vec3 to_eye = -normalize(direction), normal = decode_octahedral(unpackSnorm2x16(packed_surface.y));
        // Offset along the normal by the rounding error of f32, so that the surface does not occlude itself.
        vec3 point = depth * direction + (4e-6 * depth * length(direction)) * normal;
        vec3 right = normalize(frame.world_from_ndc[0].xyz), up = normalize(frame.world_from_ndc[1].xyz);
        ivec2 cell = texel & (AMBIENT_NOISE - 1);
        // Every texel of the square has a different rotation. Neighbors differ in rotation and shift.
        const int CELLS = AMBIENT_NOISE * AMBIENT_NOISE;
        float rotation = (float((cell.x + AMBIENT_NOISE * cell.y) * ROTATION_STRIDE % CELLS) + 0.5) / float(CELLS);
        float shift = (float((cell.x + cell.y) & (AMBIENT_NOISE - 1)) + 0.5) / float(AMBIENT_NOISE);
        float lost = 0.0, open = 0.0;
        for (int index = 0; index < SLICES; index++) {
            float angle = (float(index) + rotation) * (PI / float(SLICES));
            vec2 axis = vec2(cos(angle), sin(angle));
            vec3 world_axis = axis.x * right + axis.y * up;
            vec3 slice_axis = world_axis - to_eye * dot(world_axis, to_eye);
            vec3 slice_normal = safe_normalize(cross(world_axis, to_eye));
            vec3 projected_normal = normal - slice_normal * dot(normal, slice_normal);
            float projected_length = length(projected_normal);
            Slice slice;
            slice.normal_cosine = clamp(dot(projected_normal, to_eye) / max(projected_length, 1e-6), -1.0, 1.0);
            float lean = dot(slice_axis, projected_normal) < 0.0 ? -1.0 : 1.0;
            slice.normal_angle = lean * fast_acos(slice.normal_cosine);
            slice.normal_sine = lean * sqrt(1.0 - slice.normal_cosine * slice.normal_cosine);
            float lost_arc = 0.0;
            for (int side = 0; side < 2; side++) {
                float direction_sign = side == 0 ? -1.0 : 1.0;
                // Without occluders, the horizon is 90 degrees from the normal.
                float horizon_cosine = -direction_sign * slice.normal_sine;
                float horizon_weight = 0.0; // of the point at the horizon; 0 without one
                float horizon_arc = visible_arc(slice, slice.normal_angle + direction_sign * 0.5 * PI, horizon_cosine,
                    direction_sign * slice.normal_cosine);
                // Depths of the points: 0 for the sky and outside of the image. `rises`: MAX_SLOPE times the distance
                // from the texel in the image plane at its depth.
                ivec2 taps[STEPS];
                float depths[STEPS], rises[STEPS];
                for (int step = 0; step < STEPS; step++) {
                    float part = (float(step) + shift) / float(STEPS);
                    vec2 move = direction_sign * axis * max(reach * part * part, vec2(float(step) + 1.0));
                    ivec2 shift_texels = ivec2(round(move)), tap = texel + shift_texels;
                    taps[step] = clamp(tap, ivec2(0), size - 1);
                    depths[step] = tap == taps[step] ? uintBitsToFloat(texelFetch(surface, taps[step], 0).x) : 0.0;
                    rises[step] = MAX_SLOPE * depth * length(vec2(shift_texels) * texel_side);
                }
                float previous_bound = depth;
                for (int step = 0; step < STEPS; step++) {
                    float tap_depth = depths[step];
                    vec3 offset = tap_depth * (rays * vec3(taps[step], 1.0)) - point;
                    float squared_distance = max(dot(offset, offset), 1e-30);
                    float cosine = min(dot(offset, to_eye) * inversesqrt(squared_distance), 1.0);
                    float weight = 1.0 - squared_distance / (radius * radius);
                    // A point that is in front of both neighbors is on a thin surface, behind which light passes.
                    float distant = tap_depth == 0.0 ? 1e30 : abs(tap_depth);
                    bool is_connected = distant + rises[step] > previous_bound;
                    if (step + 1 < STEPS && depths[step + 1] != 0.0) {
                        is_connected = is_connected || abs(depths[step + 1]) - rises[step + 1] < distant - rises[step];
                    }
                    previous_bound = distant + rises[step];
                    // The sky occludes nothing. The ground is added below.
                    if (tap_depth > 0.0 && weight > 0.0 && is_connected && cosine > horizon_cosine) {
                        float sine = direction_sign * sqrt(max(1.0 - cosine * cosine, 0.0));
                        float arc = visible_arc(slice, direction_sign * fast_acos(cosine), cosine, sine);
                        float arc_weight = horizon_weight > 0.0 ? 0.5 * (horizon_weight + weight) : weight;
                        lost_arc += arc_weight * (horizon_arc - arc);
                        horizon_weight = weight;
                        horizon_cosine = cosine;
                        horizon_arc = arc;
                    }
                }
            }
            lost += projected_length * lost_arc;
            open += projected_length * (slice.normal_cosine + slice.normal_angle * slice.normal_sine);
        }
        // The slices are not uniform around the view ray, so the integral without occluders is not exactly 1.
        visibility = 1.0 - lost / max(open, 1e-6);
#ifdef HAS_GROUND
        if (signed_depth > 0.0 && frame.eye.w > 0.0) {
            float height = dot(point + frame.eye.xyz, frame.up.xyz) - frame.up.w;
            visibility *= 1.0 - ground_occlusion(height / radius, -dot(normal, frame.up.xyz));
        }
#endif
    }
    imageStore(noisy_visibility, texel, vec4(clamp(visibility, 0.0, 1.0), depth > 0.0 ? 1.0 / depth : 0.0, 0.0, 0.0));
}
