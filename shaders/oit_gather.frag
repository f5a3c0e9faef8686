// Adds a fragment of a blended triangle to the list of its pixel. One program runs in three phases, so that all phases see
// the same fragments. The first phase counts them, the second fills the lists, and the third adds ids to the kept depths
// of pixels with too many fragments. Early depth tests reject fragments behind opaque surfaces; fully transparent
// fragments are skipped.
layout(early_fragment_tests) in;
#if SAMPLES > 1 && defined(POST_DEPTH_COVERAGE)
// Coverage after the depth test, instead of the triangle's full coverage.
layout(post_depth_coverage) in;
#endif
#ifdef TEXTURES
centroid in vec2 uv_image;
#endif
layout(std430, binding = 2) buffer Records { uint records[]; };
layout(location = 1) uniform int phase;
const int PHASE_COUNT = 0;
const int PHASE_FILL = 1;

uint sample_coverage() {
#if SAMPLES == 1
    return 1u;
#elif defined(POST_DEPTH_COVERAGE)
    return uint(gl_SampleMaskIn[0]) & 15u;
#else
    // Using gl_SampleID runs the shader once for each sample that passes.
    return 1u << gl_SampleID;
#endif
}

// Keeps the nearest depths of a pixel in order. Each slot keeps the minimum of all depths it gets and passes the other
// on, so that in the end the slots are sorted regardless of the order of the fragments.
void insert_depth(uint first, uint depth) {
    for (uint index = 0u; index < counters.per_pixel_limit && depth != UNBOUNDED; index++) {
        uint there = atomicMin(records[2u * (first + index)], depth);
        depth = max(there, depth);
    }
}

// The same for ids, among slots of the same depth: later triangles first; excess ids are dropped in that order.
void insert_id(uint first, uint depth, uint word) {
    for (uint index = 0u; index < counters.per_pixel_limit && word != 0u; index++) {
        if (records[2u * (first + index)] != depth) continue;
        uint there = atomicMax(records[2u * (first + index) + 1u], word);
        word = min(there, word);
    }
}

void main() {
    float alpha = material_of(current_triangle()).ambient.a;
#ifdef TEXTURES
    ivec2 image = material_of(current_triangle()).images.xy;
    vec4 texel = color_texel(image, uv_image);
    if (image.x >= 0) alpha *= texel.a;
#endif
    ivec2 at = ivec2(gl_FragCoord.xy);
    uint depth = floatBitsToUint(abs(clamp(gl_FragCoord.z, 0.0, 1.0)));
    uint word = uint(current_triangle()) + 1u << 4 | sample_coverage();
    if (!(alpha > 0.0)) return;
    if (phase == PHASE_COUNT) {
        imageAtomicAdd(fragment_counts, at, 1u);
        return;
    }
    bool fits = imageLoad(fragment_counts, at).x <= counters.per_pixel_limit;
    if (fits && phase == PHASE_FILL) {
        uint place = imageAtomicAdd(cursors, at, 1u);
        records[2u * place] = depth;
        records[2u * place + 1u] = word;
    }
    if (fits) return;
    uint first = imageLoad(cursors, at).x;
    if (phase == PHASE_FILL) insert_depth(first, depth);
    else insert_id(first, depth, word);
}
