// x = T_b (x0 + U q_b) for up to VECTORS domains b of one shape: U is read once for all of them. Only trials use it.
//   words      U, per tile [chunks][3][width] words of 16 bytes (chunk.cuh)                             (in)
//   rest       x0, [quads][12] f32: 4 x, 4 y, 4 z                                                       (in)
//   scales     with STORE_INT8: [tiles][modes], whole chunks of modes                                   (in)
//   transforms [VECTORS][3] float4: the rows of T; zeros where there is no domain                       (in)
//   q          [modes][VECTORS], times the factor of the mode with STORE_F16 and STORE_BF16; likewise   (in)
//   positions  [vertices][3] f32; domain b begins at vertex `first[b]`                                  (out)
// Launch: a block of WARPS warps for each tile, with shared memory for WARPS Own, T and q (src/gpu/trials/batch.rs).
// CPU twin: the tests of src/gpu/trials/batch.rs.
//
// The modes are summed in their order, from +0, by fused multiply-adds, as `deform` does: the same bits. What is not
// finite in f32 is computed again in f64.
//
// Why it looks like this, for 16 vectors, n vertices, r modes, per warp and mode. The product needs 48 multiply-adds a
// vertex. Loads from shared memory bring 128 bytes a cycle to a multiprocessor, and it issues 4 instructions a cycle. A
// lane of one vertex would load 16 + 3 numbers for 48 multiply-adds: 19 cycles of loads against 12 of arithmetic. A lane
// of two loads 16 + 6 for 96: 22 cycles (no more with 2 byte entries, whose 16 bytes of a quad are half used) against
// 24 of arithmetic, so both fit. It has 96 sums and about 128 registers: 16 warps a multiprocessor. So few warps keep
// the memory busy only if loads in flight need no registers: U goes to shared memory by asynchronous copies,
// STAGES * 3 KB a warp ahead, 144 KB a multiprocessor, where a latency of 1 us at 5 TB/s needs 38 KB.
#include "chunk.cuh"
#include "layout.cuh"

#if defined(BATCH_4)
constexpr unsigned VECTORS = 4;
#elif defined(BATCH_8)
constexpr unsigned VECTORS = 8;
#else
constexpr unsigned VECTORS = 16;
#endif
constexpr unsigned MOST = 16;
// Blocks that a multiprocessor is to hold: as many as registers allow, where shared memory is as large as that.
#if __CUDA_ARCH__ == 900
constexpr unsigned RESIDENT = VECTORS == 16 ? 8 : 10;
#elif __CUDA_ARCH__ == 800 || __CUDA_ARCH__ == 1000
// Three warps a scheduler: its compiler needs more registers.
constexpr unsigned RESIDENT = 6;
#else
constexpr unsigned RESIDENT = 4;
#endif

// A warp has half a tile: 16 quads, two vertices a lane.
constexpr unsigned WARPS = 2;
constexpr unsigned QUADS = TILE_QUADS / WARPS;
constexpr unsigned VERTICES = 4 * QUADS;
// Chunks that are copied together, and such stages that are on their way at once.
constexpr unsigned STAGE_CHUNKS = 4;
constexpr unsigned STAGES = 3;
constexpr unsigned ROWS = 3 * STAGE_CHUNKS;
constexpr unsigned STAGE_WORDS = ROWS * QUADS;
// Chunks whose loads and sums are interleaved: two modes at least.
constexpr unsigned TOGETHER = CHUNK_MODES < 2 ? 2 : 1;

// Twin: src/gpu/trials/batch.rs.
struct BatchArgs {
    const uint4* words;
    const float4* rest;
    const float* scales;
    const float4* transforms;
    const float4* q;
    float* positions;
    unsigned first[MOST]; // packed vertex of each domain
    unsigned domains;
    unsigned vertices; // of the shape
    unsigned chunks;
    unsigned aligned; // whether every domain begins at 16 bytes
};
static_assert(sizeof(BatchArgs) == 128, "BatchArgs differs from src/gpu/trials/batch.rs");

// What a warp has of shared memory: a ring of stages, which leaves when x comes, and x0.
struct Own {
    uint4 ring[STAGES * STAGE_WORDS];
    float4 rest[3 * QUADS];
};
static_assert(sizeof(Own) == 9984, "Own differs from src/gpu/trials/batch.rs");

__device__ __forceinline__ unsigned lane_of() {
    return threadIdx.x % 32;
}

// 16 bytes to shared memory, if they are there; the lane waits for them in `wait_for_all_but`.
__device__ __forceinline__ void copy(void* to, const void* from, bool is_there) {
#if __CUDA_ARCH__ >= 800
    const unsigned shared = (unsigned)__cvta_generic_to_shared(to);
    asm volatile("{ .reg .pred there; setp.ne.u32 there, %2, 0; @there cp.async.cg.shared.global [%0], [%1], 16; }" ::"r"(
                     shared),
                 "l"(from), "r"((unsigned)is_there)
                 : "memory");
#else
    if (is_there) {
        *(uint4*)to = __ldcs((const uint4*)from);
    }
#endif
}

// Ends a group of copies.
__device__ __forceinline__ void end_group() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.commit_group;" ::: "memory");
#endif
}

// Until the warp sees all groups but the last `GROUPS`.
template <unsigned GROUPS>
__device__ __forceinline__ void wait_for_all_but() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_group %0;" ::"n"(GROUPS) : "memory");
#endif
    __syncwarp();
}

// A warp's part of a tile.
struct Part {
    const uint4* words; // of its first quad
    unsigned width;     // quads of the tile
    unsigned quads;     // of the part; 0 without any
    unsigned rest;      // its first quad
    unsigned first;     // its first vertex in the shape
    unsigned vertices;
};

__device__ __forceinline__ Part part_of(const BatchArgs& args) {
    const unsigned before = QUADS * (threadIdx.x / 32), tile = TILE_QUADS * blockIdx.x;
    Part part;
    part.width = min(TILE_QUADS, (args.vertices + 3) / 4 - tile);
    part.quads = part.width > before ? min(QUADS, part.width - before) : 0;
    part.rest = tile + before;
    part.first = 4 * part.rest;
    part.vertices = part.quads > 0 ? min(VERTICES, args.vertices - part.first) : 0;
    part.words = args.words + 3 * (size_t)args.chunks * tile + before;
    return part;
}

// Starts the copies of a stage, [row][quad]. Lanes beyond the last quad copy that one again.
__device__ __forceinline__ void copy_stage(const BatchArgs& args, const Part& part, Own& own, unsigned stage) {
    const unsigned row = ROWS * stage + lane_of() / QUADS;
    const uint4* from = part.words + (size_t)row * part.width + min(lane_of() % QUADS, part.quads - 1);
    uint4* to = own.ring + stage % STAGES * STAGE_WORDS + lane_of();
#pragma unroll
    for (unsigned i = 0; i < STAGE_WORDS / 32; ++i) {
        copy(to + 32 * i, from + i * (32 / QUADS) * part.width, row + i * (32 / QUADS) < 3 * args.chunks);
    }
}

__device__ __forceinline__ void copy_rest(const BatchArgs& args, const Part& part, Own& own) {
#pragma unroll
    for (unsigned i = lane_of(); i < lane_of() + 3 * QUADS; i += 32) {
        copy(own.rest + i, args.rest + 3 * (size_t)part.rest + min(i, 3 * part.quads - 1), i < 3 * QUADS);
    }
}

// T and q, the same for all of a block; q times the tile's scales.
__device__ __forceinline__ void load_values(const BatchArgs& args, float4* transforms, float4* q) {
    for (unsigned i = threadIdx.x; i < 3 * VECTORS; i += 32 * WARPS) {
        transforms[i] = __ldg(args.transforms + i);
    }
    const unsigned modes = args.chunks * CHUNK_MODES;
#pragma unroll 1
    for (unsigned i = threadIdx.x; i < modes * (VECTORS / 4); i += 32 * WARPS) {
        float4 four = __ldg(args.q + i);
#ifdef STORE_INT8
        const float scale = __ldg(args.scales + (size_t)blockIdx.x * modes + i / (VECTORS / 4));
        four.x *= scale;
        four.y *= scale;
        four.z *= scale;
        four.w *= scale;
#endif
        q[i] = four;
    }
}

// One axis of a lane's two vertices.
struct Pair {
    float of[2];
};

// Those of group `group` (mode * 3 + axis) of a chunk. `chunk` is the lane's first byte there.
__device__ __forceinline__ Pair pair_at(const char* chunk, unsigned group) {
    const unsigned byte = 4 * ENTRY_BYTES * group;
    const char* at = chunk + byte / 16 * (16 * QUADS) + byte % 16;
    unsigned words[12] = {};
#if defined(STORE_INT8)
    words[0] = *(const unsigned short*)at;
#elif defined(STORE_F16) || defined(STORE_BF16)
    words[0] = *(const unsigned*)at;
#else
    const uint2 both = *(const uint2*)at;
    words[0] = both.x;
    words[1] = both.y;
#endif
    Pair pair;
    pair.of[0] = entry_of(words, 0);
#if defined(STORE_F16)
    // Straight from the upper half, without a shift.
    asm("{ .reg .b16 low, high; mov.b32 {low, high}, %1; cvt.f32.f16 %0, high; }" : "=f"(pair.of[1]) : "r"(words[0]));
#else
    pair.of[1] = entry_of(words, 1);
#endif
    return pair;
}

// [2 * axis + vertex][domain]
typedef float Sums[6][VECTORS];

__device__ __forceinline__ void add_four(Sums& sums, unsigned first, const Pair (&pairs)[3], const float4& q) {
    const float amounts[4] = {q.x, q.y, q.z, q.w};
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
#pragma unroll
        for (unsigned k = 0; k < 4; ++k) {
            sums[i][first + k] = fmaf(pairs[i / 2].of[i % 2], amounts[k], sums[i][first + k]);
        }
    }
}

__device__ __forceinline__ void add_chunk(Sums& sums, const char* chunk, const float4* q) {
#pragma unroll
    for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
        const Pair pairs[3] = {pair_at(chunk, 3 * mode), pair_at(chunk, 3 * mode + 1), pair_at(chunk, 3 * mode + 2)};
#pragma unroll
        for (unsigned four = 0; four < VECTORS / 4; ++four) {
            add_four(sums, 4 * four, pairs, q[mode * (VECTORS / 4) + four]);
        }
    }
}

// All modes, stage by stage; the ring is full when this begins.
__device__ __forceinline__ void sum_modes(const BatchArgs& args, const Part& part, Own& own, const float4* q,
                                          Sums& sums) {
    const unsigned offset = 16 * (lane_of() / 2) + 2 * ENTRY_BYTES * (lane_of() % 2);
    const unsigned stages = (args.chunks + STAGE_CHUNKS - 1) / STAGE_CHUNKS;
#pragma unroll 1
    for (unsigned stage = 0; stage < stages; ++stage) {
        wait_for_all_but<STAGES - 1>();
        const char* chunk = (const char*)(own.ring + stage % STAGES * STAGE_WORDS) + offset;
        const unsigned count = min(STAGE_CHUNKS, args.chunks - STAGE_CHUNKS * stage);
#pragma unroll TOGETHER
        for (unsigned i = 0; i < count; ++i) {
            add_chunk(sums, chunk, q);
            chunk += 3 * 16 * QUADS;
            q += CHUNK_MODES * (VECTORS / 4);
        }
        __syncwarp();
        if (stage + STAGES < stages) {
            copy_stage(args, part, own, stage + STAGES);
        }
        end_group();
    }
}

__device__ __forceinline__ float placed(const float4& row, float x, float y, float z) {
    return fmaf(row.x, x, fmaf(row.y, y, fmaf(row.z, z, row.w)));
}

// x0 of a lane's two vertices.
struct Base {
    float2 x, y, z;
    __device__ __forceinline__ void load(const Own& own) {
        const float* from = (const float*)(own.rest + 3 * (lane_of() / 2)) + 2 * (lane_of() % 2);
        x = *(const float2*)from;
        y = *(const float2*)(from + 4);
        z = *(const float2*)(from + 8);
    }
};

// Puts x of a lane's two vertices at its place of a stage, [vertex][3]. `total` stays zero while all are finite.
__device__ __forceinline__ void stage_domain(const Base& base, const float4* rows, const Sums& sums, unsigned domain,
                                             float* staged, float& total) {
    const float4 a = rows[0], b = rows[1], c = rows[2];
    float world[6];
#pragma unroll
    for (unsigned i = 0; i < 2; ++i) {
        const float px = (i ? base.x.y : base.x.x) + sums[i][domain], py = (i ? base.y.y : base.y.x) + sums[2 + i][domain],
                    pz = (i ? base.z.y : base.z.x) + sums[4 + i][domain];
        world[3 * i] = placed(a, px, py, pz);
        world[3 * i + 1] = placed(b, px, py, pz);
        world[3 * i + 2] = placed(c, px, py, pz);
    }
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        total = fmaf(0.0f, world[2 * i], fmaf(0.0f, world[2 * i + 1], total));
        ((float2*)staged)[3 * lane_of() + i] = make_float2(world[2 * i], world[2 * i + 1]);
    }
}

// Writes what two domains staged, 48 words of 16 bytes each.
__device__ __forceinline__ void store_both(float* first, float* second, const float4* staged) {
    const unsigned lane = lane_of();
    float4 *low = (float4*)first, *high = (float4*)second;
    __stcs(low + lane, staged[lane]);
    __stcs(lane < 16 ? low + 32 + lane : high + lane - 16, staged[32 + lane]);
    __stcs(high + 16 + lane, staged[64 + lane]);
}

__device__ __forceinline__ float* place_of(const BatchArgs& args, const Part& part, unsigned domain) {
    return args.positions + 3 * ((size_t)args.first[domain] + part.first);
}

// The same, number by number.
__device__ __forceinline__ void store_numbers(const BatchArgs& args, const Part& part, unsigned domain,
                                              const float* staged) {
    const unsigned numbers = 3 * part.vertices;
#pragma unroll 1
    for (unsigned i = 0; i < 2 && domain + i < args.domains; ++i) {
#pragma unroll 1
        for (unsigned k = lane_of(); k < numbers; k += 32) {
            __stcs(place_of(args, part, domain + i) + k, staged[i * 3 * VERTICES + k]);
        }
    }
}

// Two domains at a time, by turns through two halves of the ring: lanes write when all have read what was there.
__device__ __forceinline__ void place(const BatchArgs& args, const Part& part, Own& own, const float4* transforms,
                                      const Sums& sums, float& total) {
    Base base;
    base.load(own);
    const bool is_whole = args.aligned && part.vertices == VERTICES;
#pragma unroll
    for (unsigned domain = 0; domain < VECTORS; domain += 2) {
        if (domain < args.domains) {
            float* staged = (float*)own.ring + domain / 2 % 2 * (2 * 3 * VERTICES);
#pragma unroll
            for (unsigned i = 0; i < 2; ++i) {
                stage_domain(base, transforms + 3 * (domain + i), sums, domain + i, staged + i * 3 * VERTICES, total);
            }
            __syncwarp();
            if (is_whole && domain + 1 < args.domains) {
                store_both(place_of(args, part, domain), place_of(args, part, domain + 1), (const float4*)staged);
            } else {
                store_numbers(args, part, domain, staged);
            }
        }
    }
}

// x of one vertex of this lane in f64, rounded once.
__device__ __noinline__ float3 placed_exactly(const BatchArgs& args, const float4* transforms, const float* q,
                                              unsigned vertex) {
    const Part part = part_of(args);
    const unsigned quad = lane_of() / 2, within = 2 * (lane_of() % 2) + vertex;
    double bent[3];
    for (unsigned axis = 0; axis < 3; ++axis) {
        double sum = 0.0;
        for (unsigned chunk = 0; chunk < args.chunks; ++chunk) {
            const uint4* words = part.words + quad + chunk * 3 * (size_t)part.width;
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const float amount = q[(chunk * CHUNK_MODES + mode) * VECTORS];
                sum += (double)entry_at(words, part.width, mode, axis, within) * (double)amount;
            }
        }
        bent[axis] = (double)((const float*)(args.rest + 3 * (size_t)(part.rest + quad)))[4 * axis + within] + sum;
    }
    float placed[3];
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float4 row = transforms[axis];
        placed[axis] = (float)(row.x * bent[0] + row.y * bent[1] + row.z * bent[2] + row.w);
    }
    return make_float3(placed[0], placed[1], placed[2]);
}

// Computes anew what this lane's vertices have that is not finite, and writes it over what the warp wrote.
__device__ __noinline__ void mend(const BatchArgs& args, const float4* transforms, const float* q) {
    const Part part = part_of(args);
    const unsigned before = 2 * lane_of();
    for (unsigned domain = 0; domain < args.domains; ++domain) {
        for (unsigned vertex = 0; vertex < 2 && before + vertex < part.vertices; ++vertex) {
            float* at = place_of(args, part, domain) + 3 * (before + vertex);
            if (!isfinite(at[0]) || !isfinite(at[1]) || !isfinite(at[2])) {
                const float3 exact = placed_exactly(args, transforms + 3 * domain, q + domain, vertex);
                at[0] = exact.x;
                at[1] = exact.y;
                at[2] = exact.z;
            }
        }
    }
}

extern "C" __global__ void __launch_bounds__(32 * WARPS, RESIDENT) batch(const __grid_constant__ BatchArgs args) {
    extern __shared__ uint4 shared[];
    Own& own = ((Own*)shared)[threadIdx.x / 32];
    float4* transforms = (float4*)((Own*)shared + WARPS);
    float4* q = transforms + 3 * VECTORS;
    const Part part = part_of(args);
    if (part.quads > 0) {
        // x0 belongs to the first group, and groups of stages that are not there are empty.
        copy_rest(args, part, own);
#pragma unroll
        for (unsigned stage = 0; stage < STAGES; ++stage) {
            copy_stage(args, part, own, stage);
            end_group();
        }
    }
    load_values(args, transforms, q);
    __syncthreads();
    if (part.quads == 0) {
        return;
    }
    Sums sums;
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
#pragma unroll
        for (unsigned domain = 0; domain < VECTORS; ++domain) {
            sums[i][domain] = 0.0f;
        }
    }
    sum_modes(args, part, own, q, sums);
    wait_for_all_but<0>();
    float total = 0.0f;
    place(args, part, own, transforms, sums, total);
    // Others wrote some of what this lane now reads.
    __syncwarp();
    if (total != 0.0f) {
        mend(args, transforms, (const float*)q);
    }
}
