// Adds a fragment of a blended triangle to the list of its pixel. One program runs in three phases, so that all phases
// see the same fragments. The first phase counts fragments, the second fills the lists. For a pixel with more fragments
// than the limit, the second phase stores only the nearest depths, and the third stores the ids of these depths. Early
// depth tests reject fragments behind opaque surfaces. Fully transparent fragments are skipped. Record i of the frame
// is records[2 i], the depth, and records[2 i + 1], the id and the sample coverage.
layout(early_fragment_tests) in;
#if SAMPLES > 1 && defined(POST_DEPTH_COVERAGE)
// gl_SampleMaskIn contains only samples that pass the depth test.
layout(post_depth_coverage) in;
#endif
layout(std430, binding = 2) buffer Records { uint records[]; };
// Twins: the constants of the same names in src/render/layout/oit.rs.
layout(location = 1) uniform int phase;
const int PHASE_COUNT = 0;
const int PHASE_FILL = 1;
// The third phase, PHASE_FILL_IDS, has the value 2.

uint sample_coverage() {
#if SAMPLES == 1
    return 1u;
#elif defined(POST_DEPTH_COVERAGE)
    return uint(gl_SampleMaskIn[0]) & 15u; // four samples
#else
    // Reading gl_SampleID runs the shader once for each sample that passes the depth test.
    return 1u << gl_SampleID;
#endif
}

// Inserts a depth into the sorted list of a pixel, which keeps the nearest depths. Each record takes the minimum of its
// depth and the inserted depth; the maximum is inserted into the next record. An empty record has the depth UNBOUNDED.
// The result does not depend on the order of the fragments.
void insert_depth(uint first_record, uint depth) {
    for (uint index = 0u; index < counters.per_pixel_limit && depth != UNBOUNDED; index++) {
        uint previous = atomicMin(records[2u * (first_record + index)], depth);
        depth = max(previous, depth);
    }
}

// Inserts an id into the records of equal depth, which are sorted by descending id. If there are more ids than records,
// the smallest ids are dropped.
void insert_id(uint first_record, uint depth, uint id_and_coverage) {
    for (uint index = 0u; index < counters.per_pixel_limit && id_and_coverage != 0u; index++) {
        if (records[2u * (first_record + index)] != depth) continue;
        uint previous = atomicMax(records[2u * (first_record + index) + 1u], id_and_coverage);
        id_and_coverage = min(previous, id_and_coverage);
    }
}

void main() {
    float alpha = fragment_alpha(material_of(current_triangle()));
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    // Depths are compared as unsigned integers, so `abs` turns -0 (bits 0x80000000) into 0. gl_FragCoord.z decreases
    // with the distance, the depth of a record increases.
    uint depth = floatBitsToUint(1.0) - floatBitsToUint(abs(clamp(gl_FragCoord.z, 0.0, 1.0)));
    uint id_and_coverage = uint(current_triangle()) + 1u << 4 | sample_coverage();
    if (!(alpha > 0.0)) return;
    if (phase == PHASE_COUNT) {
        imageAtomicAdd(fragment_counts, pixel, 1u);
        return;
    }
    bool is_within_limit = imageLoad(fragment_counts, pixel).x <= counters.per_pixel_limit;
    if (is_within_limit && phase == PHASE_FILL) {
        uint record = imageAtomicAdd(cursors, pixel, 1u);
        records[2u * record] = depth;
        records[2u * record + 1u] = id_and_coverage;
    }
    if (is_within_limit) return;
    uint first_record = imageLoad(cursors, pixel).x;
    if (phase == PHASE_FILL) insert_depth(first_record, depth);
    else insert_id(first_record, depth, id_and_coverage);
}
