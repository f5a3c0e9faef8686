// The bounds of all positions, from the boxes that `deform` left of its tiles, those of passed-over tiles included; with
// BOXES those of each domain too, from its boxes, or from its positions where it shares a tile with others.
//   boxes      [count][6] u32: `ordered` maxima of -x, -y, -z, x, y, z                        (in)
//   bounds     in the header: the maxima of all; zeros before the launch                      (in, out)
//   pieces     with BOXES: the parts of domains of which a box is made                        (in)
//   stamps     with BOXES: per domain, the step that last changed it                          (in)
//   positions  with BOXES: in the header                                                      (in)
//   piece_boxes  with BOXES: [pieces][6] u32, like `boxes`; those of stale domains are written (out)
// Launch: BLOCK threads a block, any number of blocks. CPU twin: Bounds::union.
#include "chain.cuh"
#include "layout.cuh"
#include "ordered.cuh"

#ifdef BOXES
// Threads that make a box together.
constexpr unsigned TEAM = 8;

// The keys of one box or vertex of a piece.
__device__ __forceinline__ void add_item(const BoundsArgs& args, const Piece& piece, unsigned item, unsigned (&keys)[6]) {
    if (piece.of_vertices) {
        const float* at = args.header->positions + 3 * (size_t)(piece.first + item);
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
            const float number = at[axis];
            keys[axis] = max(keys[axis], ordered(-number));
            keys[3 + axis] = max(keys[3 + axis], ordered(number));
        }
    } else {
        const unsigned* box = args.boxes + 6 * (size_t)(piece.first + item);
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            keys[side] = max(keys[side], box[side]);
        }
    }
}

// All of a team's threads agree on the piece, so they take each turn of the loop together.
__device__ __forceinline__ void make_boxes(const BoundsArgs& args) {
    const unsigned member = threadIdx.x % TEAM;
    const unsigned team = 0xffu << threadIdx.x % 32 / TEAM * TEAM;
    const unsigned teams = gridDim.x * (BLOCK / TEAM);
    for (unsigned i = (blockIdx.x * BLOCK + threadIdx.x) / TEAM; i < args.piece_count; i += teams) {
        const Piece piece = args.pieces[i];
        if (!is_stale(args.header, args.stamps, piece.domain)) {
            continue;
        }
        unsigned keys[6] = {0, 0, 0, 0, 0, 0};
        for (unsigned item = member; item < piece.count; item += TEAM) {
            add_item(args, piece, item, keys);
        }
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            for (unsigned lanes = TEAM / 2; lanes > 0; lanes /= 2) {
                keys[side] = max(keys[side], __shfl_xor_sync(team, keys[side], lanes));
            }
            if (member == side) {
                args.piece_boxes[6 * (size_t)i + side] = keys[side];
            }
        }
    }
}
#endif

extern "C" __global__ void __launch_bounds__(BLOCK) bounds(const __grid_constant__ BoundsArgs args) {
    await_previous();
    admit_next();
#ifdef BOXES
    make_boxes(args);
    __syncwarp();
#endif
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
