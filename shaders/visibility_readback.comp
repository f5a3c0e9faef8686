// Packs the id of the first sample of each pixel, top row first.
//   ids   [height][width][SAMPLES]  R32UI, bottom row first (in)
//   seen  [height][width]           the ids                 (out)
layout(local_size_x = WORKGROUP_SIZE) in;
layout(std430, binding = 0) writeonly buffer Pixels { uint ids_out[]; };

void main() {
    ivec2 size = id_image_size();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x) return;
    ids_out[uint(size.y - 1 - at.y) * uint(size.x) + uint(at.x)] = load_id(at, 0);
}
