// Shared memory of a block of `batch`, and the loads of U, x0, T and q. batch.cu defines groups, members and tiles. A
// word has 16 bytes. CPU implementation with the same steps: the tests of src/compute/gpu/executor/launchers/batch.rs.
#pragma once
#include "chunk.cuh"
#include "transform.cuh"

// Maximum number of members of a group.
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
// U passes through a ring buffer with a capacity of RING_STAGES stages. A stage is STAGE_CHUNKS chunks of all quads of
// the warp: 192 words, 3 KB.
constexpr unsigned STAGE_CHUNKS = 4;
constexpr unsigned RING_STAGES = 3;
constexpr unsigned STAGE_QUAD_WORDS = 3 * STAGE_CHUNKS; // words of a stage per quad
constexpr unsigned STAGE_WORDS = STAGE_QUAD_WORDS * WARP_QUADS;

// Shared memory of a warp.
struct WarpStorage {
    uint4 ring[RING_STAGES * STAGE_WORDS]; // stages of U, later the staging buffer of x
    float4 rest_positions[3 * WARP_QUADS]; // [axis][quad]
};
static_assert(sizeof(WarpStorage) == 9984, "WarpStorage differs from src/compute/gpu/tables/kernels.rs");

__device__ __forceinline__ unsigned lane_id() {
    return threadIdx.x % 32;
}

// If `is_enabled`, starts an asynchronous copy of 16 bytes to shared memory. `cp_async_wait` waits for its completion.
__device__ __forceinline__ void cp_async_copy(void* destination, const void* source, bool is_enabled) {
#if __CUDA_ARCH__ >= 800
    const unsigned shared = (unsigned)__cvta_generic_to_shared(destination);
    asm volatile("{ .reg .pred enabled; setp.ne.u32 enabled, %2, 0; @enabled cp.async.cg.shared.global [%0], [%1], 16; }" ::"r"(
                     shared),
                 "l"(source), "r"((unsigned)is_enabled)
                 : "memory");
#else
    if (is_enabled) {
        *(uint4*)destination = __ldcs((const uint4*)source);
    }
#endif
}

// Commits the copies since the last commit as a copy group.
__device__ __forceinline__ void cp_async_commit() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.commit_group;" ::: "memory");
#endif
}

// Waits until the results of all copy groups except the last PENDING_GROUPS are visible to the warp.
template <unsigned PENDING_GROUPS>
__device__ __forceinline__ void cp_async_wait() {
#if __CUDA_ARCH__ >= 800
    asm volatile("cp.async.wait_group %0;" ::"n"(PENDING_GROUPS) : "memory");
#endif
    __syncwarp();
}

// A warp's part of a tile. It is kept in shared memory and read again after each barrier, because the sums occupy all
// registers.
struct WarpSlice {
    const uint4* words;           // U of the slice's first quad
    const float4* rest_positions; // x0 of the slice's first quad
    unsigned tile_quads;          // number of quads of the tile
    unsigned quad_count;          // number of quads of the slice; may be 0
    unsigned first_vertex;        // in the shape
    unsigned vertex_count;        // number of vertices of the slice
    unsigned chunk_count;    // of the shape
    unsigned member_count;   // of the group
    unsigned first_member;   // index of the group's first member in `members`
    unsigned first_scale;    // index of the tile's first scale in `scales`
    unsigned tile;           // counted from the first tile of the shape
    unsigned end_tile;       // one past the block's last tile
    unsigned has_non_finite; // 1 if a result is not finite
    unsigned group;          // index in `groups`
    // Output address of the slice for a member whose first vertex is vertex 0 of the output. `output_pointer` adds the
    // offset of the member's first vertex.
    float* positions;
};

// Shared memory of a block, after the `WarpStorage` of its warps. In a group with fewer than BATCH_SIZE members, the
// unused entries are zero. The array q, [mode][member] f32, follows this struct. With STORE_INT8, q is multiplied by
// the scales of the tile.
struct BlockStorage {
    Affine transforms[BATCH_SIZE];
    BatchMember members[BATCH_SIZE];
    WarpSlice slices[WARPS];
};
static_assert(sizeof(WarpSlice) == 72 && sizeof(BlockStorage) == 64 * BATCH_SIZE + 72 * WARPS,
              "BlockStorage differs from src/compute/gpu/tables/kernels.rs");

__device__ __forceinline__ WarpStorage& warp_storage(uint4* shared) {
    return ((WarpStorage*)shared)[threadIdx.x / 32];
}

__device__ __forceinline__ BlockStorage& block_storage(uint4* shared) {
    return *(BlockStorage*)((WarpStorage*)shared + WARPS);
}

__device__ __forceinline__ float4* shared_q(uint4* shared) {
    return (float4*)(&block_storage(shared) + 1);
}

// Describes this warp's part of a tile. `tile` and `end_tile` count from the first tile of the group's shape.
__device__ __forceinline__ WarpSlice load_warp_slice(const BatchArgs& args, unsigned group, unsigned tile, unsigned end_tile) {
    // The two halves of a `BatchGroup`, with its fields in the order of layout.cuh.
    const uint4 low_words = __ldg((const uint4*)(args.groups + group));
    const uint4 high_words = __ldg((const uint4*)(args.groups + group) + 1);
    const unsigned vertex_count = high_words.x, preceding_quads = WARP_QUADS * (threadIdx.x / 32), first_quad = TILE_QUADS * tile;
    WarpSlice slice;
    slice.group = group;
    slice.tile = tile;
    slice.end_tile = end_tile;
    slice.has_non_finite = 0;
    slice.chunk_count = high_words.z;
    slice.member_count = high_words.w;
    slice.first_member = high_words.y;
    slice.first_scale = low_words.w + slice.chunk_count * CHUNK_MODES * tile;
    slice.tile_quads = min(TILE_QUADS, (vertex_count + 3) / 4 - first_quad);
    slice.quad_count = slice.tile_quads > preceding_quads ? min(WARP_QUADS, slice.tile_quads - preceding_quads) : 0;
    slice.first_vertex = 4 * (first_quad + preceding_quads);
    slice.vertex_count = slice.quad_count > 0 ? min(WARP_VERTICES, vertex_count - slice.first_vertex) : 0;
    slice.words = args.words + (low_words.x | (unsigned long long)low_words.y << 32) +
                  3 * (size_t)slice.chunk_count * first_quad + preceding_quads;
    slice.positions = args.header->positions + 3 * (size_t)slice.first_vertex;
    slice.rest_positions = args.rest_positions + 3 * ((size_t)low_words.z + first_quad) + preceding_quads;
    return slice;
}

// Starts the copies of a stage to the ring, as [STAGE_QUAD_WORDS words of a quad][WARP_QUADS quads]. With each copy, a
// warp copies two words of every quad. Lanes beyond the last quad copy the last quad again.
__device__ __forceinline__ void copy_stage(const WarpSlice& slice, WarpStorage& storage, unsigned stage) {
    constexpr unsigned WORDS_PER_COPY = 32 / WARP_QUADS, COPY_COUNT = STAGE_WORDS / 32;
    const unsigned quad_word = STAGE_QUAD_WORDS * stage + lane_id() / WARP_QUADS;
    uint4* destination = storage.ring + stage % RING_STAGES * STAGE_WORDS + lane_id();
    if (slice.tile_quads == TILE_QUADS && STAGE_QUAD_WORDS * (stage + 1) <= 3 * slice.chunk_count) {
        // The common case, with strides that are compile-time constants.
        const uint4* source = slice.words + quad_word * TILE_QUADS + lane_id() % WARP_QUADS;
#pragma unroll
        for (unsigned i = 0; i < COPY_COUNT; ++i) {
            cp_async_copy(destination + 32 * i, source + i * WORDS_PER_COPY * TILE_QUADS, true);
        }
        return;
    }
    const uint4* source =
        slice.words + (size_t)quad_word * slice.tile_quads + min(lane_id() % WARP_QUADS, slice.quad_count - 1);
#pragma unroll
    for (unsigned i = 0; i < COPY_COUNT; ++i) {
        cp_async_copy(destination + 32 * i, source + i * WORDS_PER_COPY * slice.tile_quads,
                      quad_word + i * WORDS_PER_COPY < 3 * slice.chunk_count);
    }
}

// Starts the copies of x0 to shared memory, as [3 axes][WARP_QUADS quads].
__device__ __forceinline__ void copy_rest(const WarpSlice& slice, WarpStorage& storage) {
    // x0 has 48 words. Every lane takes two iterations, so that the loop can be unrolled. Copies beyond the end of x0
    // are disabled.
#pragma unroll
    for (unsigned i = lane_id(); i < lane_id() + 3 * WARP_QUADS; i += 32) {
        const float4* source =
            slice.rest_positions + i / WARP_QUADS * slice.tile_quads + min(i % WARP_QUADS, slice.quad_count - 1);
        cp_async_copy(storage.rest_positions + i, source, i < 3 * WARP_QUADS);
    }
}

// Number of consecutive threads that load T and q of one member.
constexpr unsigned THREADS_PER_MEMBER = 32 * WARPS / BATCH_SIZE;

// Loads the members of a block's group and their T. Returns `first_q` of this thread's member, 0 if it has none.
__device__ __forceinline__ unsigned load_members(const BatchArgs& args, const WarpSlice& slice, BlockStorage& block) {
    const unsigned member_index = threadIdx.x / THREADS_PER_MEMBER;
    BatchMember member = {};
    Affine t = {};
    if (member_index < slice.member_count) {
        const uint4 words = __ldg((const uint4*)(args.members + slice.first_member + member_index));
        member = {words.x, words.y, words.z, words.w};
        t = load_transform(transforms_of(args), member.domain);
    }
    if (threadIdx.x % THREADS_PER_MEMBER == 0) {
        block.members[member_index] = member;
        block.transforms[member_index] = t;
    }
    return member.first_q;
}

// Loads q of this thread's member. The threads of a member share its modes.
__device__ __forceinline__ void load_q(const BatchArgs& args, const WarpSlice& slice, unsigned first_q, float* q) {
    const unsigned member_index = threadIdx.x / THREADS_PER_MEMBER, mode_count = slice.chunk_count * CHUNK_MODES;
#pragma unroll 8
    for (unsigned mode = threadIdx.x % THREADS_PER_MEMBER; mode < mode_count; mode += THREADS_PER_MEMBER) {
        float weight = member_index < slice.member_count ? __ldg(args.q + first_q + mode) : 0.0f;
#ifdef STORE_INT8
        weight *= __ldg(args.scales + slice.first_scale + mode);
#endif
        q[mode * BATCH_SIZE + member_index] = weight;
    }
}

// Prepares a tile: starts the copies of U and x0, and writes the slice to shared memory. For the block's first tile
// (`is_first`), also loads the members, T and q. With STORE_INT8, loads q again for each tile, because each tile has
// its own scales.
__device__ __forceinline__ void load_tile_async(const BatchArgs& args, const WarpSlice& slice, uint4* shared, bool is_first) {
    BlockStorage& block = block_storage(shared);
    if (lane_id() == 0) {
        block.slices[threadIdx.x / 32] = slice;
    }
    if (slice.quad_count > 0) {
        // The first copy group contains x0 and stage 0. The copy groups of stages beyond the last chunk are empty.
        copy_rest(slice, warp_storage(shared));
#pragma unroll
        for (unsigned stage = 0; stage < RING_STAGES; ++stage) {
            copy_stage(slice, warp_storage(shared), stage);
            cp_async_commit();
        }
    }
    if (is_first) {
        load_q(args, slice, load_members(args, slice, block), (float*)shared_q(shared));
        __syncthreads();
#ifdef STORE_INT8
    } else {
        __syncthreads();
        load_q(args, slice, block.members[threadIdx.x / THREADS_PER_MEMBER].first_q, (float*)shared_q(shared));
        __syncthreads();
#endif
    }
    __syncwarp();
}
