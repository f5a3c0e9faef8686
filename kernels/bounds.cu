// The bounds of all positions, from the boxes that `deform` left of its tiles, those of passed-over tiles included; with
// LIGHT along the axes of light space too, from the same boxes; with BOXES those of each domain, from its boxes, or from
// its positions where it shares a tile with others.
//   boxes      [count][6] u32: `ordered` maxima of -x, -y, -z, x, y, z; four of each tile         (in)
//   light      with LIGHT: the axes of light space                                            (in)
//   bounds     in the header: the maxima of all; zeros before the launch                      (in, out)
//   pieces     with BOXES: the parts of domains of which a box is made                        (in)
//   stamps     with BOXES: per domain, the step that last changed it                          (in)
//   positions  with BOXES: in the header                                                      (in)
//   piece_boxes  with BOXES: [pieces][6] u32, like `boxes`; those of stale domains are written (out)
// Launch: BLOCK threads a block, any number of blocks. CPU twin: Bounds::union.
//
// Light space: the farthest corner of a tile's box along an axis is found without looking at the others, so it takes three
// multiply-adds an end. They round up, so that what the f32 axes say holds every vertex. The box of a tile of 128 vertices
// reaches beyond them, by less than its diagonal; six dot products of each vertex in `deform` would not, but `deform` has
// no registers left.
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

#ifdef LIGHT
constexpr unsigned SIDES = 12;
#else
constexpr unsigned SIDES = 6;
#endif

#ifdef LIGHT
// What one of four lanes that have a tile's boxes keeps: the maxima along an axis a of -a x and of a x. The last of the four
// has the same axis as the one before it.
struct Along {
    float axis[3];
    unsigned ends[2];

    __device__ __forceinline__ void begin(const BoundsArgs& args) {
        const float* from = args.light + 3 * min(threadIdx.x % 4, 2u);
        axis[0] = from[0];
        axis[1] = from[1];
        axis[2] = from[2];
        ends[0] = ends[1] = 0;
    }

    // Whether the four boxes are of the whole tile or of parts of it is up to the kernel that made them, but their union is
    // always the same: so is what comes of it, whichever domains a step changed. The four lanes come here together.
    __device__ __forceinline__ void add(unsigned (&box)[6]) {
        const unsigned four = 0xfu << threadIdx.x % 32 / 4 * 4;
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            box[side] = max(box[side], __shfl_xor_sync(four, box[side], 1));
            box[side] = max(box[side], __shfl_xor_sync(four, box[side], 2));
        }
        // A tile of corners alone has no box.
        if (box[0] == 0) {
            return;
        }
        float lower = 0.0f, upper = 0.0f;
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const float below = unordered(box[i]), above = unordered(box[3 + i]);
            const bool is_along = axis[i] >= 0.0f;
            lower = __fmaf_ru(fabsf(axis[i]), is_along ? below : above, lower);
            upper = __fmaf_ru(fabsf(axis[i]), is_along ? above : below, upper);
        }
        ends[0] = max(ends[0], ordered(lower));
        ends[1] = max(ends[1], ordered(upper));
    }

    // All lanes of the warp.
    __device__ __forceinline__ void report(unsigned* most) {
#pragma unroll
        for (unsigned end = 0; end < 2; ++end) {
#pragma unroll
            for (unsigned lanes = 16; lanes > 2; lanes /= 2) {
                ends[end] = max(ends[end], __shfl_xor_sync(0xffffffffu, ends[end], lanes));
            }
            if (threadIdx.x % 32 < 3) {
                atomicMax(&most[3 * end + threadIdx.x % 32], ends[end]);
            }
        }
    }
};
#endif

extern "C" __global__ void __launch_bounds__(BLOCK) bounds(const __grid_constant__ BoundsArgs args) {
    await_previous();
    admit_next();
#ifdef BOXES
    make_boxes(args);
    __syncwarp();
#endif
    __shared__ unsigned most[SIDES];
    if (threadIdx.x < SIDES) {
        most[threadIdx.x] = 0;
    }
    __syncthreads();
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
#ifdef LIGHT
    Along along;
    along.begin(args);
#endif
    for (unsigned box = blockIdx.x * BLOCK + threadIdx.x; box < args.count; box += gridDim.x * BLOCK) {
        const uint2* sides = (const uint2*)(args.boxes + 6 * (size_t)box);
        unsigned own[6];
#pragma unroll
        for (unsigned pair = 0; pair < 3; ++pair) {
            const uint2 two = sides[pair];
            own[2 * pair] = two.x;
            own[2 * pair + 1] = two.y;
        }
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            keys[side] = max(keys[side], own[side]);
        }
#ifdef LIGHT
        along.add(own);
#endif
    }
#pragma unroll
    for (unsigned side = 0; side < 6; ++side) {
        const unsigned key = warp_max(keys[side]);
        if (threadIdx.x % 32 == side) {
            atomicMax(&most[side], key);
        }
    }
#ifdef LIGHT
    along.report(most + 6);
#endif
    __syncthreads();
    // Few blocks go beyond what others have reported: looking first keeps them from queueing at the same addresses. The
    // value read may be old, but it only grows, so no maximum is lost.
    if (threadIdx.x < SIDES && most[threadIdx.x] > *(volatile unsigned*)(args.header->bounds + threadIdx.x)) {
        atomicMax(args.header->bounds + threadIdx.x, most[threadIdx.x]);
    }
}
