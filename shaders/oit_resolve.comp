// Resolves the list of a pixel to one blend layer per sample: sorts the fragments, shades them like opaque surfaces,
// and blends them front to back. A fragment is shaded once, at the center of the samples that it covers.
//   blend_layers  (out)  [SAMPLES][height][width]  RGBA16F: light of the blended surfaces, transmittance
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(location = 2) uniform int first_tile; // that this dispatch resolves
layout(rgba16f, binding = 3) uniform writeonly image2DArray blend_layers;
// x: depth; y: triangle index plus 1 in the upper 28 bits, sample coverage in the lower 4.
layout(std430, binding = 2) buffer Records { uvec2 records[]; };

// Order of a list: nearest first; at equal depth, the triangle that is drawn last comes first.
bool is_before(uvec2 a, uvec2 b) { return a.x < b.x || (a.x == b.x && a.y > b.y); }

// For short lists.
void insertion_sort(uint first_record, uint count) {
    for (uint sorted_count = 1u; sorted_count < count; sorted_count++) {
        uvec2 record = records[first_record + sorted_count];
        uint slot = sorted_count;
        while (slot > 0u && is_before(record, records[first_record + slot - 1u])) {
            records[first_record + slot] = records[first_record + slot - 1u];
            slot--;
        }
        records[first_record + slot] = record;
    }
}

// Moves a record down a max-heap until no child comes after it in the list's order.
void sift_down(uint first_record, uint slot, uint count) {
    uvec2 record = records[first_record + slot];
    uint child = 2u * slot + 1u;
    while (child < count) {
        if (child + 1u < count && is_before(records[first_record + child], records[first_record + child + 1u])) child++;
        if (!is_before(record, records[first_record + child])) break;
        records[first_record + slot] = records[first_record + child];
        slot = child;
        child = 2u * slot + 1u;
    }
    records[first_record + slot] = record;
}

// For long lists: n log n steps at most.
void heap_sort(uint first_record, uint count) {
    for (uint slot = count / 2u; slot > 0u; slot--) sift_down(first_record, slot - 1u, count);
    for (uint heap_size = count - 1u; heap_size > 0u; heap_size--) {
        uvec2 record = records[first_record];
        records[first_record] = records[first_record + heap_size];
        records[first_record + heap_size] = record;
        sift_down(first_record, 0u, heap_size);
    }
}

// Light and opacity of a fragment, shaded at the mean position of the samples that it covers.
vec4 shade_fragment(uvec2 record, ivec2 pixel, vec2 pixel_size) {
    vec2 center = vec2(0.0);
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
        if ((record.y >> sample_index & 1u) != 0u) center += SAMPLE_POSITIONS[sample_index];
    }
    center /= float(max(bitCount(record.y & 15u), 1));
    vec4 color = shade_triangle(int((record.y >> 4) - 1u), (vec2(pixel) + center) * pixel_size - 1.0, pixel_size);
    return vec4(color.rgb, color.a > 0.0 ? min(color.a, 1.0) : 0.0);
}

void main() {
    ivec2 size = imageSize(blend_layers).xy;
    uint tile_index = uint(first_tile) + listed_tile_index();
    ivec2 pixel = listed_pixel(tile_index);
    if (!has_listed_tile(tile_index) || any(greaterThanEqual(pixel, size))) return;
    uint fragment_count = imageLoad(fragment_counts, pixel).x;
    if (fragment_count == 0u) return;
    uint record_count = min(fragment_count, counters.per_pixel_limit);
    uint first_record = imageLoad(cursors, pixel).x;
    if (fragment_count <= counters.per_pixel_limit) {
        // The gather phases sort only the lists of pixels above the limit. For other pixels, filling has advanced the
        // cursor to the end of the list.
        first_record -= record_count;
        // At this length, both sorts take a similar number of steps.
        if (record_count <= 32u) insertion_sort(first_record, record_count);
        else heap_sort(first_record, record_count);
    }
    vec4 sample_blends[SAMPLES];
    for (int index = 0; index < SAMPLES; index++) sample_blends[index] = vec4(0.0, 0.0, 0.0, 1.0);
    // Whether a sample still transmits light, so that farther fragments are visible.
    bool is_transparent = true;
    for (uint record_index = 0u; record_index < record_count && is_transparent; record_index++) {
        uvec2 record = records[first_record + record_index];
        vec4 color = shade_fragment(record, pixel, 2.0 / vec2(size));
        is_transparent = false;
        for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
            if ((record.y >> sample_index & 1u) != 0u) {
                sample_blends[sample_index].rgb += sample_blends[sample_index].a * color.a * color.rgb;
                sample_blends[sample_index].a *= 1.0 - color.a;
            }
            is_transparent = is_transparent || sample_blends[sample_index].a > 0.0;
        }
    }
    for (int index = 0; index < SAMPLES; index++) imageStore(blend_layers, ivec3(pixel, index), sample_blends[index]);
}
