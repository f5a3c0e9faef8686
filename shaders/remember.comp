// Records in a bitmap the triangles that some sample sees: the occluders of the next frame.
layout(local_size_x = 8, local_size_y = 8) in;
layout(std430, binding = 3) buffer Seen { uint seen[]; };

void remember(uint triangle) {
    uint group = groups.count.x - 1u;
    while (group > 0u && triangle < groups.places[group].x) group--;
    uint place = groups.places[group].w * uint(LANES) + triangle - groups.places[group].x;
    uint bit = 1u << (place & 31u);
    if ((seen[place / 32u] & bit) == 0u) atomicOr(seen[place / 32u], bit);
}

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, size_of_ids()))) return;
    uint last = NOTHING;
    for (int index = 0; index < SAMPLES; index++) {
        uint id = id_at(at, index);
        if (id != NOTHING && id != GROUND && id != last) remember(id - 1u);
        last = id;
    }
}
