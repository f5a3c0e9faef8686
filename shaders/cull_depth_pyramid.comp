// Builds the depth pyramid, the farthest depth of ever larger squares: a dispatch adds four levels, a workgroup reduces
// 16 x 16 texels of the first one. The levels are stored one after another, each with half the width and height,
// rounded up. Texels outside the image count as 0: they neither hide nor show anything.
layout(local_size_x = 16, local_size_y = 16) in;
layout(location = 0) uniform int size_packed; // width, and height shifted by 16: negative from 32768 on
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
shared float farthest[16][16];

void main() {
    ivec2 size = ivec2(size_packed & 0xFFFF, size_packed >> 16 & 0xFFFF), at = ivec2(gl_GlobalInvocationID.xy);
    ivec2 lane = ivec2(gl_LocalInvocationID.xy);
    int base = 0;
    for (int level = 0; level < FIRST_LEVEL; level++) {
        base += size.x * size.y;
        size = (size + 1) / 2;
    }
    float far = 0.0;
    if (all(lessThan(at, size))) {
#ifdef FROM_DEPTH
        for (int index = 0; index < SAMPLES; index++) far = max(far, texelFetch(depth, at, index).x);
        depths[base + at.y * size.x + at.x] = far;
#else
        far = depths[base + at.y * size.x + at.x];
#endif
    }
    farthest[lane.y][lane.x] = far;
    for (int side = 8; side > 0; side /= 2) {
        memoryBarrierShared();
        barrier();
        bool own = all(lessThan(lane, ivec2(side)));
        if (own) {
            ivec2 from = 2 * lane;
            far = max(max(farthest[from.y][from.x], farthest[from.y][from.x + 1]),
                max(farthest[from.y + 1][from.x], farthest[from.y + 1][from.x + 1]));
        }
        memoryBarrierShared();
        barrier();
        base += size.x * size.y;
        size = (size + 1) / 2;
        at = ivec2(gl_WorkGroupID.xy) * side + lane;
        if (own) {
            farthest[lane.y][lane.x] = far;
            if (all(lessThan(at, size))) depths[base + at.y * size.x + at.x] = far;
        }
    }
}
