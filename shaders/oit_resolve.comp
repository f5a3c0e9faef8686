// Resolves the list of a pixel to one layer per sample: sorts and shades the fragments like opaque surfaces, and blends
// them front to back. A fragment is shaded once, at the center of the samples that it covers.
//   layers  [SAMPLES][height][width]  RGBA16F: light of the blended surfaces, transmittance
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(rgba16f, binding = 3) uniform writeonly image2DArray layers;
layout(std430, binding = 2) buffer Records { uvec2 records[]; };
layout(std430, binding = 1) readonly buffer Tiles {
    uint groups[3];
    uint count;
    uint tiles[];
};

bool is_before(uvec2 one, uvec2 other) { return one.x < other.x || (one.x == other.x && one.y > other.y); }

// For short lists.
void insertion_sort(uint first, uint many) {
    for (uint next = 1u; next < many; next++) {
        uvec2 record = records[first + next];
        uint place = next;
        while (place > 0u && is_before(record, records[first + place - 1u])) {
            records[first + place] = records[first + place - 1u];
            place--;
        }
        records[first + place] = record;
    }
}

// Heap sift-down: moves a record below its children that come after it in the order.
void sift_down(uint first, uint place, uint many) {
    uvec2 record = records[first + place];
    uint below = 2u * place + 1u;
    while (below < many) {
        if (below + 1u < many && is_before(records[first + below], records[first + below + 1u])) below++;
        if (!is_before(record, records[first + below])) break;
        records[first + place] = records[first + below];
        place = below;
        below = 2u * place + 1u;
    }
    records[first + place] = record;
}

// For long lists: n log n steps at most.
void heap_sort(uint first, uint many) {
    for (uint place = many / 2u; place > 0u; place--) sift_down(first, place - 1u, many);
    for (uint last = many - 1u; last > 0u; last--) {
        uvec2 record = records[first];
        records[first] = records[first + last];
        records[first + last] = record;
        sift_down(first, 0u, last);
    }
}

vec4 shade_fragment(uvec2 record, ivec2 at, vec2 texel) {
    vec2 middle = vec2(0.0);
    for (int index = 0; index < SAMPLES; index++) {
        if ((record.y >> index & 1u) != 0u) middle += SAMPLE_POSITIONS[index];
    }
    middle /= float(max(bitCount(record.y & 15u), 1));
    vec4 seen = shade_triangle(int((record.y >> 4) - 1u), (vec2(at) + middle) * texel - 1.0, texel);
    return vec4(seen.rgb, seen.a > 0.0 ? min(seen.a, 1.0) : 0.0);
}

void main() {
    uint tile_place = gl_WorkGroupID.y * TILES_PER_ROW + gl_WorkGroupID.x;
    uint tile = tiles[min(tile_place, count - 1u)];
    ivec2 size = imageSize(layers).xy;
    ivec2 at = TILE * ivec2(tile & 0xFFFFu, tile >> 16) + ivec2(gl_LocalInvocationID.xy);
    if (tile_place >= count || any(greaterThanEqual(at, size))) return;
    uint found = imageLoad(fragment_counts, at).x;
    if (found == 0u) return;
    uint many = min(found, counters.per_pixel_limit);
    uint first = imageLoad(cursors, at).x;
    if (found <= counters.per_pixel_limit) {
        // For lists that were filled in any order, `cursors` is the end of the list; the others are sorted already.
        first -= many;
        if (many <= 32u) insertion_sort(first, many);
        else heap_sort(first, many);
    }
    vec4 layer[SAMPLES];
    for (int index = 0; index < SAMPLES; index++) layer[index] = vec4(0.0, 0.0, 0.0, 1.0);
    bool open = true;
    for (uint index = 0u; index < many && open; index++) {
        uvec2 record = records[first + index];
        vec4 seen = shade_fragment(record, at, 2.0 / vec2(size));
        open = false;
        for (int sampled = 0; sampled < SAMPLES; sampled++) {
            if ((record.y >> sampled & 1u) != 0u) {
                layer[sampled].rgb += layer[sampled].a * seen.a * seen.rgb;
                layer[sampled].a *= 1.0 - seen.a;
            }
            open = open || layer[sampled].a > 0.0;
        }
    }
    for (int index = 0; index < SAMPLES; index++) imageStore(layers, ivec3(at, index), layer[index]);
}
