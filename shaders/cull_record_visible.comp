// Records in a bitmap the triangles that are visible in at least one sample: the occluders of the next frame. The
// bitmap has one bit for each triangle of each block. `shared/cull.glsl` defines groups and blocks.
layout(local_size_x = 8, local_size_y = 8) in;
layout(std430, binding = 3) buffer PreviouslyVisible { uint previously_visible[]; };

void record_triangle(uint triangle) {
    // The last group whose first triangle is not after `triangle`.
    uint group = groups.count.x - 1u;
    while (group > 0u && triangle < groups.ranges[group].x) group--;
    // `x` is the group's first triangle, `w` its first block. A block has WORKGROUP_SIZE bits.
    uint bit_index = groups.ranges[group].w * uint(WORKGROUP_SIZE) + triangle - groups.ranges[group].x;
    uint mask = 1u << (bit_index & 31u);
    if ((previously_visible[bit_index / 32u] & mask) == 0u) atomicOr(previously_visible[bit_index / 32u], mask);
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, id_image_size()))) return;
    uint previous_id = NO_ID;
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
        uint id = load_id(pixel, sample_index);
        if (id != NO_ID && id != previous_id) record_triangle(id - 1u);
        previous_id = id;
    }
}
