// Selects the triangles that the rasterizer must process: all except those that certainly cover no sample. Each bound
// is widened by the rounding errors between a vertex and its position on the device's subpixel grid, so that culling
// does not change the image. A triangle that the rasterizer may have to clip is culled only if it lies entirely outside
// one clip plane. The shader has four variants:
//   (none)         tests triangles for the camera
//   CULL_PREVIOUS  selects the triangles that were visible in the last frame, without a test
//   CULL_OCCLUDED  tests triangles for the camera, and against the depth pyramid of those that CULL_PREVIOUS selected
//   CULL_SHADOW    tests triangles for the shadow map
layout(local_size_x = WORKGROUP_SIZE) in;
layout(location = 0) uniform int size_packed; // width in the lower 16 bits, height in the upper 16
layout(binding = 13) uniform samplerBuffer positions;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;

// Classes of triangles, in the order of the counters.
const uint VISIBLE = 0u;
const uint OUTSIDE = 1u;
const uint BACK_FACING = 2u;
const uint NO_SAMPLE = 3u;
const uint OCCLUDED = 4u;
const uint CLASS_COUNT = 5u;

#ifndef CULL_PREVIOUS
// Numbers of triangles by class: of the camera, then of the shadow map. FIRST_COUNTER is 0 or CLASS_COUNT.
layout(std430, binding = 2) buffer CullCounters { uint cull_counters[2u * CLASS_COUNT]; };
#endif
#if defined(CULL_PREVIOUS) || defined(CULL_OCCLUDED)
layout(std430, binding = 3) buffer PreviouslyVisible { uint previously_visible[]; };
#endif

shared uint mask_words[MASK_WORDS]; // bits of the block's visible triangles
shared uint class_counts[CLASS_COUNT];

#ifndef CULL_PREVIOUS
// Bound on the difference of two evaluations of a matrix-vector product, relative to the sum of the terms' magnitudes.
// Each evaluation has four products and three sums, and each of these 7 operations rounds by at most 2^-24 of the sum
// of the magnitudes. Two evaluations have 14 roundings: less than 16 x 2^-24 = 2^-20.
const float ROUNDING = 1.0 / 1048576.0;
// Relative error of a float after four roundings: 2^-22.
const float FLOAT_ERROR = 1.0 / 4194304.0;
// Above this magnitude of the terms, one evaluation may overflow and another may not.
const float LARGE = 1e30;

struct ClipVertex {
    vec4 clip;
    vec4 error_bound; // bound on the difference to the rasterizer's clip position
};

#ifdef CULL_SHADOW
#ifdef CASCADES
layout(location = 1) uniform int layer;
#endif
ClipVertex project_vertex(vec3 world) {
    mat4 m = frame.shadow_from_world;
    vec3 position = (m * vec4(world, 1.0)).xyz;
    vec3 magnitude = (abs(m[0]) * abs(world.x) + abs(m[1]) * abs(world.y) + abs(m[2]) * abs(world.z) + abs(m[3])).xyz;
#ifdef CASCADES
    position.xy = to_cascade(position.xy, layer);
    magnitude.xy = magnitude.xy * abs(cascades.scale_offsets[layer].xy) + abs(cascades.scale_offsets[layer].zw);
#endif
    vec4 clip = vec4(2.0 * position.xy - 1.0, 1.0 - position.z, 1.0);
    return ClipVertex(clip, vec4(ROUNDING * (vec3(2.0, 2.0, 1.0) * magnitude + 1.0), 0.0));
}
#else
ClipVertex project_vertex(vec3 world) {
    mat4 m = frame.clip_from_world;
    vec4 magnitude = abs(m[0]) * abs(world.x) + abs(m[1]) * abs(world.y) + abs(m[2]) * abs(world.z) + abs(m[3]);
    return ClipVertex(m * vec4(world, 1.0), ROUNDING * magnitude);
}
#endif

// A vertex that is not finite is placed behind the far plane, as `to_clip` does for the vertex shaders.
ClipVertex clip_vertex(vec3 world) {
    bool is_not_finite = any(isnan(world)) || any(isinf(world));
    if (is_not_finite) return ClipVertex(vec4(0.0, 0.0, -2.0, 1.0), vec4(0.0));
    return project_vertex(world);
}

#ifdef CULL_OCCLUDED
layout(std430, binding = 4) readonly buffer DepthPyramid { float depths[]; };

// Whether all pixels of a rectangle have drawn surfaces nearer than `depth`. Reads the finest level of the depth
// pyramid in which the rectangle spans at most 4 x 4 texels. `size`: width and height of the image.
bool is_occluded(uvec2 min_pixel, uvec2 max_pixel, uvec2 size, float depth) {
    uint level = 0u, level_offset = 0u;
    while (level < MAX_LEVEL && any(greaterThan((max_pixel >> level) - (min_pixel >> level), uvec2(3u)))) {
        level_offset += size.x * size.y;
        size = size + 1u >> 1;
        level++;
    }
    min_pixel >>= level;
    max_pixel >>= level;
    if (any(greaterThan(max_pixel - min_pixel, uvec2(3u)))) return false;
    for (uint y = min_pixel.y; y <= max_pixel.y; y++) {
        for (uint x = min_pixel.x; x <= max_pixel.x; x++) {
            if (!(depths[level_offset + y * size.x + x] > depth)) return false;
        }
    }
    return true;
}
#endif

// Class of a triangle whose corners are all inside the clip planes. `position` is in pixels, `depth` from 1 (near) to 0
// (far).
uint classify_unclipped(ClipVertex corners[3], bool is_single_sided) {
    vec2 size = vec2(size_packed & 0xFFFF, size_packed >> 16 & 0xFFFF), position[3];
    float nearest = 0.0, depth[3], depth_error = 0.0, pixel_error = 0.0;
    for (int corner = 0; corner < 3; corner++) {
        vec4 clip = corners[corner].clip, error_bound = corners[corner].error_bound;
        vec3 ndc = clip.xyz / clip.w;
        // Bound on the error of the quotient, plus its own rounding.
        vec3 ndc_error = (error_bound.xyz + abs(ndc) * error_bound.w) / (clip.w - error_bound.w) + FLOAT_ERROR * abs(ndc);
        position[corner] = (0.5 * ndc.xy + 0.5) * size;
        depth[corner] = ndc.z;
        vec2 corner_error = 0.5 * ndc_error.xy * size;
        pixel_error = max(pixel_error, max(corner_error.x, corner_error.y));
        depth_error = max(depth_error, ndc_error.z);
        nearest = max(nearest, depth[corner]);
    }
    pixel_error += max(size.x, size.y) * FLOAT_ERROR + groups.subpixel_step.x;
    vec2 min_position = min(position[0], min(position[1], position[2])) - pixel_error;
    vec2 max_position = max(position[0], max(position[1], position[2])) + pixel_error;
    // Samples lie at all integers plus a sample position. The bounding box contains one if an integer remains in x and
    // in y.
    bool covers_sample = false;
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
        vec2 sample_position = SAMPLE_POSITIONS[sample_index];
        if (all(greaterThanEqual(floor(max_position - sample_position), ceil(min_position - sample_position)))) covers_sample = true;
    }
    if (!covers_sample) return NO_SAMPLE;
    vec2 edge_ab = position[1] - position[0], edge_ac = position[2] - position[0];
    float area = edge_ab.x * edge_ac.y - edge_ab.y * edge_ac.x; // twice the signed area
    // With e = `pixel_error`, a component of an edge is off by at most 2 e. A product a b of two components is then off
    // by at most 2 e (|a| + |b|) + 4 e^2. The area is the difference of two products.
    float area_magnitude = abs(edge_ab.x * edge_ac.y) + abs(edge_ab.y * edge_ac.x);
    float area_error = 2.0 * pixel_error * (abs(edge_ab.x) + abs(edge_ab.y) + abs(edge_ac.x) + abs(edge_ac.y))
        + 8.0 * pixel_error * pixel_error + FLOAT_ERROR * area_magnitude;
    if (is_single_sided && area < -area_error) return BACK_FACING;
#ifdef CULL_OCCLUDED
    float min_area = abs(area) - area_error;
    if (!(min_area > 0.0)) return VISIBLE;
    // `slope` is an upper bound of the depth slope per pixel, from Cramer's rule for the plane through the corners.
    // `margin` bounds the depth difference between the exact plane and the plane through the rounded corners, also at a
    // sample that is outside the triangle by the rounding error. `reach` bounds the distances, in pixels, that the
    // rasterizer multiplies by the slope with rounding. All terms are relative to the depths of this triangle, so that
    // the margin is also tight far from the camera, where depth is small.
    vec2 depth_change = abs(vec2(depth[1], depth[2]) - depth[0]) + 2.0 * depth_error;
    float slope = (depth_change.x * (abs(edge_ac.x) + abs(edge_ac.y)) + depth_change.y * (abs(edge_ab.x) + abs(edge_ab.y))) / min_area;
    vec2 extent = max_position - min_position;
    float reach = size.x + size.y + (extent.x + extent.y) * (1.0 + area_magnitude / min_area);
    float margin = depth_error + 2.0 * pixel_error * slope + ROUNDING * (nearest + slope * reach);
    uvec2 min_pixel = uvec2(clamp(min_position, vec2(0.0), size)), max_pixel = uvec2(clamp(max_position, vec2(0.0), size));
    uvec2 last_pixel = uvec2(size) - 1u;
    if (is_occluded(min(min_pixel, last_pixel), min(max_pixel, last_pixel), uvec2(size), nearest + margin)) return OCCLUDED;
#endif
    return VISIBLE;
}

uint classify_triangle(uint triangle, bool is_single_sided) {
    uvec3 vertices = texelFetch(triangle_vertices, int(triangle)).xyz;
    ClipVertex corners[3];
    vec3 world[3];
    // For x, y and z of clip space: whether all corners are certainly below the lower or above the upper clip plane.
    bvec3 is_below = bvec3(true), is_above = bvec3(true);
    bool is_inside = true;
    for (int corner = 0; corner < 3; corner++) {
        world[corner] = texelFetch(positions, int(vertices[corner])).xyz;
        corners[corner] = clip_vertex(world[corner]);
        vec4 clip = corners[corner].clip, error_bound = corners[corner].error_bound;
        if (!all(lessThan(error_bound, vec4(LARGE)))) return VISIBLE;
        // The planes are -w <= x <= w, -w <= y <= w and 0 <= z <= w.
        vec3 lower_distance = vec3(clip.xy + clip.w, clip.z), upper_distance = clip.w - clip.xyz;
        vec3 margin = error_bound.xyz + error_bound.w, lower_margin = vec3(margin.xy, error_bound.z);
        for (int axis = 0; axis < 3; axis++) {
            is_below[axis] = is_below[axis] && lower_distance[axis] < -lower_margin[axis];
            is_above[axis] = is_above[axis] && upper_distance[axis] < -margin[axis];
        }
        is_inside = is_inside && all(greaterThan(lower_distance, lower_margin)) && all(greaterThan(upper_distance, margin))
            && clip.w > 2.0 * error_bound.w;
    }
    if (any(is_below) || any(is_above)) return OUTSIDE;
    if (!is_inside) return VISIBLE;
    // A triangle with two equal corners has no area.
    if (world[0] == world[1] || world[1] == world[2] || world[2] == world[0]) return NO_SAMPLE;
    return classify_unclipped(corners, is_single_sided);
}
#endif

void main() {
    if (workgroup_index() >= groups.count.y) return;
    uint lane = gl_LocalInvocationIndex;
    if (lane < MASK_WORDS) mask_words[lane] = 0u;
    if (lane < CLASS_COUNT) class_counts[lane] = 0u;
    Block block = current_block();
    memoryBarrierShared();
    barrier();
    uint word = block.index * MASK_WORDS + lane / 32u, bit = 1u << (lane & 31u);
    if (block.has_triangle) {
#ifdef CULL_PREVIOUS
        uint triangle_class = (previously_visible[word] & bit) != 0u ? VISIBLE : OUTSIDE;
#else
        uint triangle = groups.ranges[block.group].x + block.triangle;
#ifdef CULL_SHADOW
        uint triangle_class = classify_triangle(triangle, false);
#else
        uint triangle_class = classify_triangle(triangle, groups.flags[block.group].x != 0u);
#endif
#endif
        atomicAdd(class_counts[triangle_class], 1u);
        if (triangle_class == VISIBLE) atomicOr(mask_words[lane / 32u], bit);
    }
    memoryBarrierShared();
    barrier();
    if (lane < MASK_WORDS) {
        bits[block.index * MASK_WORDS + lane] = mask_words[lane];
#ifdef CULL_OCCLUDED
        // This frame's occluders are already drawn. Clear the bitmap, so that the frame's visible triangles can be
        // recorded.
        previously_visible[block.index * MASK_WORDS + lane] = 0u;
#endif
    }
    // Integer sums do not depend on the order of the workgroups.
    if (lane == 0u && class_counts[VISIBLE] > 0u) {
        // The first of a command's 5 words is its number of indices.
        atomicAdd(draws.commands[5u * block.group], 3u * class_counts[VISIBLE]);
        atomicAdd(draws.totals[block.index / SUPERBLOCK], class_counts[VISIBLE]);
    }
#ifndef CULL_PREVIOUS
    // Not a condition `lane < CLASS_COUNT && class_counts[lane] > 0u`: Mesa evaluates both operands, and its software
    // renderer does not check the bounds of shared arrays.
    if (lane < CLASS_COUNT) {
        uint class_count = class_counts[lane];
        if (class_count > 0u) atomicAdd(cull_counters[FIRST_COUNTER + lane], class_count);
    }
#endif
}
