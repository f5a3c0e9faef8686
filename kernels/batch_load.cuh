// Shared memory of a block of `batch`, and the loads of U, x0, T and q. Twin: the tests of src/compute/gpu/batch.rs.
#pragma once
#include "chunk.cuh"
#include "follow.cuh"

#if defined(BATCH_4)
constexpr unsigned VECTORS = 4;
#elif defined(BATCH_8)
constexpr unsigned VECTORS = 8;
#else
constexpr unsigned VECTORS = 16;
#endif
// A warp processes half a tile: 16 quads, two vertices per lane.
constexpr unsigned WARPS = 2;
constexpr unsigned QUADS = TILE_QUADS / WARPS;
constexpr unsigned VERTICES = 4 * QUADS;
// Chunks per stage, and stages in flight.
constexpr unsigned STAGE_CHUNKS = 4;
constexpr unsigned STAGES = 3;
constexpr unsigned ROWS = 3 * STAGE_CHUNKS;
constexpr unsigned STAGE_WORDS = ROWS * QUADS;
// Shared memory of a warp: a ring of stages, which is reused to stage x, and x0.
struct Own {
    uint4 ring[STAGES * STAGE_WORDS];
    float4 rest[3 * QUADS];
};
static_assert(sizeof(Own) == 9984, "Own differs from src/compute/gpu/batch.rs");

__device__ __forceinline__ unsigned lane_of() {
    return threadIdx.x % 32;
}

// Asynchronous copy of 16 bytes to shared memory if `is_there`; completed by `wait_for_all_but`.
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

// Commits a group of copies.
__device__ __forceinline__ void end_group() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.commit_group;" ::: "memory");
#endif
}

// Waits until all groups but the last `GROUPS` are visible to the warp.
template <unsigned GROUPS>
__device__ __forceinline__ void wait_for_all_but() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_group %0;" ::"n"(GROUPS) : "memory");
#endif
    __syncwarp();
}

// A warp's part of a tile. In shared memory and read again between barriers, because the sums use all registers.
struct Part {
    const uint4* words; // of its first quad
    const float4* rest; // of its first quad
    unsigned width;     // quads of the tile
    unsigned quads;     // of the part; 0 if it is empty
    unsigned first;     // its first vertex in the shape
    unsigned vertices;
    unsigned chunks;
    unsigned members;
    unsigned first_member;
    unsigned first_scale; // of the tile
    unsigned tile;
    unsigned end;     // after the block's last tile
    unsigned is_lost; // a result is not finite
    unsigned group;
    float* positions; // of a domain that begins at packed vertex 0
};

// Data shared by the warps of a block: T and the members, zeros for missing domains. q follows, [modes][VECTORS]
// numbers multiplied by the tile's scales.
struct Common {
    Affine transforms[VECTORS];
    Member members[VECTORS];
    Part parts[WARPS];
};
static_assert(sizeof(Part) == 72 && sizeof(Common) == 64 * VECTORS + 72 * WARPS, "Common differs from src/compute/gpu/batch.rs");

__device__ __forceinline__ Own& own_of(uint4* shared) {
    return ((Own*)shared)[threadIdx.x / 32];
}

__device__ __forceinline__ Common& common_of(uint4* shared) {
    return *(Common*)((Own*)shared + WARPS);
}

__device__ __forceinline__ float4* q_of(uint4* shared) {
    return (float4*)(&common_of(shared) + 1);
}

__device__ __forceinline__ Part part_of(const BatchArgs& args, unsigned group, unsigned tile, unsigned end) {
    const uint4 head = __ldg((const uint4*)(args.groups + group));
    const uint4 tail = __ldg((const uint4*)(args.groups + group) + 1);
    const unsigned vertices = tail.x, before = QUADS * (threadIdx.x / 32), quad = TILE_QUADS * tile;
    Part part;
    part.group = group;
    part.tile = tile;
    part.end = end;
    part.is_lost = 0;
    part.chunks = tail.z;
    part.members = tail.w;
    part.first_member = tail.y;
    part.first_scale = head.w + part.chunks * CHUNK_MODES * tile;
    part.width = min(TILE_QUADS, (vertices + 3) / 4 - quad);
    part.quads = part.width > before ? min(QUADS, part.width - before) : 0;
    part.first = 4 * (quad + before);
    part.vertices = part.quads > 0 ? min(VERTICES, vertices - part.first) : 0;
    part.words = args.words + (head.x | (unsigned long long)head.y << 32) + 3 * (size_t)part.chunks * quad + before;
    part.positions = args.header->positions + 3 * (size_t)part.first;
    part.rest = args.rest + 3 * ((size_t)head.z + quad) + before;
    return part;
}

// Starts the copies of a stage, [row][quad]. Lanes beyond the last quad copy that quad again.
__device__ __forceinline__ void copy_stage(const Part& part, Own& own, unsigned stage) {
    constexpr unsigned STEP = 32 / QUADS, COPIES = STAGE_WORDS / 32;
    const unsigned row = ROWS * stage + lane_of() / QUADS;
    uint4* to = own.ring + stage % STAGES * STAGE_WORDS + lane_of();
    if (part.width == TILE_QUADS && ROWS * (stage + 1) <= 3 * part.chunks) {
        // The common case, with strides that are compile-time constants.
        const uint4* from = part.words + row * TILE_QUADS + lane_of() % QUADS;
#pragma unroll
        for (unsigned i = 0; i < COPIES; ++i) {
            copy(to + 32 * i, from + i * STEP * TILE_QUADS, true);
        }
        return;
    }
    const uint4* from = part.words + (size_t)row * part.width + min(lane_of() % QUADS, part.quads - 1);
#pragma unroll
    for (unsigned i = 0; i < COPIES; ++i) {
        copy(to + 32 * i, from + i * STEP * part.width, row + i * STEP < 3 * part.chunks);
    }
}

// Starts the copies of x0, [axis][quad].
__device__ __forceinline__ void copy_rest(const Part& part, Own& own) {
#pragma unroll
    for (unsigned i = lane_of(); i < lane_of() + 3 * QUADS; i += 32) {
        const float4* from = part.rest + i / QUADS * part.width + min(i % QUADS, part.quads - 1);
        copy(own.rest + i, from, i < 3 * QUADS);
    }
}

// Threads of a block that read the values of one domain, in contiguous runs.
constexpr unsigned READERS = 32 * WARPS / VECTORS;

// Loads T and members, which all warps of a block share. Returns the first q of this thread's member.
__device__ __forceinline__ unsigned load_members(const BatchArgs& args, const Part& part, Common& common) {
    const unsigned own = threadIdx.x / READERS;
    Member member = {};
    Affine t = {};
    if (own < part.members) {
        const uint4 words = __ldg((const uint4*)(args.members + part.first_member + own));
        member = {words.x, words.y, words.z, words.w};
        t = place_of(transforms_of(args), member.domain);
    }
    if (threadIdx.x % READERS == 0) {
        common.members[own] = member;
        common.transforms[own] = t;
    }
    return member.first_q;
}

// Loads all modes of q of this thread's member.
__device__ __forceinline__ void load_q(const BatchArgs& args, const Part& part, unsigned first_q, float* q) {
    const unsigned own = threadIdx.x / READERS, modes = part.chunks * CHUNK_MODES;
#pragma unroll 8
    for (unsigned mode = threadIdx.x % READERS; mode < modes; mode += READERS) {
        float amount = own < part.members ? __ldg(args.q + first_q + mode) : 0.0f;
#ifdef STORE_INT8
        amount *= __ldg(args.scales + part.first_scale + mode);
#endif
        q[mode * VECTORS + own] = amount;
    }
}

// Prepares a tile: starts the copies of U and x0, and writes the part to shared memory. With the block's first tile,
// also loads T, the members and q; with STORE_INT8, q again for each tile, because its scales belong to the tile.
__device__ __forceinline__ void prepare(const BatchArgs& args, const Part& part, uint4* shared, bool is_first) {
    Common& common = common_of(shared);
    if (lane_of() == 0) {
        common.parts[threadIdx.x / 32] = part;
    }
    if (part.quads > 0) {
        // x0 belongs to the first group of copies. Groups of stages beyond the last chunk are empty.
        copy_rest(part, own_of(shared));
#pragma unroll
        for (unsigned stage = 0; stage < STAGES; ++stage) {
            copy_stage(part, own_of(shared), stage);
            end_group();
        }
    }
    if (is_first) {
        load_q(args, part, load_members(args, part, common), (float*)q_of(shared));
        __syncthreads();
#ifdef STORE_INT8
    } else {
        __syncthreads();
        load_q(args, part, common.members[threadIdx.x / READERS].first_q, (float*)q_of(shared));
        __syncthreads();
#endif
    }
    __syncwarp();
}
