// Tests which triangles the rasterizer must process: all except those that certainly produce no sample. Each bound is
// widened by the rounding errors between a vertex and its position on the device's subpixel grid, so that culling
// changes no bit of the picture. A triangle that the rasterizer may have to clip is culled only if it lies entirely
// outside one plane.
layout(local_size_x = WORKGROUP_SIZE) in;
layout(location = 0) uniform int size_packed; // width, and height shifted by 16: negative from 32768 on
layout(binding = 13) uniform samplerBuffer positions;
layout(binding = 18) uniform usamplerBuffer triangle_vertices;

const uint VISIBLE = 0u;
const uint OUTSIDE = 1u;
const uint BACK_FACING = 2u;
const uint NO_SAMPLE = 3u;
const uint OCCLUDED = 4u;
const uint CLASS_COUNT = 5u;

#ifndef CULL_PREVIOUS
layout(std430, binding = 2) buffer CullCounters { uint cull_counters[2u * CLASS_COUNT]; };
#endif
#if defined(CULL_PREVIOUS) || defined(CULL_OCCLUDED)
layout(std430, binding = 3) buffer PreviouslyVisible { uint previously_visible[]; };
#endif

shared uint mask_words[MASK_WORDS];
shared uint class_counts[CLASS_COUNT];

#ifndef CULL_PREVIOUS
// Two evaluations of a matrix-vector product differ by less than this share of the sum of the terms' magnitudes: four
// products and three sums each round by 2^-24 of the sum, in each evaluation.
const float ROUNDING = 1.0 / 1048576.0;
// Error of a float of magnitude 1 after a few operations.
const float FLOAT_SLACK = 1.0 / 4194304.0;
// Above this magnitude of the terms, one evaluation may overflow and another may not.
const float LARGE = 1e30;

struct ClipVertex {
    vec4 clip;
    vec4 slack; // bound on the difference to the rasterizer's clip position
};

#ifdef CULL_SHADOW
#ifdef CASCADES
layout(location = 1) uniform int layer;
#endif
ClipVertex project_vertex(vec3 world) {
    mat4 m = frame.shadow_from_world;
    vec3 at = (m * vec4(world, 1.0)).xyz;
    vec3 size = (abs(m[0]) * abs(world.x) + abs(m[1]) * abs(world.y) + abs(m[2]) * abs(world.z) + abs(m[3])).xyz;
#ifdef CASCADES
    at.xy = to_cascade(at.xy, layer);
    size.xy = size.xy * abs(cascades.scale_offsets[layer].xy) + abs(cascades.scale_offsets[layer].zw);
#endif
    return ClipVertex(vec4(2.0 * at - 1.0, 1.0), vec4(ROUNDING * (2.0 * size + 1.0), 0.0));
}
#else
ClipVertex project_vertex(vec3 world) {
    mat4 m = frame.clip_from_world;
    vec4 size = abs(m[0]) * abs(world.x) + abs(m[1]) * abs(world.y) + abs(m[2]) * abs(world.z) + abs(m[3]);
    return ClipVertex(m * vec4(world, 1.0), ROUNDING * size);
}
#endif

// A vertex that is not finite is placed in front of the near plane, as in the vertex shaders.
ClipVertex clip_vertex(vec3 world) {
    bool bad = any(isnan(world)) || any(isinf(world));
    if (bad) return ClipVertex(vec4(0.0, 0.0, -2.0, 1.0), vec4(0.0));
    return project_vertex(world);
}

#ifdef CULL_OCCLUDED
layout(std430, binding = 4) readonly buffer DepthPyramid { float depths[]; };

// Whether the pyramid is nearer than a depth in a whole rectangle of pixels.
bool is_occluded(uvec2 low, uvec2 high, uvec2 size, float depth) {
    uint level = 0u, base = 0u;
    while (level < MAX_LEVEL && any(greaterThan((high >> level) - (low >> level), uvec2(3u)))) {
        base += size.x * size.y;
        size = size + 1u >> 1;
        level++;
    }
    low >>= level;
    high >>= level;
    if (any(greaterThan(high - low, uvec2(3u)))) return false;
    for (uint y = low.y; y <= high.y; y++) {
        for (uint x = low.x; x <= high.x; x++) {
            if (!(depths[base + y * size.x + x] < depth)) return false;
        }
    }
    return true;
}
#endif

// Verdict for a triangle with no corner outside any plane.
uint classify_unclipped(ClipVertex corners[3], bool one_sided) {
    vec2 size = vec2(size_packed & 0xFFFF, size_packed >> 16 & 0xFFFF), at[3];
    float nearest = 1.0, farthest = 0.0, depth[3], blurred = 0.0, off = 0.0;
    for (int index = 0; index < 3; index++) {
        vec4 clip = corners[index].clip, slack = corners[index].slack;
        vec3 ndc = clip.xyz / clip.w;
        vec3 moved = (slack.xyz + abs(ndc) * slack.w) / (clip.w - slack.w) + FLOAT_SLACK * abs(ndc);
        at[index] = (0.5 * ndc.xy + 0.5) * size;
        depth[index] = 0.5 * ndc.z + 0.5;
        vec2 pixels = 0.5 * moved.xy * size;
        off = max(off, max(pixels.x, pixels.y));
        blurred = max(blurred, 0.5 * moved.z);
        nearest = min(nearest, depth[index]);
        farthest = max(farthest, depth[index]);
    }
    off += max(size.x, size.y) * FLOAT_SLACK + groups.subpixel_step.x;
    vec2 low = min(at[0], min(at[1], at[2])) - off, high = max(at[0], max(at[1], at[2])) + off;
    bool hit = false;
    for (int index = 0; index < SAMPLES; index++) {
        vec2 place = SAMPLE_POSITIONS[index];
        if (all(greaterThanEqual(floor(high - place), ceil(low - place)))) hit = true;
    }
    if (!hit) return NO_SAMPLE;
    vec2 a = at[1] - at[0], b = at[2] - at[0];
    float area = a.x * b.y - a.y * b.x, products = abs(a.x * b.y) + abs(a.y * b.x);
    float unsure = 2.0 * off * (abs(a.x) + abs(a.y) + abs(b.x) + abs(b.y)) + 8.0 * off * off + FLOAT_SLACK * products;
    if (one_sided && area < -unsure) return BACK_FACING;
#ifdef CULL_OCCLUDED
    float safe = abs(area) - unsure;
    if (!(safe > 0.0)) return VISIBLE;
    // Upper bound of the depth slope per pixel; and the deviation of a plane through rounded corners from the surface,
    // at a sample that lies outside the triangle by up to the rounding.
    vec2 dz = abs(vec2(depth[1], depth[2]) - depth[0]) + 2.0 * blurred;
    float slope = (dz.x * (abs(b.x) + abs(b.y)) + dz.y * (abs(a.x) + abs(a.y))) / safe;
    vec2 extent = high - low;
    float reach = size.x + size.y + (extent.x + extent.y) * (1.0 + products / safe);
    float margin = blurred + 2.0 * off * slope + ROUNDING * (1.0 + slope * reach);
    uvec2 most = uvec2(size) - 1u, first = uvec2(clamp(low, vec2(0.0), size)), last = uvec2(clamp(high, vec2(0.0), size));
    if (is_occluded(min(first, most), min(last, most), uvec2(size), nearest - margin)) return OCCLUDED;
#endif
    return VISIBLE;
}

uint classify(uint triangle, bool one_sided) {
    uvec3 vertices = texelFetch(triangle_vertices, int(triangle)).xyz;
    ClipVertex corners[3];
    vec3 world[3];
    bvec3 below = bvec3(true), above = bvec3(true);
    bool inside = true;
    for (int index = 0; index < 3; index++) {
        world[index] = texelFetch(positions, int(vertices[index])).xyz;
        corners[index] = clip_vertex(world[index]);
        vec4 clip = corners[index].clip, slack = corners[index].slack;
        if (!all(lessThan(slack, vec4(LARGE)))) return VISIBLE;
        vec3 margin = slack.xyz + slack.w, low = clip.xyz + clip.w, high = clip.w - clip.xyz;
        for (int axis = 0; axis < 3; axis++) {
            below[axis] = below[axis] && low[axis] < -margin[axis];
            above[axis] = above[axis] && high[axis] < -margin[axis];
        }
        inside = inside && all(greaterThan(low, margin)) && all(greaterThan(high, margin)) && clip.w > 2.0 * slack.w;
    }
    if (any(below) || any(above)) return OUTSIDE;
    if (!inside) return VISIBLE;
    if (world[0] == world[1] || world[1] == world[2] || world[2] == world[0]) return NO_SAMPLE;
    return classify_unclipped(corners, one_sided);
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
    uint word = block.place * MASK_WORDS + lane / 32u, bit = 1u << (lane & 31u);
    if (block.in_range) {
#ifdef CULL_PREVIOUS
        uint found = (previously_visible[word] & bit) != 0u ? VISIBLE : OUTSIDE;
#else
        uint triangle = groups.ranges[block.group].x + block.triangle;
#ifdef CULL_SHADOW
        uint found = classify(triangle, false);
#else
        uint found = classify(triangle, groups.flags[block.group].x != 0u);
#endif
#endif
        atomicAdd(class_counts[found], 1u);
        if (found == VISIBLE) atomicOr(mask_words[lane / 32u], bit);
    }
    memoryBarrierShared();
    barrier();
    if (lane < MASK_WORDS) {
        bits[block.place * MASK_WORDS + lane] = mask_words[lane];
#ifdef CULL_OCCLUDED
        // The remembered triangles were used; the ids of this frame are recorded next.
        previously_visible[block.place * MASK_WORDS + lane] = 0u;
#endif
    }
    // Integer sums do not depend on the order of the workgroups.
    if (lane == 0u && class_counts[VISIBLE] > 0u) {
        atomicAdd(draws.commands[5u * block.group], 3u * class_counts[VISIBLE]);
        atomicAdd(draws.totals[block.place / SUPERBLOCK], class_counts[VISIBLE]);
    }
#ifndef CULL_PREVIOUS
    if (lane < CLASS_COUNT && class_counts[lane] > 0u) atomicAdd(cull_counters[FIRST_COUNTER + lane], class_counts[lane]);
#endif
}
