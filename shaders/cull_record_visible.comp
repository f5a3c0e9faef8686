// Records in a bitmap the triangles that some sample sees: the occluders of the next frame.
layout(local_size_x = 8, local_size_y = 8) in;
layout(std430, binding = 3) buffer PreviouslyVisible { uint previously_visible[]; };

void record(uint triangle) {
    uint group = groups.count.x - 1u;
    while (group > 0u && triangle < groups.ranges[group].x) group--;
    uint place = groups.ranges[group].w * uint(WORKGROUP_SIZE) + triangle - groups.ranges[group].x;
    uint bit = 1u << (place & 31u);
    if ((previously_visible[place / 32u] & bit) == 0u) atomicOr(previously_visible[place / 32u], bit);
}

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, id_image_size()))) return;
    uint last = NO_ID;
    for (int index = 0; index < SAMPLES; index++) {
        uint id = load_id(at, index);
        if (id != NO_ID && id != GROUND_ID && id != last) record(id - 1u);
        last = id;
    }
}
