// The main kernel of a step: x = T (x0 + U q) for every vertex of every domain of a scene, and with ORIENT also the
// rigid normals and tangents of every corner. One launch covers all domains by a flat list of tiles. Also computes a
// bounding box of each warp's x.
//   tiles, lanes  the work of each warp (layout.cuh)                                                        (in)
//   words         U, per tile [chunks][3][width] words of 16 bytes (chunk.cuh)                              (in)
//   rest          x0, per tile of one domain [3][width][4] f32, per quad of a mixed tile [3][4]             (in)
//   rest_normals  rest normals in the same layout; with ORIENT                                              (in)
//   rest_tangents rest tangents likewise: x, y, z and the sign of the bitangent; with ORIENT, NORMAL_MAPS   (in)
//   corner_shifts with SHIFTED: per domain, offset from a vertex to its corner                              (in)
//   transforms    [movers][3] float4: the rows of world_from_domain, relative to the state's origin         (in)
//   following     with FOLLOWERS: per domain its transform root, and the index of its frame                 (in)
//   frames        [followers][3] float4: the rows of mover_from_domain, with FOLLOWERS; without, every domain is a
//                 transform root                                                                            (in)
//   q             packed coordinates; with STORE_F16 and STORE_BF16 multiplied by the factor of their mode  (in)
//   scales        with STORE_INT8: per tile of U and mode                                                   (in)
//   kept          with TRUNCATED: per domain the chunks to sum, ascending                                   (in)
//   list          with LISTED: the tiles to compute, their number is in the header; without, all tiles      (in)
//   positions     [vertices][3] f32, address in the header                                                  (out)
//   normals       [corners][3] f32, address in the header                                                   (out)
//   tangents      [corners] float4, address in the header                                                   (out)
//   displacements with DISPLACEMENTS: u, [vertices][3] f32 in the domain's frame, address in the header. With
//                 WITHOUT_POSITIONS, for benchmarks, the only output, and u is not recomputed in f64        (out)
//   boxes         [tiles][4][6] u32: `ordered` maxima of -x, -y, -z, x, y, z                                (out)
// Launch: WARPS warps per block; 4 / SPAN warps for each of `count` tiles, or any number of blocks with LISTED.
// CPU twin: src/compute/reference/deform.rs.
//
// Determinism: each vertex sums its modes in order, from +0, by fused multiply-adds, independent of the tile and the
// lane, so runs agree bit by bit. A result that is not finite in f32 is computed again in f64, so only values that f32
// cannot hold are lost. A displacement that is lost makes the box NaN, as a lost x does.
#include "chain.cuh"
#include "chunk.cuh"
#include "ordered.cuh"
#include "orient.cuh"

// Number of chunks that a lane loads before it sums the first.
#ifdef NARROW
#define AHEAD (16 / CHUNK_MODES)
#else
#define AHEAD 4
#endif
// Warps per block, and target number of resident blocks per multiprocessor. Fewer blocks would not saturate the memory,
// more would spill registers, so variants that need more registers have fewer blocks. Tiles with modes read long runs
// and are fastest in blocks of one warp.
#if defined(NARROW) && defined(MODES)
constexpr unsigned WARPS = 1;
#if defined(TRUNCATED) && defined(LISTED)
constexpr unsigned RESIDENT = 8;
#else
constexpr unsigned RESIDENT = 10;
#endif
#elif defined(SHEAR) || defined(LISTED)
constexpr unsigned WARPS = 1;
constexpr unsigned RESIDENT = 16;
#elif defined(MODES)
constexpr unsigned WARPS = 1;
#if defined(COMPENSATED) && defined(STORE_INT8)
constexpr unsigned RESIDENT = 16;
#elif defined(COMPENSATED) || (defined(ORIENT) && defined(STORE_INT8)) || \
    (defined(NORMAL_MAPS) && (defined(TRUNCATED) || defined(FOLLOWERS)))
constexpr unsigned RESIDENT = 20;
#elif defined(DISPLACEMENTS) && (defined(STORE_F16) || defined(STORE_BF16) || defined(STORE_INT8))
constexpr unsigned RESIDENT = 20;
#elif defined(DISPLACEMENTS) && defined(ORIENT)
constexpr unsigned RESIDENT = 24;
#elif defined(NORMAL_MAPS) || \
    (defined(ORIENT) && (defined(STORE_F16) || defined(STORE_BF16) || defined(FOLLOWERS))) || \
    (defined(TRUNCATED) && defined(STORE_INT8)) || __CUDA_ARCH__ < 900
constexpr unsigned RESIDENT = 24;
#else
constexpr unsigned RESIDENT = 28;
#endif
#else
constexpr unsigned WARPS = 2;
#if defined(DISPLACEMENTS) || (defined(ORIENT) && defined(FOLLOWERS))
constexpr unsigned RESIDENT = 12;
#else
constexpr unsigned RESIDENT = 16;
#endif
#endif

#ifdef MODES
// Factors of the entries of a chunk, one per mode.
struct Amounts {
    float of[CHUNK_MODES];
};

__device__ __forceinline__ Amounts amounts_of(const DeformArgs& args, const Part& part, unsigned chunk) {
    Amounts amounts;
#if defined(STORE_INT8)
    const float4 q = __ldg((const float4*)(args.q + part.first_q) + chunk);
    const float4 scale = __ldg((const float4*)(args.scales + part.first_scale) + chunk);
    amounts.of[0] = q.x * scale.x;
    amounts.of[1] = q.y * scale.y;
    amounts.of[2] = q.z * scale.z;
    amounts.of[3] = q.w * scale.w;
#elif defined(STORE_F16) || defined(STORE_BF16)
    const float2 q = __ldg((const float2*)(args.q + part.first_q) + chunk);
    amounts.of[0] = q.x;
    amounts.of[1] = q.y;
#else
    amounts.of[0] = __ldg(args.q + part.first_q + chunk);
#endif
    return amounts;
}

// Sums of products, three per vertex. COMPENSATED also accumulates the rounding errors (Ogita, Rump and Oishi,
// "Accurate sum and dot product", algorithm Dot2), which doubles the registers of the sums.
struct Sums {
    float of[FLOATS];
#ifdef COMPENSATED
    float lost[FLOATS];
#endif
    __device__ __forceinline__ void clear() {
#pragma unroll
        for (unsigned i = 0; i < FLOATS; ++i) {
            of[i] = 0.0f;
#ifdef COMPENSATED
            lost[i] = 0.0f;
#endif
        }
    }
    __device__ __forceinline__ void add(unsigned i, float entry, float amount) {
#ifdef COMPENSATED
        const float product = __fmul_rn(entry, amount), sum = __fadd_rn(of[i], product);
        const float taken = __fadd_rn(sum, -of[i]);
        const float left = __fadd_rn(__fadd_rn(of[i], -__fadd_rn(sum, -taken)), __fadd_rn(product, -taken));
        lost[i] = __fadd_rn(lost[i], __fadd_rn(left, fmaf(entry, amount, -product)));
        of[i] = sum;
#else
        of[i] = fmaf(entry, amount, of[i]);
#endif
    }
    __device__ __forceinline__ float total(unsigned i) const {
#ifdef COMPENSATED
        return of[i] + lost[i];
#else
        return of[i];
#endif
    }
};

#ifdef NARROW
struct Chunk {
    float entries[3 * CHUNK_MODES];
    __device__ __forceinline__ void load(const Part& part, const uint4* words) {
#pragma unroll
        for (unsigned i = 0; i < 3 * CHUNK_MODES; ++i) {
            entries[i] = entry_at(words, part.width, i / 3, i % 3, part.within);
        }
    }
    __device__ __forceinline__ float entry(unsigned mode, unsigned axis, unsigned) const { return entries[3 * mode + axis]; }
};
#else
struct Chunk {
    unsigned words[12];
    __device__ __forceinline__ void load(const Part& part, const uint4* from) {
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
        return entry_of(words, (mode * 3 + axis) * 4 + vertex);
    }
};
#endif

__device__ __forceinline__ void add_chunk(Sums& sums, const Chunk& chunk, const Amounts& amounts) {
#pragma unroll
    for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
#pragma unroll
            for (unsigned vertex = 0; vertex < SPAN; ++vertex) {
                sums.add(SPAN * axis + vertex, chunk.entry(mode, axis, vertex), amounts.of[mode]);
            }
        }
    }
}

// The chunks that a domain sums: all of them, or with TRUNCATED those on its list.
struct Chosen {
    unsigned count;
#ifdef TRUNCATED
    const unsigned short* list;
#endif
    __device__ __forceinline__ Chosen(const DeformArgs& args, const Part& part) : count(part.chunks) {
#ifdef TRUNCATED
        list = args.kept + part.first_q / CHUNK_MODES;
        count = part.chunks == 0 || part.count == 0 ? 0 : __ldg(args.kept_counts + part.domain);
#endif
    }
    __device__ __forceinline__ unsigned operator[](unsigned i) const {
#ifdef TRUNCATED
        return __ldg(list + i);
#else
        return i;
#endif
    }
};

// Adds `COUNT` chunks, from the i-th chosen chunk on. All are loaded before the first is summed.
template <unsigned COUNT>
__device__ __forceinline__ void sum_chunks(const DeformArgs& args, const Part& part, const Chosen& chosen, unsigned& i,
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
        add_chunk(sums, chunks[k], amounts_of(args, part, chosen[i + k]));
    }
    i += COUNT;
}

__device__ __forceinline__ void sum_modes(const DeformArgs& args, const Part& part, Sums& sums) {
    const Chosen chosen(args, part);
    unsigned i = 0;
    while (i + AHEAD <= chosen.count) {
        sum_chunks<AHEAD>(args, part, chosen, i, sums);
    }
    const unsigned left = chosen.count - i;
    if (AHEAD > 8 && left & 8) {
        sum_chunks<8>(args, part, chosen, i, sums);
    }
    if (AHEAD > 4 && left & 4) {
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
__device__ __forceinline__ void sum_exactly(const DeformArgs& args, const Part& part, unsigned vertex, double (&u)[3]) {
    for (unsigned axis = 0; axis < 3; ++axis) {
        u[axis] = 0.0;
#ifdef MODES
        const Chosen chosen(args, part);
        for (unsigned i = 0; i < chosen.count; ++i) {
            const Amounts amounts = amounts_of(args, part, chosen[i]);
            const uint4* words = args.words + part.first_word + part.quad + chosen[i] * 3 * (size_t)part.width;
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const double entry = entry_at(words, part.width, mode, axis, part.within + vertex);
                u[axis] += entry * (double)amounts.of[mode];
            }
        }
#endif
    }
}

// x of one vertex of this lane in f64, rounded once: recovers a result that is finite although an f32 intermediate
// overflowed.
__device__ __noinline__ float3 summed_exactly(const DeformArgs& args, unsigned tile, unsigned share, unsigned vertex) {
    const Part part = part_of(args, tile, share);
    const float* rest = first_of(args.rest, part, 3);
    double bent[3];
    sum_exactly(args, part, vertex, bent);
    for (unsigned axis = 0; axis < 3; ++axis) {
        bent[axis] = (double)rest[4 * axis * part.stride + vertex] + bent[axis];
    }
    return placed_exactly(transforms_of(args), part.domain, bent);
}

#if defined(DISPLACEMENTS) && defined(MODES)
// Recomputes u of one vertex in f64, in the output where the warp stored it before its last barrier. A component that
// is still not finite sets the box to NaN, because x itself may be finite.
__device__ __noinline__ void mend_displacement(const DeformArgs& args, unsigned tile, unsigned share, unsigned vertex,
                                               unsigned (&keys)[6]) {
    const Part part = part_of(args, tile, share);
    float* u = args.header->displacements + 3 * (size_t)(part.item + vertex);
    if (isfinite(u[0]) && isfinite(u[1]) && isfinite(u[2])) {
        return;
    }
    double exact[3];
    sum_exactly(args, part, vertex, exact);
    for (unsigned axis = 0; axis < 3; ++axis) {
        u[axis] = (float)exact[axis];
        if (!isfinite(u[axis])) {
            keys[axis] = keys[3 + axis] = 0xffffffffu;
        }
    }
}
#endif

// The six sides of the box of a lane's staged vertices, as keys. Vertices beyond `count` are replaced by the first one.
__device__ __forceinline__ void box_of(const float (&world)[FLOATS], unsigned count, unsigned (&keys)[6]) {
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        float low = world[axis], high = world[axis];
#pragma unroll
        for (unsigned vertex = 1; vertex < SPAN; ++vertex) {
            const float number = vertex < count ? world[3 * vertex + axis] : world[axis];
            low = fminf(low, number);
            high = fmaxf(high, number);
        }
        keys[axis] = ordered_number(-low);
        keys[3 + axis] = ordered_number(high);
    }
}

// Recomputes those of `count` staged vertices that are not finite, and the keys of their box: a NaN wins.
__device__ __noinline__ void mend(const DeformArgs& args, unsigned tile, unsigned share, float* numbers, unsigned count,
                                  unsigned (&keys)[6]) {
    for (unsigned side = 0; side < 6; ++side) {
        keys[side] = 0;
    }
    for (unsigned vertex = 0; vertex < count; ++vertex) {
        float* at = numbers + 3 * vertex;
        if (!isfinite(at[0]) || !isfinite(at[1]) || !isfinite(at[2])) {
            const float3 exact = summed_exactly(args, tile, share, vertex);
#if defined(DISPLACEMENTS) && defined(MODES)
            // If u is not finite in f32, neither is x, so u needs this check only here.
            mend_displacement(args, tile, share, vertex, keys);
#endif
            at[0] = exact.x;
            at[1] = exact.y;
            at[2] = exact.z;
        }
        for (unsigned axis = 0; axis < 3; ++axis) {
            keys[axis] = max(keys[axis], ordered(-at[axis]));
            keys[3 + axis] = max(keys[3 + axis], ordered(at[axis]));
        }
    }
}

// Shared memory of a warp: the stage of its outputs, and the boxes of lanes that recomputed vertices in f64.
struct Shared {
    Stage stage;
    unsigned mended[32][6];
};

// x0 and T of a lane's vertices.
struct Base {
    Items x, y, z;
    Affine t;
    __device__ __forceinline__ void load(const DeformArgs& args, const Part& part) {
        x = items_of(args.rest, part, 3, 0);
        y = items_of(args.rest, part, 3, 1);
        z = items_of(args.rest, part, 3, 2);
        t = place_of(transforms_of(args), part.domain);
    }
};

// World positions from the sums `bent`, [axis][vertex].
__device__ __forceinline__ void place(const DeformArgs& args, Shared& shared, const Part& part, unsigned tile,
                                      unsigned share, const Base& base, const float (&bent)[FLOATS]) {
    float world[FLOATS], total = 0.0f;
#pragma unroll
    for (unsigned i = 0; i < SPAN; ++i) {
        const float px = base.x.of[i] + bent[i], py = base.y.of[i] + bent[SPAN + i],
                    pz = base.z.of[i] + bent[2 * SPAN + i];
        world[3 * i] = placed(base.t.a, px, py, pz);
        world[3 * i + 1] = placed(base.t.b, px, py, pz);
        world[3 * i + 2] = placed(base.t.c, px, py, pz);
        // Remains zero unless a component is not finite.
        total = fmaf(0.0f, world[3 * i] + world[3 * i + 1] + world[3 * i + 2], total);
    }
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
    put(shared.stage, part, part.item, world);
    if (part.count > 0) {
        box_of(world, part.count, keys);
        if (total != 0.0f) {
            unsigned(&mended)[6] = shared.mended[lane_of()];
            mend(args, tile, share, staged(shared.stage) + FLOATS * lane_of(), part.count, mended);
#pragma unroll
            for (unsigned side = 0; side < 6; ++side) {
                keys[side] = mended[side];
            }
        }
    }
    store(args.header->positions, shared.stage, part);
    // A tile has four boxes. With four warps, each writes one; with one warp, it writes the same box four times.
    const unsigned key = warp_box(keys);
    if (lane_of() < 6 * SPAN) {
        args.boxes[24 * (size_t)tile + 6 * share + lane_of()] = key;
    }
}

#ifdef MODES
__device__ __forceinline__ void sum(const DeformArgs& args, const Part& part, float (&bent)[FLOATS]) {
    Sums sums;
    sums.clear();
    sum_modes(args, part, sums);
#pragma unroll
    for (unsigned i = 0; i < FLOATS; ++i) {
        bent[i] = sums.total(i);
    }
}
#endif

__device__ __forceinline__ void compute(const DeformArgs& args, Shared& shared, unsigned tile, unsigned share) {
    const Part part = part_of(args, tile, share);
#ifdef ORIENT
    Normals normals;
#endif
    if (part.kind & TILE_VERTICES) {
        float bent[FLOATS] = {};
        Base base;
#if defined(MODES) && defined(NARROW)
        base.load(args, part);
        sum(args, part, bent);
#elif defined(MODES)
        sum(args, part, bent);
#endif
#ifdef DISPLACEMENTS
        float u[FLOATS];
#pragma unroll
        for (unsigned i = 0; i < FLOATS; ++i) {
            u[i] = bent[i % 3 * SPAN + i / 3];
        }
        put(shared.stage, part, part.item, u);
        store(args.header->displacements, shared.stage, part);
#endif
#ifndef WITHOUT_POSITIONS
#if !(defined(MODES) && defined(NARROW))
        base.load(args, part);
#endif
#ifdef ORIENT
        // Load before the positions are stored, so that both transfers are in flight together.
        if (part.kind & TILE_CORNERS) {
            normals.load(args, part);
        }
#endif
        place(args, shared, part, tile, share, base, bent);
#endif
    }
#ifdef ORIENT
    if (part.kind & TILE_CORNERS) {
        if (!(part.kind & TILE_VERTICES)) {
            normals.load(args, part);
        }
        orient(args, shared.stage, part, normals);
    }
#endif
}

extern "C" __global__ void __launch_bounds__(32 * WARPS, RESIDENT) deform(const __grid_constant__ DeformArgs args) {
    admit_next();
    __shared__ Shared shared[WARPS];
    const unsigned warp = blockIdx.x * WARPS + threadIdx.x / 32;
#ifdef LISTED
    const unsigned warps = SHARE * __ldg(&args.header->stale);
    for (unsigned i = warp; i < warps; i += gridDim.x * WARPS) {
        compute(args, shared[threadIdx.x / 32], __ldg(args.list + i / SHARE), i % SHARE);
    }
#else
    if (warp < SHARE * args.count) {
        compute(args, shared[threadIdx.x / 32], warp / SHARE, warp % SHARE);
    }
#endif
}
