// x = T_b (x0 + U q_b) for a group of up to VECTORS domains b that share a shape. The group reads its U once.
//   blocks     the work of each block: a group, and a run of tiles of its shape (layout.cuh)            (in)
//   groups     domains of one shape, and the offsets of its U and x0                                    (in)
//   members    the domains of all groups                                                                (in)
//   words      U, per tile [chunks][3][width] words of 16 bytes (chunk.cuh)                             (in)
//   rest       x0, per tile [3][width][4] f32                                                           (in)
//   scales     with STORE_INT8: per tile of U and mode                                                  (in)
//   transforms, transform_links, frames, q   as for `deform`                                                  (in)
//   positions  [vertices][3] f32, address in the header                                                 (out)
//   boxes      [tiles of deform][4][6] u32, as `deform` writes them; the boxes of half a tile without
//              vertices keep the zeros of their allocation                                              (out)
// Launch: a block of WARPS warps for each run of tiles of a group, with shared memory for WARPS Own, Common and q.
// CPU twin: the tests of src/compute/gpu/executor/launchers/batch.rs.
//
// Each vertex sums its modes in order, from +0, by fused multiply-adds, as `deform` does: the same bits. A result that
// is not finite in f32 is computed again in f64.
//
// Design, for 16 vectors, n vertices, r modes, per warp and mode. The product needs 48 multiply-adds per vertex. Shared
// memory delivers 128 bytes per cycle to a multiprocessor, which issues 4 instructions per cycle. A lane with one
// vertex would load 16 + 3 numbers for 48 multiply-adds: 19 cycles of loads against 12 of arithmetic. A lane with two
// vertices loads 16 + 6 for 96: 22 cycles (no more with 2 byte entries, of which half of the 16 bytes of a quad are
// used) against 24 of arithmetic, so both are balanced. It has 96 sums and about 128 registers: 16 warps per
// multiprocessor. So few warps saturate the memory only if loads in flight need no registers: U is copied to shared
// memory asynchronously, STAGES * 3 KB per warp ahead, 144 KB per multiprocessor, where a latency of 1 us at 5 TB/s
// needs 38 KB.
#include "batch_load.cuh"
#include "ordered_float.cuh"

// Target number of resident blocks per multiprocessor: the register limit where shared memory is large enough.
#if __CUDA_ARCH__ == 900
constexpr unsigned MIN_BLOCKS_PER_SM = BATCH_SIZE == 16 ? 8 : 10;
#elif __CUDA_ARCH__ == 800 || __CUDA_ARCH__ == 1000
// Three warps per scheduler: the compiler needs more registers for these architectures.
constexpr unsigned MIN_BLOCKS_PER_SM = 6;
#else
constexpr unsigned MIN_BLOCKS_PER_SM = 4;
#endif

// Chunks whose loads and sums are interleaved: at least two modes.
constexpr unsigned CHUNK_UNROLL = CHUNK_MODES < 2 ? 2 : 1;

// One axis of a lane's two vertices.
struct VertexPair {
    float values[2];
};

// The pair of group `group` (mode * 3 + axis) of a chunk. `chunk` is the lane's first byte in the chunk.
__device__ __forceinline__ VertexPair load_vertex_pair(const char* chunk, unsigned group) {
    const unsigned byte = 4 * ENTRY_BYTES * group;
    const char* at = chunk + byte / 16 * (16 * WARP_QUADS) + byte % 16;
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
    VertexPair pair;
    pair.values[0] = decode_entry(words, 0);
#if defined(STORE_F16)
    // Convert the upper half directly, without a shift.
    asm("{ .reg .b16 low, high; mov.b32 {low, high}, %1; cvt.f32.f16 %0, high; }" : "=f"(pair.values[1]) : "r"(words[0]));
#else
    pair.values[1] = decode_entry(words, 1);
#endif
    return pair;
}

// [2 * axis + vertex][domain]
typedef float Sums[6][BATCH_SIZE];

__device__ __forceinline__ void add_four(Sums& sums, unsigned first, const VertexPair (&pairs)[3], const float4& q) {
    const float amounts[4] = {q.x, q.y, q.z, q.w};
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
#pragma unroll
        for (unsigned k = 0; k < 4; ++k) {
            sums[i][first + k] = fmaf(pairs[i / 2].values[i % 2], amounts[k], sums[i][first + k]);
        }
    }
}

__device__ __forceinline__ void add_chunk(Sums& sums, const char* chunk, const float4* q) {
#pragma unroll
    for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
        const VertexPair pairs[3] = {load_vertex_pair(chunk, 3 * mode), load_vertex_pair(chunk, 3 * mode + 1), load_vertex_pair(chunk, 3 * mode + 2)};
#pragma unroll
        for (unsigned four = 0; four < BATCH_SIZE / 4; ++four) {
            add_four(sums, 4 * four, pairs, q[mode * (BATCH_SIZE / 4) + four]);
        }
    }
}

// Sums all modes, stage by stage; the ring is full at the start. With 16-bit entries all registers are in use and the
// stage counter spills to local memory: a few bytes, once per stage.
__device__ __forceinline__ void sum_modes(const WarpSlice& part, WarpStorage& own, const float4* q, Sums& sums) {
    const unsigned offset = 16 * (lane_id() / 2) + 2 * ENTRY_BYTES * (lane_id() % 2);
#pragma unroll 1
    for (unsigned stage = 0; STAGE_CHUNKS * stage < part.chunks; ++stage) {
        cp_async_wait<STAGES - 1>();
        const char* chunk = (const char*)(own.ring + stage % STAGES * STAGE_WORDS) + offset;
        const unsigned count = min(STAGE_CHUNKS, part.chunks - STAGE_CHUNKS * stage);
#pragma unroll CHUNK_UNROLL
        for (unsigned i = 0; i < count; ++i) {
            add_chunk(sums, chunk, q);
            chunk += 3 * 16 * WARP_QUADS;
            q += CHUNK_MODES * (BATCH_SIZE / 4);
        }
        __syncwarp();
        if (STAGE_CHUNKS * (stage + STAGES) < part.chunks) {
            copy_stage(part, own, stage + STAGES);
        }
        cp_async_commit();
    }
}

// x0 of a lane's two vertices.
struct RestPair {
    float2 x, y, z;
    __device__ __forceinline__ void load(const WarpStorage& own) {
        const float* from = (const float*)(own.rest + lane_id() / 2) + 2 * (lane_id() % 2);
        x = *(const float2*)from;
        y = *(const float2*)(from + 4 * WARP_QUADS);
        z = *(const float2*)(from + 8 * WARP_QUADS);
    }
};

// Number of existing vertices among a lane's two.
__device__ __forceinline__ unsigned lane_vertices(const WarpSlice& part) {
    return part.vertices > 2 * lane_id() ? min(2u, part.vertices - 2 * lane_id()) : 0;
}

// Address of the two boxes of half a tile in the boxes of `deform`.
__device__ __forceinline__ unsigned* warp_boxes(const BatchArgs& args, const WarpSlice& part, const BatchMember& member) {
    return args.boxes + 24 * (size_t)(member.first_tile + part.tile) + 12 * (threadIdx.x / 32);
}

// Writes x of a lane's two vertices to the stage, [vertex][3].
__device__ __forceinline__ void stage_domain(const RestPair& base, const BlockStorage& common, const Sums& sums, unsigned domain,
                                             float* staged) {
    const Affine& t = common.transforms[domain];
    const float4 a = t.a, b = t.b, c = t.c;
    float world[6];
#pragma unroll
    for (unsigned i = 0; i < 2; ++i) {
        const float px = (i ? base.x.y : base.x.x) + sums[i][domain], py = (i ? base.y.y : base.y.x) + sums[2 + i][domain],
                    pz = (i ? base.z.y : base.z.x) + sums[4 + i][domain];
        world[3 * i] = transform_row(a, px, py, pz);
        world[3 * i + 1] = transform_row(b, px, py, pz);
        world[3 * i + 2] = transform_row(c, px, py, pz);
    }
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        ((float2*)staged)[3 * lane_id() + i] = make_float2(world[2 * i], world[2 * i + 1]);
    }
}

// Computes the boxes of the two staged domains. Each half warp reduces one domain, with four vertices per lane. After
// the first exchange a lane has either the lower or the upper sides, so later exchanges move three numbers. NaNs are
// handled by `repair_non_finite`.
__device__ __forceinline__ void write_two_boxes(const BatchArgs& args, WarpSlice& part, const BlockStorage& common, unsigned domain,
                                         const float4* staged) {
    const float NEGATIVE_INFINITY = __uint_as_float(0xff800000u); // minus infinity
    const unsigned own = domain + lane_id() / 16, within = lane_id() % 16;
    const float4* from = staged + 48 * (lane_id() / 16) + 3 * within;
    const float4 first = from[0], second = from[1], third = from[2];
    const float numbers[12] = {first.x,  first.y,  first.z, first.w, second.x, second.y,
                               second.z, second.w, third.x, third.y, third.z,  third.w};
    float low[3] = {NEGATIVE_INFINITY, NEGATIVE_INFINITY, NEGATIVE_INFINITY}, high[3] = {NEGATIVE_INFINITY, NEGATIVE_INFINITY, NEGATIVE_INFINITY}, total = 0.0f;
#pragma unroll
    for (unsigned i = 0; i < 12; ++i) {
        if (part.vertices == WARP_VERTICES || 4 * within + i / 3 < part.vertices) {
            low[i % 3] = fmaxf(low[i % 3], -numbers[i]);
            high[i % 3] = fmaxf(high[i % 3], numbers[i]);
        }
        // Remains zero unless a number is not finite.
        total = fmaf(0.0f, numbers[i], total);
    }
    if (__any_sync(0xffffffffu, total != 0.0f) && lane_id() == 0) {
        part.has_non_finite = 1;
    }
    const bool is_upper = within >= 8;
    float sides[3];
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float other = __shfl_xor_sync(0xffffffffu, is_upper ? low[axis] : high[axis], 8);
        sides[axis] = fmaxf(is_upper ? high[axis] : low[axis], other);
    }
#pragma unroll
    for (unsigned lanes = 4; lanes > 0; lanes /= 2) {
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
            sides[axis] = fmaxf(sides[axis], __shfl_xor_sync(0xffffffffu, sides[axis], lanes));
        }
    }
    // Six of eight lanes write three sides of two boxes each.
    const unsigned axis = within % 8 % 3, copy = within % 8 / 3;
    if (copy < 2 && own < part.members) {
        const float side = axis == 0 ? sides[0] : axis == 1 ? sides[1] : sides[2];
        warp_boxes(args, part, common.members[own])[6 * copy + (is_upper ? 3 : 0) + axis] = non_nan_to_ordered(side);
    }
}

// Keeps the compiler from moving loads across: loads in parallel would need more registers than there are.
__device__ __forceinline__ void fence_loads() {
    __syncwarp();
}

// Writes two staged domains, 48 words of 16 bytes each.
__device__ __forceinline__ void store_two_domains(float* first, float* second, const float4* staged) {
    const unsigned lane = lane_id();
    float4 *low = (float4*)first, *high = (float4*)second;
    __stcs(low + lane, staged[lane]);
    fence_loads();
    __stcs(lane < 16 ? low + 32 + lane : high + lane - 16, staged[32 + lane]);
    fence_loads();
    __stcs(high + 16 + lane, staged[64 + lane]);
}

__device__ __forceinline__ float* output_pointer(const WarpSlice& part, const BatchMember& member) {
    return part.positions + 3 * (size_t)member.first;
}

// Writes the staged domains number by number, for part tiles and unaligned domains.
__device__ __forceinline__ void store_numbers(const WarpSlice& part, const BlockStorage& common, unsigned domain,
                                              const float* staged) {
    const unsigned numbers = 3 * part.vertices;
#pragma unroll 1
    for (unsigned i = 0; i < 2 && domain + i < part.members; ++i) {
        float* to = output_pointer(part, common.members[domain + i]);
#pragma unroll 1
        for (unsigned k = lane_id(); k < numbers; k += 32) {
            __stcs(to + k, staged[i * 3 * WARP_VERTICES + k]);
        }
    }
}

// Writes two domains at a time, alternating between two halves of the ring. The barrier separates the reads of one pair
// from the writes to the same half.
__device__ __forceinline__ void store_domains(const BatchArgs& args, WarpSlice& part, WarpStorage& own, const BlockStorage& common,
                                    const Sums& sums) {
#pragma unroll
    for (unsigned domain = 0; domain < BATCH_SIZE; domain += 2) {
        if (domain < part.members) {
            const bool are_two = domain + 1 < part.members;
            float* staged = (float*)own.ring + domain / 2 % 2 * (2 * 3 * WARP_VERTICES);
            RestPair base;
            base.load(own);
            stage_domain(base, common, sums, domain, staged);
            // Zeros if the domain does not exist.
            stage_domain(base, common, sums, domain + 1, staged + 3 * WARP_VERTICES);
            const BatchMember &low = common.members[domain], &high = common.members[domain + 1];
            __syncwarp();
            write_two_boxes(args, part, common, domain, (const float4*)staged);
            if (are_two && part.vertices == WARP_VERTICES && (low.first | high.first) % 4 == 0) {
                store_two_domains(output_pointer(part, low), output_pointer(part, high), (const float4*)staged);
            } else {
                store_numbers(part, common, domain, staged);
            }
        }
    }
}

// x of one vertex of this lane in f64, rounded once.
__device__ __forceinline__ float3 position_f64(const BatchArgs& args, const WarpSlice& part, const BatchMember& member,
                                                 const float* q, unsigned vertex) {
    const unsigned quad = lane_id() / 2, within = 2 * (lane_id() % 2) + vertex;
    double bent[3];
    for (unsigned axis = 0; axis < 3; ++axis) {
        double sum = 0.0;
        for (unsigned chunk = 0; chunk < part.chunks; ++chunk) {
            const uint4* words = part.words + quad + chunk * 3 * (size_t)part.width;
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const float amount = q[(chunk * CHUNK_MODES + mode) * BATCH_SIZE];
                sum += (double)load_entry(words, part.width, mode, axis, within) * (double)amount;
            }
        }
        bent[axis] = (double)((const float*)(part.rest + axis * part.width + quad))[within] + sum;
    }
    return transform_domain_point_f64(transforms_of(args), member.domain, bent);
}

// Writes the box of one domain's vertices of this warp, for `repair_non_finite`, to the same half of the tile as in `deform`.
__device__ __forceinline__ void store_box(const BatchArgs& args, const WarpSlice& part, const BatchMember& member,
                                          const unsigned (&keys)[6]) {
    const unsigned key = warp_box(keys);
    if (lane_id() < 12) {
        warp_boxes(args, part, member)[lane_id()] = key;
    }
}

// Recomputes the positions of a warp that are not finite, in the output, and the boxes of all its domains: a NaN wins.
__device__ __noinline__ void repair_non_finite(const BatchArgs& args, const BlockStorage& common, const float* q) {
    const WarpSlice& part = common.parts[threadIdx.x / 32];
    const unsigned count = lane_vertices(part);
    for (unsigned domain = 0; domain < part.members; ++domain) {
        const BatchMember& member = common.members[domain];
        float* at = output_pointer(part, member) + 6 * lane_id();
        unsigned keys[6] = {};
        for (unsigned vertex = 0; vertex < count; ++vertex, at += 3) {
            if (!isfinite(at[0]) || !isfinite(at[1]) || !isfinite(at[2])) {
                const float3 exact = position_f64(args, part, member, q + domain, vertex);
                at[0] = exact.x;
                at[1] = exact.y;
                at[2] = exact.z;
            }
            for (unsigned axis = 0; axis < 3; ++axis) {
                keys[axis] = max(keys[axis], float_to_ordered(-at[axis]));
                keys[3 + axis] = max(keys[3 + axis], float_to_ordered(at[axis]));
            }
        }
        store_box(args, part, member, keys);
    }
}

// Computes a warp's part of a tile, whose copies are in flight.
__device__ __forceinline__ void compute_slice(const BatchArgs& args, uint4* shared) {
    WarpStorage& own = warp_storage(shared);
    BlockStorage& common = block_storage(shared);
    WarpSlice& part = common.parts[threadIdx.x / 32];
    Sums sums;
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
#pragma unroll
        for (unsigned domain = 0; domain < BATCH_SIZE; ++domain) {
            sums[i][domain] = 0.0f;
        }
    }
    sum_modes(part, own, shared_q(shared), sums);
    cp_async_wait<0>();
    store_domains(args, part, own, common, sums);
    // Lanes read what other lanes wrote, and the next tile overwrites what other lanes read.
    __syncwarp();
    if (part.has_non_finite) {
        repair_non_finite(args, common, (const float*)shared_q(shared));
    }
}

extern "C" __global__ void __launch_bounds__(32 * WARPS, MIN_BLOCKS_PER_SM) batch(const __grid_constant__ BatchArgs args) {
    extern __shared__ uint4 shared[];
    const WarpSlice& last = block_storage(shared).parts[threadIdx.x / 32];
    uint4 block = __ldg((const uint4*)(args.blocks + blockIdx.x));
    bool is_first = true;
#pragma unroll 1
    do {
        load_tile_async(args, load_warp_slice(args, block.x, block.y, block.z), shared, is_first);
        if (last.quads > 0) {
            compute_slice(args, shared);
        }
        block = {last.group, last.tile + 1, last.end, 0};
        is_first = false;
        __syncwarp();
    } while (block.y < block.z);
}
