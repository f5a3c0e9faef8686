// Builds the depth pyramid (Hi-Z): each texel is the farthest depth of 2 x 2 texels of the next finer level. The
// farthest depth is the smallest, because depth is 1 at the near plane and 0 at the far plane. The levels are stored
// one after another, finest first, each with half the width and height, rounded up. A workgroup reduces 16 x 16 texels
// to 8 x 8, 4 x 4, 2 x 2 and 1, so a dispatch computes four further levels. The first dispatch (FROM_DEPTH) also writes
// level 0, the minimum of each pixel's samples. The second dispatch reads level 4 and computes levels 5 to 8. Texels
// outside the image count as 1, so that they do not change a minimum.
layout(local_size_x = 16, local_size_y = 16) in;
layout(location = 0) uniform int size_packed; // width in the lower 16 bits, height in the upper 16
layout(std430, binding = 4) buffer DepthPyramid { float depths[]; };
#ifdef FROM_DEPTH
#if SAMPLES > 1
layout(binding = 26) uniform sampler2DMS depth;
#else
layout(binding = 26) uniform sampler2D depth;
#endif
const int FIRST_LEVEL = 0;
#else
const int FIRST_LEVEL = 4;
#endif
shared float farthest[16][16]; // depths of the current level in this workgroup

void main() {
    ivec2 size = ivec2(size_packed & 0xFFFF, size_packed >> 16 & 0xFFFF), texel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 lane = ivec2(gl_LocalInvocationID.xy);
    int level_offset = 0;
    for (int level = 0; level < FIRST_LEVEL; level++) {
        level_offset += size.x * size.y;
        size = (size + 1) / 2;
    }
    float min_depth = 1.0;
    if (all(lessThan(texel, size))) {
#ifdef FROM_DEPTH
        for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
            min_depth = min(min_depth, texelFetch(depth, texel, sample_index).x);
        }
        depths[level_offset + texel.y * size.x + texel.x] = min_depth;
#else
        min_depth = depths[level_offset + texel.y * size.x + texel.x];
#endif
    }
    farthest[lane.y][lane.x] = min_depth;
    // `side`: texels of the next level that the workgroup computes in each direction.
    for (int side = 8; side > 0; side /= 2) {
        memoryBarrierShared();
        barrier();
        bool is_active = all(lessThan(lane, ivec2(side)));
        if (is_active) {
            ivec2 child = 2 * lane;
            min_depth = min(min(farthest[child.y][child.x], farthest[child.y][child.x + 1]),
                min(farthest[child.y + 1][child.x], farthest[child.y + 1][child.x + 1]));
        }
        memoryBarrierShared();
        barrier();
        level_offset += size.x * size.y;
        size = (size + 1) / 2;
        texel = ivec2(gl_WorkGroupID.xy) * side + lane;
        if (is_active) {
            farthest[lane.y][lane.x] = min_depth;
            if (all(lessThan(texel, size))) depths[level_offset + texel.y * size.x + texel.x] = min_depth;
        }
    }
}
