// Shared memory of a block of `batch`, and the loads of U, x0, T and q. Twin: the tests of src/compute/gpu/executor/launchers/batch.rs.
#pragma once
#include "chunk.cuh"
#include "transform.cuh"

#if defined(BATCH_4)
constexpr unsigned BATCH_SIZE = 4;
#elif defined(BATCH_8)
constexpr unsigned BATCH_SIZE = 8;
#else
constexpr unsigned BATCH_SIZE = 16;
#endif
// A warp processes half a tile: 16 quads, two vertices per lane.
constexpr unsigned WARPS = 2;
constexpr unsigned WARP_QUADS = TILE_QUADS / WARPS;
constexpr unsigned WARP_VERTICES = 4 * WARP_QUADS;
// Chunks per stage, and stages in flight.
constexpr unsigned STAGE_CHUNKS = 4;
constexpr unsigned STAGES = 3;
constexpr unsigned STAGE_ROWS = 3 * STAGE_CHUNKS;
constexpr unsigned STAGE_WORDS = STAGE_ROWS * WARP_QUADS;
// Shared memory of a warp: a ring of stages, which is reused to stage x, and x0.
struct WarpStorage {
    uint4 ring[STAGES * STAGE_WORDS];
    float4 rest[3 * WARP_QUADS];
};
static_assert(sizeof(WarpStorage) == 9984, "WarpStorage differs from src/compute/gpu/tables/kernels.rs");

__device__ __forceinline__ unsigned lane_id() {
    return threadIdx.x % 32;
}

// Asynchronous copy of 16 bytes to shared memory if `is_there`; completed by `cp_async_wait`.
__device__ __forceinline__ void copy_async(void* to, const void* from, bool is_there) {
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
__device__ __forceinline__ void cp_async_commit() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.commit_group;" ::: "memory");
#endif
}

// Waits until all groups but the last `GROUPS` are visible to the warp.
template <unsigned GROUPS>
__device__ __forceinline__ void cp_async_wait() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_group %0;" ::"n"(GROUPS) : "memory");
#endif
    __syncwarp();
}

// A warp's part of a tile. In shared memory and read again between barriers, because the sums use all registers.
struct WarpSlice {
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
    unsigned has_non_finite; // a result is not finite
    unsigned group;
    float* positions; // of a domain that begins at packed vertex 0
};

// Data shared by the warps of a block: T and the members, zeros for missing domains. q follows, [modes][VECTORS]
// numbers multiplied by the tile's scales.
struct BlockStorage {
    Affine transforms[BATCH_SIZE];
    BatchMember members[BATCH_SIZE];
    WarpSlice parts[WARPS];
};
static_assert(sizeof(WarpSlice) == 72 && sizeof(BlockStorage) == 64 * BATCH_SIZE + 72 * WARPS, "BlockStorage differs from src/compute/gpu/tables/kernels.rs");

__device__ __forceinline__ WarpStorage& warp_storage(uint4* shared) {
    return ((WarpStorage*)shared)[threadIdx.x / 32];
}

__device__ __forceinline__ BlockStorage& block_storage(uint4* shared) {
    return *(BlockStorage*)((WarpStorage*)shared + WARPS);
}

__device__ __forceinline__ float4* shared_q(uint4* shared) {
    return (float4*)(&block_storage(shared) + 1);
}

__device__ __forceinline__ WarpSlice load_warp_slice(const BatchArgs& args, unsigned group, unsigned tile, unsigned end) {
    const uint4 head = __ldg((const uint4*)(args.groups + group));
    const uint4 tail = __ldg((const uint4*)(args.groups + group) + 1);
    const unsigned vertices = tail.x, before = WARP_QUADS * (threadIdx.x / 32), quad = TILE_QUADS * tile;
    WarpSlice part;
    part.group = group;
    part.tile = tile;
    part.end = end;
    part.has_non_finite = 0;
    part.chunks = tail.z;
    part.members = tail.w;
    part.first_member = tail.y;
    part.first_scale = head.w + part.chunks * CHUNK_MODES * tile;
    part.width = min(TILE_QUADS, (vertices + 3) / 4 - quad);
    part.quads = part.width > before ? min(WARP_QUADS, part.width - before) : 0;
    part.first = 4 * (quad + before);
    part.vertices = part.quads > 0 ? min(WARP_VERTICES, vertices - part.first) : 0;
    part.words = args.words + (head.x | (unsigned long long)head.y << 32) + 3 * (size_t)part.chunks * quad + before;
    part.positions = args.header->positions + 3 * (size_t)part.first;
    part.rest = args.rest + 3 * ((size_t)head.z + quad) + before;
    return part;
}

// Starts the copies of a stage, [row][quad]. Lanes beyond the last quad copy that quad again.
__device__ __forceinline__ void copy_stage(const WarpSlice& part, WarpStorage& own, unsigned stage) {
    constexpr unsigned STEP = 32 / WARP_QUADS, COPIES = STAGE_WORDS / 32;
    const unsigned row = STAGE_ROWS * stage + lane_id() / WARP_QUADS;
    uint4* to = own.ring + stage % STAGES * STAGE_WORDS + lane_id();
    if (part.width == TILE_QUADS && STAGE_ROWS * (stage + 1) <= 3 * part.chunks) {
        // The common case, with strides that are compile-time constants.
        const uint4* from = part.words + row * TILE_QUADS + lane_id() % WARP_QUADS;
#pragma unroll
        for (unsigned i = 0; i < COPIES; ++i) {
            copy_async(to + 32 * i, from + i * STEP * TILE_QUADS, true);
        }
        return;
    }
    const uint4* from = part.words + (size_t)row * part.width + min(lane_id() % WARP_QUADS, part.quads - 1);
#pragma unroll
    for (unsigned i = 0; i < COPIES; ++i) {
        copy_async(to + 32 * i, from + i * STEP * part.width, row + i * STEP < 3 * part.chunks);
    }
}

// Starts the copies of x0, [axis][quad].
__device__ __forceinline__ void copy_rest(const WarpSlice& part, WarpStorage& own) {
#pragma unroll
    for (unsigned i = lane_id(); i < lane_id() + 3 * WARP_QUADS; i += 32) {
        const float4* from = part.rest + i / WARP_QUADS * part.width + min(i % WARP_QUADS, part.quads - 1);
        copy_async(own.rest + i, from, i < 3 * WARP_QUADS);
    }
}

// Threads of a block that read the values of one domain, in contiguous runs.
constexpr unsigned THREADS_PER_MEMBER = 32 * WARPS / BATCH_SIZE;

// Loads T and members, which all warps of a block share. Returns the first q of this thread's member.
__device__ __forceinline__ unsigned load_members(const BatchArgs& args, const WarpSlice& part, BlockStorage& common) {
    const unsigned own = threadIdx.x / THREADS_PER_MEMBER;
    BatchMember member = {};
    Affine t = {};
    if (own < part.members) {
        const uint4 words = __ldg((const uint4*)(args.members + part.first_member + own));
        member = {words.x, words.y, words.z, words.w};
        t = load_transform(transforms_of(args), member.domain);
    }
    if (threadIdx.x % THREADS_PER_MEMBER == 0) {
        common.members[own] = member;
        common.transforms[own] = t;
    }
    return member.first_q;
}

// Loads all modes of q of this thread's member.
__device__ __forceinline__ void load_q(const BatchArgs& args, const WarpSlice& part, unsigned first_q, float* q) {
    const unsigned own = threadIdx.x / THREADS_PER_MEMBER, modes = part.chunks * CHUNK_MODES;
#pragma unroll 8
    for (unsigned mode = threadIdx.x % THREADS_PER_MEMBER; mode < modes; mode += THREADS_PER_MEMBER) {
        float amount = own < part.members ? __ldg(args.q + first_q + mode) : 0.0f;
#ifdef STORE_INT8
        amount *= __ldg(args.scales + part.first_scale + mode);
#endif
        q[mode * BATCH_SIZE + own] = amount;
    }
}

// Prepares a tile: starts the copies of U and x0, and writes the part to shared memory. With the block's first tile,
// also loads T, the members and q; with STORE_INT8, q again for each tile, because its scales belong to the tile.
__device__ __forceinline__ void load_tile_async(const BatchArgs& args, const WarpSlice& part, uint4* shared, bool is_first) {
    BlockStorage& common = block_storage(shared);
    if (lane_id() == 0) {
        common.parts[threadIdx.x / 32] = part;
    }
    if (part.quads > 0) {
        // x0 belongs to the first group of copies. Groups of stages beyond the last chunk are empty.
        copy_rest(part, warp_storage(shared));
#pragma unroll
        for (unsigned stage = 0; stage < STAGES; ++stage) {
            copy_stage(part, warp_storage(shared), stage);
            cp_async_commit();
        }
    }
    if (is_first) {
        load_q(args, part, load_members(args, part, common), (float*)shared_q(shared));
        __syncthreads();
#ifdef STORE_INT8
    } else {
        __syncthreads();
        load_q(args, part, common.members[threadIdx.x / THREADS_PER_MEMBER].first_q, (float*)shared_q(shared));
        __syncthreads();
#endif
    }
    __syncwarp();
}
