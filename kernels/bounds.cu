// Reduces the boxes that `deform` and `batch` wrote, four per tile, to one bounding box of all positions. A partial
// step computes only some of the tiles; all other tiles keep their boxes from an earlier step. A key is an unsigned
// integer that increases with a float (ordered_float.cuh). With ORIENTED_BOUNDS, also computes the bounds along
// `bounding_axes` from the same boxes. With DOMAIN_BOXES, also computes one box per segment, a part of a domain. The
// items of a segment are boxes, or vertices if the domain shares a tile with other domains.
//   boxes          [box_count][6] u32: keys of the maxima of -x, -y, -z, x, y, z                              (in)
//   bounding_axes  with ORIENTED_BOUNDS: three orthogonal unit vectors                                        (in)
//   bounds         in the header: the maxima of all boxes; zeros before the launch                            (in, out)
//   segments       with DOMAIN_BOXES: `BoxSegment`s, each of which is reduced to one box                      (in)
//   change_steps   with DOMAIN_BOXES: per domain, the step that last changed it                               (in)
//   positions      with DOMAIN_BOXES: address in the header                                                   (in)
//   segment_boxes  with DOMAIN_BOXES: [segments][6] u32, like `boxes`; only those of dirty domains are written (out)
// Launch: BLOCK threads per block, any number of blocks. CPU twin: BoundingBox::union.
// BoundingBox is in src/model/scene/camera.rs.
//
// Oriented bounds: the signs of an axis's components select the corner of a tile's box that is farthest along the axis,
// so each extreme costs three multiply-adds. They round outward, so that the bounds along the f32 axes contain every
// vertex. The bounds of a tile exceed the extent of its vertices by less than the diagonal of its box. Projecting every
// vertex in `deform` would give tight bounds, but `deform` has no spare registers.
#include "dependent_launch.cuh"
#include "layout.cuh"
#include "ordered_float.cuh"

#ifdef DOMAIN_BOXES
// Threads that reduce one segment together.
constexpr unsigned THREADS_PER_SEGMENT = 8;

// Merges one item of a segment, a box or a vertex, into the running maxima.
__device__ __forceinline__ void merge_item(const BoundsArgs& args, const BoxSegment& segment, unsigned item,
                                           unsigned (&keys)[6]) {
    if (segment.is_vertex_range) {
        const float* position = args.header->positions + 3 * (size_t)(segment.first_item + item);
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
            const float coordinate = position[axis];
            keys[axis] = max(keys[axis], float_to_ordered(-coordinate));
            keys[3 + axis] = max(keys[3 + axis], float_to_ordered(coordinate));
        }
    } else {
        const unsigned* box = args.boxes + 6 * (size_t)(segment.first_item + item);
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            keys[side] = max(keys[side], box[side]);
        }
    }
}

// Each group of THREADS_PER_SEGMENT threads reduces one segment at a time, so that the threads of a group do not
// diverge.
__device__ __forceinline__ void compute_segment_boxes(const BoundsArgs& args) {
    const unsigned group_rank = threadIdx.x % THREADS_PER_SEGMENT;
    // The 8 lanes of this thread's group.
    const unsigned group_mask = 0xffu << threadIdx.x % 32 / THREADS_PER_SEGMENT * THREADS_PER_SEGMENT;
    const unsigned group_count = gridDim.x * (BLOCK / THREADS_PER_SEGMENT);
    for (unsigned i = (blockIdx.x * BLOCK + threadIdx.x) / THREADS_PER_SEGMENT; i < args.segment_count; i += group_count) {
        const BoxSegment segment = args.segments[i];
        if (!is_dirty(args.header, args.change_steps, segment.domain)) {
            continue;
        }
        // Key 0 is below the key of every number.
        unsigned keys[6] = {0, 0, 0, 0, 0, 0};
        for (unsigned item = group_rank; item < segment.item_count; item += THREADS_PER_SEGMENT) {
            merge_item(args, segment, item, keys);
        }
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            for (unsigned offset = THREADS_PER_SEGMENT / 2; offset > 0; offset /= 2) {
                keys[side] = max(keys[side], __shfl_xor_sync(group_mask, keys[side], offset));
            }
            if (group_rank == side) {
                args.segment_boxes[6 * (size_t)i + side] = keys[side];
            }
        }
    }
}
#endif

// Number of keys of `StepHeader::bounds` that this variant computes.
#ifdef ORIENTED_BOUNDS
constexpr unsigned KEY_COUNT = 12;
#else
constexpr unsigned KEY_COUNT = 6;
#endif

#ifdef ORIENTED_BOUNDS
// The maxima of -dot(a, x) and dot(a, x) for an axis a and the positions x, as keys. Four consecutive lanes hold the
// four boxes of a tile. Lane i of the four computes the maxima along axis i; lane 3 repeats axis 2.
struct OrientedExtent {
    float axis[3];
    unsigned extent_keys[2];

    __device__ __forceinline__ void load_axis(const BoundsArgs& args) {
        // Axis 2 for lane 3.
        const float* bounding_axis = args.bounding_axes + 3 * min(threadIdx.x % 4, 2u);
        axis[0] = bounding_axis[0];
        axis[1] = bounding_axis[1];
        axis[2] = bounding_axis[2];
        extent_keys[0] = extent_keys[1] = 0;
    }

    // Merges the boxes of a tile, one per lane; all four lanes must call this. Depending on the kernel that computed
    // the tile, the four boxes are copies of the tile's box, or boxes of its parts. The union of the four is the same
    // in both cases. It is computed first, so that the result does not depend on the kernel.
    __device__ __forceinline__ void merge_tile(unsigned (&box)[6]) {
        const unsigned tile_lane_mask = 0xfu << threadIdx.x % 32 / 4 * 4;
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            box[side] = max(box[side], __shfl_xor_sync(tile_lane_mask, box[side], 1));
            box[side] = max(box[side], __shfl_xor_sync(tile_lane_mask, box[side], 2));
        }
        // The keys are 0 if the tile has no vertices (`WarpTile::kind` lacks TILE_VERTICES).
        if (box[0] == 0) {
            return;
        }
        float axis_negated_min = 0.0f, axis_max = 0.0f;
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const float box_negated_min = ordered_to_float(box[i]), box_max = ordered_to_float(box[3 + i]);
            const bool is_nonnegative = axis[i] >= 0.0f;
            axis_negated_min = __fmaf_ru(fabsf(axis[i]), is_nonnegative ? box_negated_min : box_max, axis_negated_min);
            axis_max = __fmaf_ru(fabsf(axis[i]), is_nonnegative ? box_max : box_negated_min, axis_max);
        }
        extent_keys[0] = max(extent_keys[0], float_to_ordered(axis_negated_min));
        extent_keys[1] = max(extent_keys[1], float_to_ordered(axis_max));
    }

    // Reduces over the lanes of a warp with the same axis, i = lane % 4. Lanes 0 to 2 then write the maxima along axes
    // 0 to 2. All lanes must call this.
    __device__ __forceinline__ void reduce_into(unsigned* block_maxima) {
#pragma unroll
        for (unsigned extreme = 0; extreme < 2; ++extreme) {
#pragma unroll
            for (unsigned offset = 16; offset > 2; offset /= 2) {
                extent_keys[extreme] = max(extent_keys[extreme], __shfl_xor_sync(0xffffffffu, extent_keys[extreme], offset));
            }
            if (threadIdx.x % 32 < 3) {
                atomicMax(&block_maxima[3 * extreme + threadIdx.x % 32], extent_keys[extreme]);
            }
        }
    }
};
#endif

extern "C" __global__ void __launch_bounds__(BLOCK) bounds(const __grid_constant__ BoundsArgs args) {
    wait_for_prerequisite_grids();
    launch_dependent_grids();
#ifdef DOMAIN_BOXES
    compute_segment_boxes(args);
    __syncwarp();
#endif
    __shared__ unsigned block_maxima[KEY_COUNT];
    if (threadIdx.x < KEY_COUNT) {
        block_maxima[threadIdx.x] = 0;
    }
    __syncthreads();
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
#ifdef ORIENTED_BOUNDS
    OrientedExtent oriented_extent;
    oriented_extent.load_axis(args);
#endif
    for (unsigned box = blockIdx.x * BLOCK + threadIdx.x; box < args.box_count; box += gridDim.x * BLOCK) {
        const uint2* key_pairs = (const uint2*)(args.boxes + 6 * (size_t)box);
        unsigned box_keys[6];
#pragma unroll
        for (unsigned pair = 0; pair < 3; ++pair) {
            const uint2 key_pair = key_pairs[pair];
            box_keys[2 * pair] = key_pair.x;
            box_keys[2 * pair + 1] = key_pair.y;
        }
#pragma unroll
        for (unsigned side = 0; side < 6; ++side) {
            keys[side] = max(keys[side], box_keys[side]);
        }
#ifdef ORIENTED_BOUNDS
        oriented_extent.merge_tile(box_keys);
#endif
    }
#pragma unroll
    for (unsigned side = 0; side < 6; ++side) {
        const unsigned key = warp_max(keys[side]);
        if (threadIdx.x % 32 == side) {
            atomicMax(&block_maxima[side], key);
        }
    }
#ifdef ORIENTED_BOUNDS
    oriented_extent.reduce_into(block_maxima + 6);
#endif
    __syncthreads();
    // Compare before the atomic: the maximum in the header already exceeds the maxima of most blocks, so most contended
    // atomics are skipped. The value read may be stale, but the maximum only grows, so no update is lost.
    if (threadIdx.x < KEY_COUNT && block_maxima[threadIdx.x] > *(volatile unsigned*)(args.header->bounds + threadIdx.x)) {
        atomicMax(args.header->bounds + threadIdx.x, block_maxima[threadIdx.x]);
    }
}
