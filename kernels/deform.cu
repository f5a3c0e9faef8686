// The main kernel of a step: x = T (x0 + U q) for every vertex of every domain of a scene, and with RIGID_NORMALS also the
// rigid normals and tangents of every corner. One launch covers all domains by a flat list of tiles. Also computes a
// bounding box of each warp's x.
//   tiles, mixed_quads the work of each warp (layout.cuh)                                                        (in)
//   words         U, per tile [chunks][3][width] words of 16 bytes (chunk.cuh)                              (in)
//   rest          x0, per tile of one domain [3][width][4] f32, per quad of a mixed tile [3][4]             (in)
//   rest_normals  rest normals in the same layout; with RIGID_NORMALS                                              (in)
//   rest_tangents rest tangents likewise: x, y, z and the sign of the bitangent; with RIGID_NORMALS, NORMAL_MAPS   (in)
//   corner_offsets with CORNER_OFFSETS: per domain, offset from a vertex to its corner                              (in)
//   transforms    [roots][3] float4: the rows of world_from_domain, relative to the state's origin         (in)
//   transform_links with FOLLOWERS: per domain its transform root, and the index of its frame                 (in)
//   frames        [followers][3] float4: the rows of mover_from_domain, with FOLLOWERS; without, every domain is a
//                 transform root                                                                            (in)
//   q             packed coordinates; with STORE_F16 and STORE_BF16 multiplied by the factor of their mode  (in)
//   scales        with STORE_INT8: per tile of U and mode                                                   (in)
//   retained      with MODE_TRUNCATION: per domain the chunks to sum, ascending                                   (in)
//   tile_list     with TILE_LIST: the tiles to compute, their number is in the header; without, all tiles      (in)
//   positions     [vertices][3] f32, address in the header                                                  (out)
//   normals       [corners][3] f32, address in the header                                                   (out)
//   tangents      [corners] float4, address in the header                                                   (out)
//   displacements with DISPLACEMENTS: u, [vertices][3] f32 in the domain's frame, address in the header. With
//                 DISPLACEMENTS_ONLY, for benchmarks, the only output, and u is not recomputed in f64        (out)
//   boxes         [tiles][4][6] u32: `float_to_ordered` maxima of -x, -y, -z, x, y, z                                (out)
// Launch: WARPS warps per block; 4 / SPAN warps for each of `count` tiles, or any number of blocks with TILE_LIST.
// CPU twin: src/compute/reference/deform.rs.
//
// Determinism: each vertex sums its modes in order, from +0, by fused multiply-adds, independent of the tile and the
// lane, so runs agree bit by bit. A result that is not finite in f32 is computed again in f64, so only values that f32
// cannot hold are lost. A displacement that is lost makes the box NaN, as a lost x does.
#include "dependent_launch.cuh"
#include "chunk.cuh"
#include "ordered_float.cuh"
#include "rigid_normals.cuh"

// Number of chunks that a lane loads before it sums the first.
#ifdef ONE_ITEM_PER_LANE
#define PREFETCH_CHUNKS (16 / CHUNK_MODES)
#else
#define PREFETCH_CHUNKS 4
#endif
// Warps per block. Tiles with modes read long runs and are fastest in blocks of one warp.
#if defined(MODES) || defined(SHEAR) || defined(TILE_LIST)
constexpr unsigned WARPS = 1;
#else
constexpr unsigned WARPS = 2;
#endif
// The launcher defines MIN_BLOCKS_PER_SM, the number of resident blocks per multiprocessor for the variant and the
// architecture (src/compute/gpu/tables/occupancy.rs).

#ifdef MODES
// Factors of the entries of a chunk, one per mode.
struct ChunkWeights {
    float values[CHUNK_MODES];
};

__device__ __forceinline__ ChunkWeights load_chunk_weights(const DeformArgs& args, const LaneSlice& part, unsigned chunk) {
    ChunkWeights amounts;
#if defined(STORE_INT8)
    const float4 q = __ldg((const float4*)(args.q + part.first_q) + chunk);
    const float4 scale = __ldg((const float4*)(args.scales + part.first_scale) + chunk);
    amounts.values[0] = q.x * scale.x;
    amounts.values[1] = q.y * scale.y;
    amounts.values[2] = q.z * scale.z;
    amounts.values[3] = q.w * scale.w;
#elif defined(STORE_F16) || defined(STORE_BF16)
    const float2 q = __ldg((const float2*)(args.q + part.first_q) + chunk);
    amounts.values[0] = q.x;
    amounts.values[1] = q.y;
#else
    amounts.values[0] = __ldg(args.q + part.first_q + chunk);
#endif
    return amounts;
}

// Sums of products, three per vertex. COMPENSATED_SUM also accumulates the rounding errors (Ogita, Rump and Oishi,
// "Accurate sum and dot product", algorithm Dot2), which doubles the registers of the sums.
struct Sums {
    float values[FLOATS_PER_LANE];
#ifdef COMPENSATED_SUM
    float compensation[FLOATS_PER_LANE];
#endif
    __device__ __forceinline__ void clear() {
#pragma unroll
        for (unsigned i = 0; i < FLOATS_PER_LANE; ++i) {
            values[i] = 0.0f;
#ifdef COMPENSATED_SUM
            compensation[i] = 0.0f;
#endif
        }
    }
    __device__ __forceinline__ void add(unsigned i, float entry, float amount) {
#ifdef COMPENSATED_SUM
        const float product = __fmul_rn(entry, amount), sum = __fadd_rn(values[i], product);
        const float taken = __fadd_rn(sum, -values[i]);
        const float left = __fadd_rn(__fadd_rn(values[i], -__fadd_rn(sum, -taken)), __fadd_rn(product, -taken));
        compensation[i] = __fadd_rn(compensation[i], __fadd_rn(left, fmaf(entry, amount, -product)));
        values[i] = sum;
#else
        values[i] = fmaf(entry, amount, values[i]);
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

#ifdef ONE_ITEM_PER_LANE
struct Chunk {
    float entries[3 * CHUNK_MODES];
    __device__ __forceinline__ void load(const LaneSlice& part, const uint4* words) {
#pragma unroll
        for (unsigned i = 0; i < 3 * CHUNK_MODES; ++i) {
            entries[i] = load_entry(words, part.width, i / 3, i % 3, part.within);
        }
    }
    __device__ __forceinline__ float entry(unsigned mode, unsigned axis, unsigned) const { return entries[3 * mode + axis]; }
};
#else
struct Chunk {
    unsigned words[12];
    __device__ __forceinline__ void load(const LaneSlice& part, const uint4* from) {
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const uint4 word = __ldcs(from + i * part.width);
            words[4 * i] = word.x;
            words[4 * i + 1] = word.y;
            words[4 * i + 2] = word.z;
            words[4 * i + 3] = word.w;
        }
    }
    __device__ __forceinline__ float entry(unsigned mode, unsigned axis, unsigned vertex) const {
        return decode_entry(words, (mode * 3 + axis) * 4 + vertex);
    }
};
#endif

__device__ __forceinline__ void add_chunk(Sums& sums, const Chunk& chunk, const ChunkWeights& amounts) {
#pragma unroll
    for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
#pragma unroll
            for (unsigned vertex = 0; vertex < ITEMS_PER_LANE; ++vertex) {
                sums.add(ITEMS_PER_LANE * axis + vertex, chunk.entry(mode, axis, vertex), amounts.values[mode]);
            }
        }
    }
}

// The chunks that a domain sums: all of them, or with MODE_TRUNCATION those on its list.
struct ChunkIndices {
    unsigned count;
#ifdef MODE_TRUNCATION
    const unsigned short* list;
#endif
    __device__ __forceinline__ ChunkIndices(const DeformArgs& args, const LaneSlice& part) : count(part.chunks) {
#ifdef MODE_TRUNCATION
        list = args.retained + part.first_q / CHUNK_MODES;
        count = part.chunks == 0 || part.count == 0 ? 0 : __ldg(args.retained_counts + part.domain);
#endif
    }
    __device__ __forceinline__ unsigned operator[](unsigned i) const {
#ifdef MODE_TRUNCATION
        return __ldg(list + i);
#else
        return i;
#endif
    }
};

// Adds `COUNT` chunks, from the i-th chosen chunk on. All are loaded before the first is summed.
template <unsigned COUNT>
__device__ __forceinline__ void sum_chunks(const DeformArgs& args, const LaneSlice& part, const ChunkIndices& chosen, unsigned& i,
                                           Sums& sums) {
    const uint4* words = args.words + part.first_word + part.quad;
    const size_t step = 3 * (size_t)part.width;
    Chunk chunks[COUNT];
#pragma unroll
    for (unsigned k = 0; k < COUNT; ++k) {
        chunks[k].load(part, words + chosen[i + k] * step);
    }
#pragma unroll
    for (unsigned k = 0; k < COUNT; ++k) {
        add_chunk(sums, chunks[k], load_chunk_weights(args, part, chosen[i + k]));
    }
    i += COUNT;
}

__device__ __forceinline__ void sum_modes(const DeformArgs& args, const LaneSlice& part, Sums& sums) {
    const ChunkIndices chosen(args, part);
    unsigned i = 0;
    while (i + PREFETCH_CHUNKS <= chosen.count) {
        sum_chunks<PREFETCH_CHUNKS>(args, part, chosen, i, sums);
    }
    const unsigned left = chosen.count - i;
    if (PREFETCH_CHUNKS > 8 && left & 8) {
        sum_chunks<8>(args, part, chosen, i, sums);
    }
    if (PREFETCH_CHUNKS > 4 && left & 4) {
        sum_chunks<4>(args, part, chosen, i, sums);
    }
    if (left & 2) {
        sum_chunks<2>(args, part, chosen, i, sums);
    }
    if (left & 1) {
        sum_chunks<1>(args, part, chosen, i, sums);
    }
}
#endif

// u of one vertex of this lane in f64.
__device__ __forceinline__ void sum_modes_f64(const DeformArgs& args, const LaneSlice& part, unsigned vertex, double (&u)[3]) {
    for (unsigned axis = 0; axis < 3; ++axis) {
        u[axis] = 0.0;
#ifdef MODES
        const ChunkIndices chosen(args, part);
        for (unsigned i = 0; i < chosen.count; ++i) {
            const ChunkWeights amounts = load_chunk_weights(args, part, chosen[i]);
            const uint4* words = args.words + part.first_word + part.quad + chosen[i] * 3 * (size_t)part.width;
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const double entry = load_entry(words, part.width, mode, axis, part.within + vertex);
                u[axis] += entry * (double)amounts.values[mode];
            }
        }
#endif
    }
}

// x of one vertex of this lane in f64, rounded once: recovers a result that is finite although an f32 intermediate
// overflowed.
__device__ __noinline__ float3 position_f64(const DeformArgs& args, unsigned tile, unsigned share, unsigned vertex) {
    const LaneSlice part = load_lane_slice(args, tile, share);
    const float* rest = item_pointer(args.rest, part, 3);
    double bent[3];
    sum_modes_f64(args, part, vertex, bent);
    for (unsigned axis = 0; axis < 3; ++axis) {
        bent[axis] = (double)rest[4 * axis * part.stride + vertex] + bent[axis];
    }
    return transform_domain_point_f64(transforms_of(args), part.domain, bent);
}

#if defined(DISPLACEMENTS) && defined(MODES)
// Recomputes u of one vertex in f64, in the output where the warp stored it before its last barrier. A component that
// is still not finite sets the box to NaN, because x itself may be finite.
__device__ __noinline__ void repair_displacement(const DeformArgs& args, unsigned tile, unsigned share, unsigned vertex,
                                               unsigned (&keys)[6]) {
    const LaneSlice part = load_lane_slice(args, tile, share);
    float* u = args.header->displacements + 3 * (size_t)(part.item + vertex);
    if (isfinite(u[0]) && isfinite(u[1]) && isfinite(u[2])) {
        return;
    }
    double exact[3];
    sum_modes_f64(args, part, vertex, exact);
    for (unsigned axis = 0; axis < 3; ++axis) {
        u[axis] = (float)exact[axis];
        if (!isfinite(u[axis])) {
            keys[axis] = keys[3 + axis] = 0xffffffffu;
        }
    }
}
#endif

// The six sides of the box of a lane's staged vertices, as keys. Vertices beyond `count` are replaced by the first one.
__device__ __forceinline__ void lane_box_keys(const float (&world)[FLOATS_PER_LANE], unsigned count, unsigned (&keys)[6]) {
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        float low = world[axis], high = world[axis];
#pragma unroll
        for (unsigned vertex = 1; vertex < ITEMS_PER_LANE; ++vertex) {
            const float number = vertex < count ? world[3 * vertex + axis] : world[axis];
            low = fminf(low, number);
            high = fmaxf(high, number);
        }
        keys[axis] = non_nan_to_ordered(-low);
        keys[3 + axis] = non_nan_to_ordered(high);
    }
}

// Recomputes those of `count` staged vertices that are not finite, and the keys of their box: a NaN wins.
__device__ __noinline__ void repair_non_finite(const DeformArgs& args, unsigned tile, unsigned share, float* numbers, unsigned count,
                                  unsigned (&keys)[6]) {
    for (unsigned side = 0; side < 6; ++side) {
        keys[side] = 0;
    }
    for (unsigned vertex = 0; vertex < count; ++vertex) {
        float* at = numbers + 3 * vertex;
        if (!isfinite(at[0]) || !isfinite(at[1]) || !isfinite(at[2])) {
            const float3 exact = position_f64(args, tile, share, vertex);
#if defined(DISPLACEMENTS) && defined(MODES)
            // If u is not finite in f32, neither is x, so u needs this check only here.
            repair_displacement(args, tile, share, vertex, keys);
#endif
            at[0] = exact.x;
            at[1] = exact.y;
            at[2] = exact.z;
        }
        for (unsigned axis = 0; axis < 3; ++axis) {
            keys[axis] = max(keys[axis], float_to_ordered(-at[axis]));
            keys[3 + axis] = max(keys[3 + axis], float_to_ordered(at[axis]));
        }
    }
}

// Shared memory of a warp: the stage of its outputs, and the boxes of lanes that recomputed vertices in f64.
struct WarpShared {
    OutputStage stage;
    unsigned repaired_keys[32][6];
};

// x0 and T of a lane's vertices.
struct VertexInputs {
    LaneItems x, y, z;
    Affine t;
    __device__ __forceinline__ void load(const DeformArgs& args, const LaneSlice& part) {
        x = load_items(args.rest, part, 3, 0);
        y = load_items(args.rest, part, 3, 1);
        z = load_items(args.rest, part, 3, 2);
        t = load_transform(transforms_of(args), part.domain);
    }
};

// World positions from the sums `bent`, [axis][vertex].
__device__ __forceinline__ void write_positions(const DeformArgs& args, WarpShared& shared, const LaneSlice& part, unsigned tile,
                                      unsigned share, const VertexInputs& base, const float (&bent)[FLOATS_PER_LANE]) {
    float world[FLOATS_PER_LANE], total = 0.0f;
#pragma unroll
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        const float px = base.x.values[i] + bent[i], py = base.y.values[i] + bent[ITEMS_PER_LANE + i],
                    pz = base.z.values[i] + bent[2 * ITEMS_PER_LANE + i];
        world[3 * i] = transform_row(base.t.a, px, py, pz);
        world[3 * i + 1] = transform_row(base.t.b, px, py, pz);
        world[3 * i + 2] = transform_row(base.t.c, px, py, pz);
        // Remains zero unless a component is not finite.
        total = fmaf(0.0f, world[3 * i] + world[3 * i + 1] + world[3 * i + 2], total);
    }
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
    stage_triples(shared.stage, part, part.item, world);
    if (part.count > 0) {
        lane_box_keys(world, part.count, keys);
        if (total != 0.0f) {
            unsigned(&repaired_keys)[6] = shared.repaired_keys[lane_id()];
            repair_non_finite(args, tile, share, stage_data(shared.stage) + FLOATS_PER_LANE * lane_id(), part.count, repaired_keys);
#pragma unroll
            for (unsigned side = 0; side < 6; ++side) {
                keys[side] = repaired_keys[side];
            }
        }
    }
    store_stage(args.header->positions, shared.stage, part);
    // A tile has four boxes. With four warps, each writes one; with one warp, it writes the same box four times.
    const unsigned key = warp_box(keys);
    if (lane_id() < 6 * ITEMS_PER_LANE) {
        args.boxes[24 * (size_t)tile + 6 * share + lane_id()] = key;
    }
}

#ifdef MODES
__device__ __forceinline__ void sum(const DeformArgs& args, const LaneSlice& part, float (&bent)[FLOATS_PER_LANE]) {
    Sums sums;
    sums.clear();
    sum_modes(args, part, sums);
#pragma unroll
    for (unsigned i = 0; i < FLOATS_PER_LANE; ++i) {
        bent[i] = sums.total(i);
    }
}
#endif

__device__ __forceinline__ void compute_tile(const DeformArgs& args, WarpShared& shared, unsigned tile, unsigned share) {
    const LaneSlice part = load_lane_slice(args, tile, share);
#ifdef RIGID_NORMALS
    Normals normals;
#endif
    if (part.kind & TILE_VERTICES) {
        float bent[FLOATS_PER_LANE] = {};
        VertexInputs base;
#if defined(MODES) && defined(ONE_ITEM_PER_LANE)
        base.load(args, part);
        sum(args, part, bent);
#elif defined(MODES)
        sum(args, part, bent);
#endif
#ifdef DISPLACEMENTS
        float u[FLOATS_PER_LANE];
#pragma unroll
        for (unsigned i = 0; i < FLOATS_PER_LANE; ++i) {
            u[i] = bent[i % 3 * ITEMS_PER_LANE + i / 3];
        }
        stage_triples(shared.stage, part, part.item, u);
        store_stage(args.header->displacements, shared.stage, part);
#endif
#ifndef DISPLACEMENTS_ONLY
#if !(defined(MODES) && defined(ONE_ITEM_PER_LANE))
        base.load(args, part);
#endif
#ifdef RIGID_NORMALS
        // Load before the positions are stored, so that both transfers are in flight together.
        if (part.kind & TILE_CORNERS) {
            normals.load(args, part);
        }
#endif
        write_positions(args, shared, part, tile, share, base, bent);
#endif
    }
#ifdef RIGID_NORMALS
    if (part.kind & TILE_CORNERS) {
        if (!(part.kind & TILE_VERTICES)) {
            normals.load(args, part);
        }
        rigid_normals(args, shared.stage, part, normals);
    }
#endif
}

extern "C" __global__ void __launch_bounds__(32 * WARPS, MIN_BLOCKS_PER_SM) deform(const __grid_constant__ DeformArgs args) {
    launch_dependent_grids();
    __shared__ WarpShared shared[WARPS];
    const unsigned warp = blockIdx.x * WARPS + threadIdx.x / 32;
#ifdef TILE_LIST
    const unsigned warps = WARPS_PER_TILE * __ldg(&args.header->dirty_tiles);
    for (unsigned i = warp; i < warps; i += gridDim.x * WARPS) {
        compute_tile(args, shared[threadIdx.x / 32], __ldg(args.tile_list + i / WARPS_PER_TILE), i % WARPS_PER_TILE);
    }
#else
    if (warp < WARPS_PER_TILE * args.count) {
        compute_tile(args, shared[threadIdx.x / 32], warp / WARPS_PER_TILE, warp % WARPS_PER_TILE);
    }
#endif
}
