// Reduces the boxes that `deform` stored per tile to the bounds of all positions, including the tiles that this step
// did not compute. With ORIENTED_BOUNDS, also the bounds along `bounding_axes`, from the same boxes. With DOMAIN_BOXES, also a
// box of each domain, from its boxes, or from its positions if it shares a tile with other domains.
//   boxes      [count][6] u32: `float_to_ordered` maxima of -x, -y, -z, x, y, z; four per tile             (in)
//   bounding_axes  with ORIENTED_BOUNDS: three orthogonal unit vectors                               (in)
//   bounds     in the header: the maxima of all; zeros before the launch                      (in, out)
//   pieces     with DOMAIN_BOXES: the parts of domains that are reduced to one box each              (in)
//   stamps     with DOMAIN_BOXES: per domain, the step that last changed it                          (in)
//   positions  with DOMAIN_BOXES: address in the header                                              (in)
//   piece_boxes  with DOMAIN_BOXES: [pieces][6] u32, like `boxes`; only those of stale domains are written (out)
// Launch: BLOCK threads per block, any number of blocks. CPU twin: BoundingBox::union.
//
// Light space: the farthest corner of a tile's box along an axis follows from the signs of the axis, so an end takes
// three multiply-adds. They round outward, so that the bounds along the f32 axes contain every vertex. The box of a
// tile of 128 vertices exceeds its vertices by less than its diagonal. Six dot products per vertex in `deform` would be
// tight, but `deform` has no registers left.
#include "dependent_launch.cuh"
#include "layout.cuh"
#include "ordered_float.cuh"

#ifdef DOMAIN_BOXES
// Threads that reduce one piece together.
constexpr unsigned THREADS_PER_SEGMENT = 8;

// Adds one box or vertex of a piece to the keys.
__device__ __forceinline__ void add_item(const BoundsArgs& args, const BoxSegment& piece, unsigned item, unsigned (&keys)[6]) {
    if (piece.from_vertices) {
        const float* at = args.header->positions + 3 * (size_t)(piece.first + item);
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
            const float number = at[axis];
            keys[axis] = max(keys[axis], float_to_ordered(-number));
            keys[3 + axis] = max(keys[3 + axis], float_to_ordered(number));
        }
    } else {
        const unsigned* box = args.boxes + 6 * (size_t)(piece.first + item);
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            keys[side] = max(keys[side], box[side]);
        }
    }
}

// All threads of a team have the same piece, so they stay converged in the loop.
__device__ __forceinline__ void compute_segment_boxes(const BoundsArgs& args) {
    const unsigned member = threadIdx.x % THREADS_PER_SEGMENT;
    const unsigned team = 0xffu << threadIdx.x % 32 / THREADS_PER_SEGMENT * THREADS_PER_SEGMENT;
    const unsigned teams = gridDim.x * (BLOCK / THREADS_PER_SEGMENT);
    for (unsigned i = (blockIdx.x * BLOCK + threadIdx.x) / THREADS_PER_SEGMENT; i < args.segment_count; i += teams) {
        const BoxSegment piece = args.segments[i];
        if (!is_dirty(args.header, args.change_steps, piece.domain)) {
            continue;
        }
        unsigned keys[6] = {0, 0, 0, 0, 0, 0};
        for (unsigned item = member; item < piece.count; item += THREADS_PER_SEGMENT) {
            add_item(args, piece, item, keys);
        }
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            for (unsigned lanes = THREADS_PER_SEGMENT / 2; lanes > 0; lanes /= 2) {
                keys[side] = max(keys[side], __shfl_xor_sync(team, keys[side], lanes));
            }
            if (member == side) {
                args.segment_boxes[6 * (size_t)i + side] = keys[side];
            }
        }
    }
}
#endif

#ifdef ORIENTED_BOUNDS
constexpr unsigned KEY_COUNT = 12;
#else
constexpr unsigned KEY_COUNT = 6;
#endif

#ifdef ORIENTED_BOUNDS
// The maxima of -a x and of a x along an axis a, for one of the four lanes that hold a tile's boxes. Lane 3 duplicates
// the axis of lane 2.
struct OrientedExtent {
    float axis[3];
    unsigned ends[2];

    __device__ __forceinline__ void begin(const BoundsArgs& args) {
        const float* from = args.bounding_axes + 3 * min(threadIdx.x % 4, 2u);
        axis[0] = from[0];
        axis[1] = from[1];
        axis[2] = from[2];
        ends[0] = ends[1] = 0;
    }

    // The kernel that wrote the four boxes decides whether each covers the whole tile or a part of it, but their union
    // is always the same. The result therefore does not depend on which domains a step changed. All four lanes must
    // call this.
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
            const float below = ordered_to_float(box[i]), above = ordered_to_float(box[3 + i]);
            const bool is_along = axis[i] >= 0.0f;
            lower = __fmaf_ru(fabsf(axis[i]), is_along ? below : above, lower);
            upper = __fmaf_ru(fabsf(axis[i]), is_along ? above : below, upper);
        }
        ends[0] = max(ends[0], float_to_ordered(lower));
        ends[1] = max(ends[1], float_to_ordered(upper));
    }

    // Reduces over the warp; all lanes must call this.
    __device__ __forceinline__ void reduce_into(unsigned* most) {
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
    wait_on_dependent_grids();
    launch_dependent_grids();
#ifdef DOMAIN_BOXES
    compute_segment_boxes(args);
    __syncwarp();
#endif
    __shared__ unsigned most[KEY_COUNT];
    if (threadIdx.x < KEY_COUNT) {
        most[threadIdx.x] = 0;
    }
    __syncthreads();
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
#ifdef ORIENTED_BOUNDS
    OrientedExtent along;
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
#ifdef ORIENTED_BOUNDS
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
#ifdef ORIENTED_BOUNDS
    along.reduce_into(most + 6);
#endif
    __syncthreads();
    // Read before the atomic: few blocks exceed what others have reported, so most atomics to the same addresses are
    // avoided. The value read may be stale, but it only grows, so no maximum is lost.
    if (threadIdx.x < KEY_COUNT && most[threadIdx.x] > *(volatile unsigned*)(args.header->bounds + threadIdx.x)) {
        atomicMax(args.header->bounds + threadIdx.x, most[threadIdx.x]);
    }
}
