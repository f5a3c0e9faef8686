// The main kernel of a step: x = T (x0 + U q) for every vertex of every domain of a scene. With RIGID_NORMALS also the
// rigid normals and tangents of every corner: the rest normals and tangents, transformed by T without U q. Also
// computes four bounding boxes of x per tile. One launch covers all domains.
//
// A quad is four consecutive vertices or corners of a domain. A tile, the work of one warp (of four warps with
// ONE_ITEM_PER_LANE, of twelve with AXIS_PER_WARP), is up to 32 quads: of one domain, or of several small domains (a
// mixed tile). A chunk is a few modes.
//   tiles, mixed_quads  the tiles of all domains, and the quads of mixed tiles (layout.cuh)                      (in)
//   words            U, per tile [chunk][3][quad] words of 16 bytes (chunk.cuh)                                  (in)
//   rest_positions   x0, per tile of one domain [axis][quad][vertex in the quad] f32, per quad of a mixed tile
//                    [axis][vertex in the quad] f32                                                              (in)
//   rest_normals     with RIGID_NORMALS: rest normals in the same layout                                         (in)
//   rest_tangents    with RIGID_NORMALS and NORMAL_MAPS: rest tangents in the same layout, but with four
//                    components: x, y, z and the sign of the bitangent                                           (in)
//   corner_offsets   with CORNER_OFFSETS, [domains]: index of the first corner minus index of the first vertex   (in)
//   transforms       [roots][3] float4: the rows of T of each transform root, relative to its floating origin (an
//                    f64 point that stays on the host)                                                           (in)
//   transform_links  with FOLLOWERS, [domains]: the domain's transform root (the domain whose T it uses), and the
//                    index of its frame, or NO_FRAME for a root. Without FOLLOWERS, every domain is a root       (in)
//   follower_frames  with FOLLOWERS: [followers][3] float4, the rows of each follower's frame, its constant
//                    transform relative to its root                                                              (in)
//   q                the coordinates of all domains; with STORE_F16 and STORE_BF16 multiplied by the factor of
//                    their mode                                                                                  (in)
//   scales           with STORE_INT8: one scale per tile of U and mode                                           (in)
//   tile_list        with TILE_LIST: indices of the tiles to compute; their number is in the header              (in)
//   positions        [vertices][3] f32, address in the header                                                    (out)
//   normals          [corners][3] f32, address in the header                                                     (out)
//   tangents         [corners] float4, address in the header                                                     (out)
//   displacements    with DISPLACEMENTS: u, [vertices][3] f32 in the domain's frame, address in the header. With
//                    DISPLACEMENTS_ONLY (benchmarks) the only output, and u is not recomputed in f64             (out)
//   boxes            [tiles][4 boxes][6 keys] u32: `float_to_ordered` maxima of -x, -y, -z, x, y, z. Four warps of a
//                    tile write one box each; a single warp writes its box four times                            (out)
// Launch: WARPS warps per block, WARPS_PER_TILE * WARPS_PER_SLICE warps for each of `tile_count` tiles; with TILE_LIST
// any number of blocks.
// CPU twin: src/compute/reference/deform.rs.
// Further macros: MODES (a domain has modes), SHEAR (a transform may have shear or a non-uniform scale),
// ONE_ITEM_PER_LANE (a tile has four warps instead of one), AXIS_PER_WARP (with MODES, ONE_ITEM_PER_LANE and f32: each
// of these four warps is replaced by three, which sum one axis each) and COMPENSATED_SUM (described at `Sums`).
//
// Determinism: each vertex sums its modes in order, from +0, by fused multiply-adds, independent of the tile and the
// lane, so runs agree bit by bit. A result that is not finite in f32 is computed again in f64. An output that is still
// not finite exceeds the range of f32. Its box is then NaN, also if only a displacement is not finite.
#include "dependent_launch.cuh"
#include "chunk.cuh"
#include "ordered_float.cuh"
#include "rigid_normals.cuh"

// Number of chunks that a lane loads before it sums the first one. With one item per lane, a lane loads a quarter of
// the bytes per chunk, so it has registers for more chunks.
#ifdef ONE_ITEM_PER_LANE
#define PREFETCH_CHUNKS (16 / CHUNK_MODES)
#else
#define PREFETCH_CHUNKS 4
#endif
// Number of warps that share a slice (`LaneSlice`): with AXIS_PER_WARP, one for each axis.
#ifdef AXIS_PER_WARP
constexpr unsigned WARPS_PER_SLICE = 3;
#else
constexpr unsigned WARPS_PER_SLICE = 1;
#endif
// Warps per block. Twin: `block_threads` in src/compute/gpu/tables/kernels.rs. Tiles with modes read long contiguous
// ranges and are fastest in blocks of one warp.
#if defined(MODES) || defined(SHEAR) || defined(TILE_LIST)
constexpr unsigned WARPS = WARPS_PER_SLICE;
#else
constexpr unsigned WARPS = 2;
#endif
// The launcher defines MIN_BLOCKS_PER_SM, the number of resident blocks per multiprocessor for the variant and the
// architecture (src/compute/gpu/tables/occupancy.rs).

#ifdef MODES
// Per mode of a chunk, the weight of its entries in the sum: q, with STORE_INT8 multiplied by the scale of the tile.
struct ChunkWeights {
    float values[CHUNK_MODES];
};

__device__ __forceinline__ ChunkWeights load_chunk_weights(const DeformArgs& args, const LaneSlice& slice, unsigned chunk) {
    ChunkWeights weights;
#if defined(STORE_INT8)
    const float4 q = __ldg((const float4*)(args.q + slice.first_q) + chunk);
    const float4 scale = __ldg((const float4*)(args.scales + slice.first_scale) + chunk);
    weights.values[0] = q.x * scale.x;
    weights.values[1] = q.y * scale.y;
    weights.values[2] = q.z * scale.z;
    weights.values[3] = q.w * scale.w;
#elif defined(STORE_F16) || defined(STORE_BF16)
    const float2 q = __ldg((const float2*)(args.q + slice.first_q) + chunk);
    weights.values[0] = q.x;
    weights.values[1] = q.y;
#else
    weights.values[0] = __ldg(args.q + slice.first_q + chunk);
#endif
    return weights;
}

constexpr unsigned SUMS_PER_LANE = FLOATS_PER_LANE / WARPS_PER_SLICE;

// u of a lane's vertices, [axis][vertex]; with AXIS_PER_WARP only along the axis of the warp. COMPENSATED_SUM also
// accumulates the rounding errors (Ogita, Rump and Oishi, "Accurate sum and dot product", algorithm Dot2), which
// doubles the registers of the sums.
struct Sums {
    float values[SUMS_PER_LANE];
#ifdef COMPENSATED_SUM
    float compensation[SUMS_PER_LANE];
#endif
    __device__ __forceinline__ void clear() {
#pragma unroll
        for (unsigned i = 0; i < SUMS_PER_LANE; ++i) {
            values[i] = 0.0f;
#ifdef COMPENSATED_SUM
            compensation[i] = 0.0f;
#endif
        }
    }
    __device__ __forceinline__ void add(unsigned i, float entry, float weight) {
#ifdef COMPENSATED_SUM
        const float product = __fmul_rn(entry, weight), sum = __fadd_rn(values[i], product);
        const float rounded_product = __fadd_rn(sum, -values[i]);
        const float sum_error = __fadd_rn(__fadd_rn(values[i], -__fadd_rn(sum, -rounded_product)),
                                          __fadd_rn(product, -rounded_product));
        compensation[i] = __fadd_rn(compensation[i], __fadd_rn(sum_error, fmaf(entry, weight, -product)));
        values[i] = sum;
#else
        values[i] = fmaf(entry, weight, values[i]);
#endif
    }
    __device__ __forceinline__ float total(unsigned i) const {
#ifdef COMPENSATED_SUM
        return values[i] + compensation[i];
#else
        return values[i];
#endif
    }
};

#ifdef AXIS_PER_WARP
// Number of modes that a lane loads before it sums the first one. The latency of memory dominates the time of small
// scenes, so most of them should need one round. A group of modes beyond the last mode costs one branch.
constexpr unsigned ROUND_MODES = 32, GROUP_MODES = 8;

// Sums the modes of the warp's axis. QUADS is the number of quads of the tile, or 0 if it is not known at compile time.
template <unsigned QUADS>
__device__ __forceinline__ void sum_axis(const DeformArgs& args, const LaneSlice& slice, Sums& sums) {
    const unsigned quad_count = QUADS > 0 ? QUADS : slice.quad_count, axis = threadIdx.x / 32;
    const float* lane_entries =
        (const float*)(args.words + slice.first_word + axis * quad_count + slice.quad) + slice.item_in_quad;
    const float* domain_q = args.q + slice.first_q;
    // In f32, a chunk is one mode.
    for (unsigned first = 0; first < slice.chunk_count; first += ROUND_MODES) {
        const unsigned count = slice.chunk_count - first;
        const float *round_entries = lane_entries + (size_t)first * (12 * quad_count), *round_q = domain_q + first;
        float entries[ROUND_MODES], q[ROUND_MODES];
#pragma unroll
        for (unsigned group = 0; group < ROUND_MODES; group += GROUP_MODES) {
            if (group < count) {
#pragma unroll
                for (unsigned i = group; i < group + GROUP_MODES; ++i) {
                    if (i < count) {
                        entries[i] = __ldcs(round_entries + (size_t)i * (12 * quad_count));
                        q[i] = __ldg(round_q + i);
                    }
                }
            }
        }
#pragma unroll
        for (unsigned group = 0; group < ROUND_MODES; group += GROUP_MODES) {
            if (group < count) {
#pragma unroll
                for (unsigned i = group; i < group + GROUP_MODES; ++i) {
                    if (i < count) {
                        sums.add(0, entries[i], q[i]);
                    }
                }
            }
        }
    }
}

__device__ __forceinline__ void sum_modes(const DeformArgs& args, const LaneSlice& slice, Sums& sums) {
    // In a full tile, the addresses of the entries differ by constants.
    if (slice.quad_count == TILE_QUADS) {
        sum_axis<TILE_QUADS>(args, slice, sums);
    } else {
        sum_axis<0>(args, slice, sums);
    }
}
#else
// The entries of a chunk for a lane's items. `load` gets a pointer to the first of the three words of the lane's quad.
#ifdef ONE_ITEM_PER_LANE
struct Chunk {
    float entries[3 * CHUNK_MODES];
    __device__ __forceinline__ void load(const LaneSlice& slice, const uint4* words) {
#pragma unroll
        for (unsigned i = 0; i < 3 * CHUNK_MODES; ++i) {
            entries[i] = load_entry(words, slice.quad_count, i / 3, i % 3, slice.item_in_quad);
        }
    }
    __device__ __forceinline__ float entry(unsigned mode, unsigned axis, unsigned) const { return entries[3 * mode + axis]; }
};
#else
struct Chunk {
    unsigned registers[12];
    __device__ __forceinline__ void load(const LaneSlice& slice, const uint4* words) {
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const uint4 word = __ldcs(words + i * slice.quad_count);
            registers[4 * i] = word.x;
            registers[4 * i + 1] = word.y;
            registers[4 * i + 2] = word.z;
            registers[4 * i + 3] = word.w;
        }
    }
    __device__ __forceinline__ float entry(unsigned mode, unsigned axis, unsigned vertex) const {
        return decode_entry(registers, (mode * 3 + axis) * 4 + vertex);
    }
};
#endif

__device__ __forceinline__ void add_chunk(Sums& sums, const Chunk& chunk, const ChunkWeights& weights) {
#pragma unroll
    for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
#pragma unroll
            for (unsigned vertex = 0; vertex < ITEMS_PER_LANE; ++vertex) {
                sums.add(ITEMS_PER_LANE * axis + vertex, chunk.entry(mode, axis, vertex), weights.values[mode]);
            }
        }
    }
}

// Adds the next COUNT chunks, from chunk `i` on, and advances `i`. Loads all of them before it sums the first one.
template <unsigned COUNT>
__device__ __forceinline__ void sum_chunks(const DeformArgs& args, const LaneSlice& slice, unsigned& i, Sums& sums) {
    const uint4* words = args.words + slice.first_word + slice.quad;
    const size_t chunk_words = 3 * (size_t)slice.quad_count;
    Chunk chunks[COUNT];
#pragma unroll
    for (unsigned k = 0; k < COUNT; ++k) {
        chunks[k].load(slice, words + (i + k) * chunk_words);
    }
#pragma unroll
    for (unsigned k = 0; k < COUNT; ++k) {
        add_chunk(sums, chunks[k], load_chunk_weights(args, slice, i + k));
    }
    i += COUNT;
}

__device__ __forceinline__ void sum_modes(const DeformArgs& args, const LaneSlice& slice, Sums& sums) {
    unsigned i = 0;
    while (i + PREFETCH_CHUNKS <= slice.chunk_count) {
        sum_chunks<PREFETCH_CHUNKS>(args, slice, i, sums);
    }
    // Fewer than PREFETCH_CHUNKS chunks remain: one call for each bit of their number.
    const unsigned remaining_chunks = slice.chunk_count - i;
    if (PREFETCH_CHUNKS > 8 && remaining_chunks & 8) {
        sum_chunks<8>(args, slice, i, sums);
    }
    if (PREFETCH_CHUNKS > 4 && remaining_chunks & 4) {
        sum_chunks<4>(args, slice, i, sums);
    }
    if (remaining_chunks & 2) {
        sum_chunks<2>(args, slice, i, sums);
    }
    if (remaining_chunks & 1) {
        sum_chunks<1>(args, slice, i, sums);
    }
}
#endif
#endif

// Computes u of one vertex of this lane in f64. `vertex` is below ITEMS_PER_LANE.
__device__ __forceinline__ void sum_modes_f64(const DeformArgs& args, const LaneSlice& slice, unsigned vertex, double (&u)[3]) {
    for (unsigned axis = 0; axis < 3; ++axis) {
        u[axis] = 0.0;
#ifdef MODES
        for (unsigned chunk = 0; chunk < slice.chunk_count; ++chunk) {
            const ChunkWeights weights = load_chunk_weights(args, slice, chunk);
            const uint4* words = args.words + slice.first_word + slice.quad + chunk * 3 * (size_t)slice.quad_count;
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const double entry = load_entry(words, slice.quad_count, mode, axis, slice.item_in_quad + vertex);
                u[axis] += entry * (double)weights.values[mode];
            }
        }
#endif
    }
}

// Computes x of one vertex of this lane in f64 and rounds it once. The result can be finite although an intermediate
// value overflowed in f32.
__device__ __noinline__ float3 position_f64(const DeformArgs& args, unsigned tile, unsigned tile_warp, unsigned vertex) {
    const LaneSlice slice = load_lane_slice(args, tile, tile_warp);
    const float* rest_position = item_pointer(args.rest_positions, slice, 3);
    double point[3];
    sum_modes_f64(args, slice, vertex, point);
    for (unsigned axis = 0; axis < 3; ++axis) {
        point[axis] = (double)rest_position[4 * axis * slice.component_stride + vertex] + point[axis];
    }
    return transform_domain_point_f64(transforms_of(args), slice.domain, point);
}

#if defined(DISPLACEMENTS) && defined(MODES)
// Recomputes u of one vertex in f64 if the stored u is not finite. The warp stored u before its last barrier. If a
// component is still not finite, sets the keys of its axis to NaN, so that the box reports it: x itself may be finite.
__device__ __noinline__ void repair_displacement(const DeformArgs& args, unsigned tile, unsigned tile_warp, unsigned vertex,
                                               unsigned (&keys)[6]) {
    const LaneSlice slice = load_lane_slice(args, tile, tile_warp);
    float* u = args.header->displacements + 3 * (size_t)(slice.first_item + vertex);
    if (isfinite(u[0]) && isfinite(u[1]) && isfinite(u[2])) {
        return;
    }
    double u_f64[3];
    sum_modes_f64(args, slice, vertex, u_f64);
    for (unsigned axis = 0; axis < 3; ++axis) {
        u[axis] = (float)u_f64[axis];
        if (!isfinite(u[axis])) {
            keys[axis] = keys[3 + axis] = 0xffffffffu;
        }
    }
}
#endif

// Computes the bounding box of a lane's positions, as six `float_to_ordered` keys. Positions beyond `count` are
// replaced by the first position.
__device__ __forceinline__ void compute_lane_box_keys(const float (&positions)[FLOATS_PER_LANE], unsigned count,
                                                      unsigned (&keys)[6]) {
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        float box_min = positions[axis], box_max = positions[axis];
#pragma unroll
        for (unsigned vertex = 1; vertex < ITEMS_PER_LANE; ++vertex) {
            const float coordinate = vertex < count ? positions[3 * vertex + axis] : positions[axis];
            box_min = fminf(box_min, coordinate);
            box_max = fmaxf(box_max, coordinate);
        }
        keys[axis] = non_nan_to_ordered(-box_min);
        keys[3 + axis] = non_nan_to_ordered(box_max);
    }
}

// Recomputes in f64 those of a lane's `count` staged positions that are not finite. Then computes the keys of the
// lane's box. NaN has the largest key, so a position with a NaN gives a box with a NaN.
__device__ __noinline__ void repair_non_finite(const DeformArgs& args, unsigned tile, unsigned tile_warp,
                                               float* positions, unsigned count, unsigned (&keys)[6]) {
    for (unsigned side = 0; side < 6; ++side) {
        keys[side] = 0;
    }
    for (unsigned vertex = 0; vertex < count; ++vertex) {
        float* position = positions + 3 * vertex;
        if (!isfinite(position[0]) || !isfinite(position[1]) || !isfinite(position[2])) {
            const float3 repaired_position = position_f64(args, tile, tile_warp, vertex);
#if defined(DISPLACEMENTS) && defined(MODES)
            // If u is not finite in f32, then x is not finite either. So it suffices to check u here.
            repair_displacement(args, tile, tile_warp, vertex, keys);
#endif
            position[0] = repaired_position.x;
            position[1] = repaired_position.y;
            position[2] = repaired_position.z;
        }
        for (unsigned axis = 0; axis < 3; ++axis) {
            keys[axis] = max(keys[axis], float_to_ordered(-position[axis]));
            keys[3 + axis] = max(keys[3 + axis], float_to_ordered(position[axis]));
        }
    }
}

// Shared memory of a warp: its staging buffer, and per lane the box keys that `repair_non_finite` computes.
struct WarpShared {
    OutputStaging staging;
    unsigned repaired_keys[32][6];
};

// x0 and T of a lane's vertices, and the address of the output, which is loaded with them so that the stores do not
// wait for it.
struct VertexInputs {
    LaneItems x, y, z;
    Affine t;
    float* output;
    __device__ __forceinline__ void load(const DeformArgs& args, const LaneSlice& slice) {
        output = args.header->positions;
        x = load_items(args.rest_positions, slice, 3, 0);
        y = load_items(args.rest_positions, slice, 3, 1);
        z = load_items(args.rest_positions, slice, 3, 2);
        t = load_transform(transforms_of(args), slice.domain);
    }
};

// Transforms x0 + u of a lane's vertices, and stores the positions and their box. `displacements` is u, [axis][vertex].
__device__ __forceinline__ void write_positions(const DeformArgs& args, WarpShared& shared, const LaneSlice& slice,
                                                unsigned tile, unsigned tile_warp, const VertexInputs& inputs,
                                                const float (&displacements)[FLOATS_PER_LANE]) {
    float positions[FLOATS_PER_LANE], non_finite_flag = 0.0f;
#pragma unroll
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        const float px = inputs.x.values[i] + displacements[i], py = inputs.y.values[i] + displacements[ITEMS_PER_LANE + i],
                    pz = inputs.z.values[i] + displacements[2 * ITEMS_PER_LANE + i];
        positions[3 * i] = transform_row(inputs.t.row0, px, py, pz);
        positions[3 * i + 1] = transform_row(inputs.t.row1, px, py, pz);
        positions[3 * i + 2] = transform_row(inputs.t.row2, px, py, pz);
        // Remains zero unless a component is not finite.
        non_finite_flag = fmaf(0.0f, positions[3 * i] + positions[3 * i + 1] + positions[3 * i + 2], non_finite_flag);
    }
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
    stage_triples(shared.staging, slice, slice.first_item, positions);
    if (slice.item_count > 0) {
        compute_lane_box_keys(positions, slice.item_count, keys);
        if (non_finite_flag != 0.0f) {
            unsigned(&repaired_keys)[6] = shared.repaired_keys[lane_id()];
            repair_non_finite(args, tile, tile_warp, staged_floats(shared.staging) + FLOATS_PER_LANE * lane_id(),
                              slice.item_count, repaired_keys);
#pragma unroll
            for (unsigned side = 0; side < 6; ++side) {
                keys[side] = repaired_keys[side];
            }
        }
    }
    store_staged_triples(inputs.output, shared.staging, slice);
    // A tile has four boxes of six keys. Each of four warps writes one box; a single warp writes its box four times.
    const unsigned key = reduce_box_keys(keys);
    if (lane_id() < 6 * ITEMS_PER_LANE) {
        args.boxes[24 * (size_t)tile + 6 * tile_warp + lane_id()] = key;
    }
}

#ifdef MODES
__device__ __forceinline__ void compute_displacements(const DeformArgs& args, const LaneSlice& slice,
                                                      float (&displacements)[FLOATS_PER_LANE]) {
    Sums sums;
    sums.clear();
    sum_modes(args, slice, sums);
#ifdef AXIS_PER_WARP
    __shared__ float axis_displacements[3][32];
    axis_displacements[threadIdx.x / 32][lane_id()] = sums.total(0);
    __syncthreads();
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        displacements[axis] = axis_displacements[axis][lane_id()];
    }
#else
#pragma unroll
    for (unsigned i = 0; i < FLOATS_PER_LANE; ++i) {
        displacements[i] = sums.total(i);
    }
#endif
}
#endif

// With AXIS_PER_WARP, the first warp of a block writes positions and displacements, and the second one normals and
// tangents.
__device__ __forceinline__ bool writes_vertices() {
    return WARPS_PER_SLICE == 1 || threadIdx.x / 32 == 0;
}

__device__ __forceinline__ bool writes_corners() {
    return WARPS_PER_SLICE == 1 || threadIdx.x / 32 == 1;
}

#ifdef DISPLACEMENTS
// `displacements` is u, [axis][vertex].
__device__ __forceinline__ void write_displacements(const DeformArgs& args, WarpShared& shared, const LaneSlice& slice,
                                                    const float (&displacements)[FLOATS_PER_LANE]) {
    // Transpose u to [vertex][axis].
    float u[FLOATS_PER_LANE];
#pragma unroll
    for (unsigned i = 0; i < FLOATS_PER_LANE; ++i) {
        u[i] = displacements[i % 3 * ITEMS_PER_LANE + i / 3];
    }
    stage_triples(shared.staging, slice, slice.first_item, u);
    store_staged_triples(args.header->displacements, shared.staging, slice);
}
#endif

__device__ __forceinline__ void compute_tile(const DeformArgs& args, WarpShared& shared, unsigned tile, unsigned tile_warp) {
    const LaneSlice slice = load_lane_slice(args, tile, tile_warp);
#ifdef RIGID_NORMALS
    RestNormals normals;
#endif
    if (slice.kind & TILE_VERTICES) {
        float displacements[FLOATS_PER_LANE] = {};
        VertexInputs inputs;
#if defined(MODES) && defined(ONE_ITEM_PER_LANE)
        // With one item per lane, a lane has registers to load x0 and T before the sum.
        if (writes_vertices()) {
            inputs.load(args, slice);
        }
#endif
#ifdef MODES
        compute_displacements(args, slice, displacements);
#endif
#ifdef DISPLACEMENTS
        if (writes_vertices()) {
            write_displacements(args, shared, slice, displacements);
        }
#endif
#ifndef DISPLACEMENTS_ONLY
#if !(defined(MODES) && defined(ONE_ITEM_PER_LANE))
        inputs.load(args, slice);
#endif
#ifdef RIGID_NORMALS
        // Load the rest normals before the positions are stored, so that both transfers are in flight together.
        if (writes_corners() && slice.kind & TILE_CORNERS) {
            normals.load(args, slice);
        }
#endif
        if (writes_vertices()) {
            write_positions(args, shared, slice, tile, tile_warp, inputs, displacements);
        }
#endif
    }
#ifdef RIGID_NORMALS
    if (writes_corners() && slice.kind & TILE_CORNERS) {
        if (!(slice.kind & TILE_VERTICES)) {
            normals.load(args, slice);
        }
        write_rigid_directions(args, shared.staging, slice, normals);
    }
#endif
}

extern "C" __global__ void __launch_bounds__(32 * WARPS, MIN_BLOCKS_PER_SM) deform(const __grid_constant__ DeformArgs args) {
    launch_dependent_grids();
    __shared__ WarpShared shared[WARPS];
    // Warps with the same vertices have the same index.
    const unsigned warp = (blockIdx.x * WARPS + threadIdx.x / 32) / WARPS_PER_SLICE;
#ifdef TILE_LIST
    const unsigned warp_count = WARPS_PER_TILE * __ldg(&args.header->dirty_tile_count);
    for (unsigned i = warp; i < warp_count; i += gridDim.x * WARPS) {
        compute_tile(args, shared[threadIdx.x / 32], __ldg(args.tile_list + i / WARPS_PER_TILE), i % WARPS_PER_TILE);
    }
#else
    if (warp < WARPS_PER_TILE * args.tile_count) {
        compute_tile(args, shared[threadIdx.x / 32], warp / WARPS_PER_TILE, warp % WARPS_PER_TILE);
    }
#endif
}
