// The bounds of all positions, from the boxes that `deform` left of its tiles, those of passed-over tiles included.
//   boxes   [count][6] u32: `ordered` maxima of -x, -y, -z, x, y, z  (in)
//   bounds  in the header: the maxima of all; zeros before the launch (in, out)
// Launch: BLOCK threads a block, any number of blocks. CPU twin: Bounds::union.
#include "chain.cuh"
#include "layout.cuh"
#include "ordered.cuh"

extern "C" __global__ void __launch_bounds__(BLOCK) bounds(const __grid_constant__ BoundsArgs args) {
    await_previous();
    admit_next();
    __shared__ unsigned most[6];
    if (threadIdx.x < 6) {
        most[threadIdx.x] = 0;
    }
    __syncthreads();
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
    for (unsigned box = blockIdx.x * BLOCK + threadIdx.x; box < args.count; box += gridDim.x * BLOCK) {
        const uint2* sides = (const uint2*)(args.boxes + 6 * (size_t)box);
#pragma unroll
        for (unsigned pair = 0; pair < 3; ++pair) {
            const uint2 two = sides[pair];
            keys[2 * pair] = max(keys[2 * pair], two.x);
            keys[2 * pair + 1] = max(keys[2 * pair + 1], two.y);
        }
    }
#pragma unroll
    for (unsigned side = 0; side < 6; ++side) {
        const unsigned key = warp_max(keys[side]);
        if (threadIdx.x % 32 == side) {
            atomicMax(&most[side], key);
        }
    }
    __syncthreads();
    // Few blocks go beyond what others have reported: looking first keeps them from queueing at six addresses. The value
    // read may be old, but it only grows, so no maximum is lost.
    if (threadIdx.x < 6 && most[threadIdx.x] > *(volatile unsigned*)(args.header->bounds + threadIdx.x)) {
        atomicMax(args.header->bounds + threadIdx.x, most[threadIdx.x]);
    }
}
