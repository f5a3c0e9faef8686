// Packs the id of the first sample of each pixel, top row first.
//   ids   [height][width][SAMPLES]  R32UI, bottom row first (in)
//   seen  [height][width]           the ids                 (out)
layout(local_size_x = LANES) in;
layout(std430, binding = 0) writeonly buffer Pixels { uint seen[]; };

void main() {
    ivec2 size = size_of_ids();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x) return;
    seen[uint(size.y - 1 - at.y) * uint(size.x) + uint(at.x)] = id_at(at, 0);
}
