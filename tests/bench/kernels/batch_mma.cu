// x = T_b (x0 + U q_b) for up to BATCH_SIZE domains b of one shape (mesh and U), by tensor cores.
//
// A quad is four consecutive vertices, a tile up to 32 quads, a chunk two modes, a step 16 modes (8 chunks). A group is
// 8 domains.
//   words           U in 16 bits per entry, per tile [chunk][3][quad] words of 16 bytes (kernels/chunk.cuh)  (in)
//   rest            x0, [quads][12] f32: x of the four vertices, then y, then z                              (in)
//   transforms      [BATCH_SIZE][3] float4: the rows of T; zeros where there is no domain                    (in)
//   inverse_scales  [BATCH_SIZE] f32: per domain, the power of two that undoes the scaling of its q          (in)
//   split_q         q, each coordinate as a pair of 16-bit numbers: the rounded coordinate, and the rounded
//                   remainder. [step][group][lane] words of 16 bytes. The word of a lane belongs to domain
//                   lane / 4 of the group, and to the modes 2 (lane % 4) + {0, 1, 8, 9} of the step: first
//                   the four rounded coordinates, then the four remainders                                   (in)
//   positions       [vertices][3] f32; domain b begins at vertex `first_vertices[b]`                         (out)
// Launch: one block of WARPS warps per tile (tests/bench/src/kernels/batch_mma.rs). CPU twin: the tests of that file.
//
// A matrix product (mma.m16n8k16) sums the 16 modes of a step for the 8 domains of a group. Its left matrix has entries
// of U, its right matrix has coordinates of q.
//
// The result is not bit-identical to that of `deform`: q has 22 bits (f16) or 16 bits (bf16), and a tensor core sums
// the 16 products of a step in its own order and with its own rounding. The a-priori error bound covers both effects.
// Unlike `deform`, this kernel does not recompute overflowing sums in f64.
//
// Design. The left matrix of a product has 16 rows and 16 columns (modes). A lane provides the rows g and g + 8 at the
// columns 2 t + {0, 1, 8, 9}, with g = lane / 4 and t = lane % 4. The sums do not depend on which vertices the rows and
// which modes the columns stand for. Here, row g is a vertex of quad g, and row g + 8 the next vertex of the same quad.
// The columns of a lane are the modes of the chunks t and t + 4. The eight quads of a warp thus need six products per
// group: one for each axis and pair of vertices. A lane loads both chunks of its quad with six loads of 16 bytes; the
// loads of a warp are whole lines of 128 bytes. One byte permutation per register turns them into the operands of the
// six products. U does not pass through shared memory. A lane receives all 12 sums of quad g (3 axes x 4 vertices) for
// a quarter of the domains, so it computes the positions of whole vertices. The sums of 16 domains, two steps of U, and
// q take 160 registers. This allows 12 warps per multiprocessor. In flight per multiprocessor:
// 12 warps x 2 steps x 8 chunks x 8 quads x 48 bytes = 72 KB.

// Types of the entries of the left and the right matrix of a product.
#if defined(STORE_BF16)
#define OPERANDS "bf16.bf16"
#else
#define OPERANDS "f16.f16"
#endif

// The number of resident blocks per multiprocessor limits the registers: with more domains, a lane has more sums.
#if defined(BATCH_8)
constexpr unsigned BATCH_SIZE = 8;
constexpr unsigned MIN_BLOCKS_PER_SM = 4;
#elif defined(BATCH_32)
constexpr unsigned BATCH_SIZE = 32;
constexpr unsigned MIN_BLOCKS_PER_SM = 2;
#else
constexpr unsigned BATCH_SIZE = 16;
constexpr unsigned MIN_BLOCKS_PER_SM = 3;
#endif
constexpr unsigned MAX_DOMAINS = 32;
constexpr unsigned GROUPS = BATCH_SIZE / 8; // groups of 8 domains, the columns of the right matrix of a product

constexpr unsigned WARPS = 4;                // per block
constexpr unsigned QUADS = 8;                // per warp
constexpr unsigned TILE_QUADS = WARPS * QUADS;
constexpr unsigned STEP_CHUNKS = 8;          // per step
// float4 per domain in the staging buffer: three per quad, and two of padding, so that the 8 lanes of a quarter warp
// access different banks.
constexpr unsigned STRIDE = 3 * QUADS + 2;

// Twin: tests/bench/src/kernels/batch_mma.rs.
struct BatchMmaArgs {
    const uint4* words;
    const float4* rest;
    const float4* transforms;
    const float* inverse_scales;
    const uint4* split_q;
    float* positions;
    unsigned first_vertices[MAX_DOMAINS]; // index of each domain's first vertex in `positions`
    unsigned domains;    // number of domains
    unsigned vertices;   // number of vertices of the shape
    unsigned chunks;     // number of chunks of the shape
    unsigned is_aligned; // 1 if the positions of every domain begin at a multiple of 16 bytes
};
static_assert(sizeof(BatchMmaArgs) == 192, "BatchMmaArgs differs from tests/bench/src/kernels/batch_mma.rs");

#if __CUDA_ARCH__ >= 800
__device__ __forceinline__ unsigned lane_id() {
    return threadIdx.x % 32;
}

// The part of a tile that a warp computes.
struct WarpPart {
    const uint4* words;    // first word of the lane's quad
    unsigned tile_quads;   // number of quads of the tile
    unsigned rest_quad;    // index of the lane's quad in the shape
    unsigned first_vertex; // index of the warp's first vertex in the shape
    unsigned coordinates;  // number of coordinates of the warp's vertices, three per vertex
};

// Describes the part of this warp. A lane beyond the last quad reads the last quad again; its results are not stored.
__device__ __forceinline__ WarpPart warp_part(const BatchMmaArgs& args) {
    const unsigned first_tile_quad = TILE_QUADS * blockIdx.x, first_warp_quad = QUADS * (threadIdx.x / 32);
    WarpPart part;
    part.tile_quads = min(TILE_QUADS, (args.vertices + 3) / 4 - first_tile_quad);
    const unsigned quad = min(first_warp_quad + lane_id() / 4, part.tile_quads - 1);
    part.words = args.words + 3 * (size_t)args.chunks * first_tile_quad + quad;
    part.rest_quad = first_tile_quad + quad;
    part.first_vertex = 4 * (first_tile_quad + first_warp_quad);
    part.coordinates = args.vertices > part.first_vertex ? 3 * min(4 * QUADS, args.vertices - part.first_vertex) : 0;
    return part;
}

// Two modes of a quad, as 12 words of 32 bits with two entries each. Words 0 to 5 belong to the first mode, words 6 to
// 11 to the second mode. Word 2 axis + pair of a mode has the entries of the vertices 2 pair and 2 pair + 1.
struct Chunk {
    unsigned words[12];
};

// Loads a chunk; beyond the last chunk, sets zeros. The coordinates of modes beyond the last chunk are zero, but memory
// there may contain NaN or infinity, whose product with zero is not zero.
__device__ __forceinline__ void load_chunk(Chunk& chunk, const BatchMmaArgs& args, const WarpPart& part, unsigned index) {
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        const uint4* src = part.words + (3 * (size_t)index + i) * part.tile_quads;
        const uint4 word = index < args.chunks ? __ldcs(src) : make_uint4(0, 0, 0, 0);
        chunk.words[4 * i] = word.x;
        chunk.words[4 * i + 1] = word.y;
        chunk.words[4 * i + 2] = word.z;
        chunk.words[4 * i + 3] = word.w;
    }
}

// The two chunks that a lane provides for a step.
struct Step {
    Chunk low, high;
};

__device__ __forceinline__ void load_step(Step& step, const BatchMmaArgs& args, const WarpPart& part, unsigned index) {
    const unsigned chunk = STEP_CHUNKS * index + lane_id() % 4;
    load_chunk(step.low, args, part, chunk);
    load_chunk(step.high, args, part, chunk + 4);
}

// Sums of the lane's quad: [2 axis + pair of vertices][group][2 (vertex in the pair) + parity]. A lane has two of the
// eight domains of a group: 2 (lane % 4) + parity, with a parity of 0 or 1.
typedef float Sums[6][GROUPS][4];

// Adds the product of the lane's entries `u` and coordinates `q0` and `q1` to `sum`. All lanes must call this.
__device__ __forceinline__ void multiply(float (&sum)[4], const unsigned (&u)[4], unsigned q0, unsigned q1) {
    asm("mma.sync.aligned.m16n8k16.row.col.f32." OPERANDS ".f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
        "{%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
        : "r"(u[0]), "r"(u[1]), "r"(u[2]), "r"(u[3]), "r"(q0), "r"(q1));
}

// Adds the modes of a step to the sums. The products with the rounding remainders of q (z, w) come before those with
// the rounded coordinates (x, y), because they are smaller.
__device__ __forceinline__ void add_step(Sums& sums, const Step& step, const uint4* split_q) {
    uint4 q[GROUPS];
#pragma unroll
    for (unsigned group = 0; group < GROUPS; ++group) {
        q[group] = __ldg(split_q + 32 * group + lane_id());
    }
#pragma unroll
    for (unsigned row = 0; row < 6; ++row) {
        const unsigned *low = step.low.words, *high = step.high.words;
        // 0x5410 selects the first vertex of the pair in both modes, 0x7632 the second vertex.
        const unsigned u[4] = {
            __byte_perm(low[row], low[6 + row], 0x5410),
            __byte_perm(low[row], low[6 + row], 0x7632),
            __byte_perm(high[row], high[6 + row], 0x5410),
            __byte_perm(high[row], high[6 + row], 0x7632),
        };
#pragma unroll
        for (unsigned group = 0; group < GROUPS; ++group) {
            multiply(sums[row][group], u, q[group].z, q[group].w);
            multiply(sums[row][group], u, q[group].x, q[group].y);
        }
    }
}

// Sums all modes. Loads run up to two steps ahead of the sums.
__device__ __forceinline__ void sum_modes(const BatchMmaArgs& args, const WarpPart& part, Sums& sums) {
    const unsigned steps = (args.chunks + STEP_CHUNKS - 1) / STEP_CHUNKS;
    const uint4* split_q = args.split_q;
    Step even, odd;
    load_step(even, args, part, 0);
    load_step(odd, args, part, 1);
#pragma unroll 1
    for (unsigned step = 0; step < steps; step += 2) {
        add_step(sums, even, split_q);
        load_step(even, args, part, step + 2);
        if (step + 1 < steps) {
            add_step(sums, odd, split_q + 32 * GROUPS);
            load_step(odd, args, part, step + 3);
        }
        split_q += 2 * 32 * GROUPS;
    }
}

__device__ __forceinline__ float transform_row(const float4& row, float x, float y, float z) {
    return fmaf(row.x, x, fmaf(row.y, y, fmaf(row.z, z, row.w)));
}

// Computes the positions of the lane's quad for one domain and writes them to `staged`, three float4. `rest` and `u`
// are [axis][vertex].
__device__ __forceinline__ void stage_positions(const BatchMmaArgs& args, const float4 (&rest)[3], const float (&u)[3][4],
                                      unsigned domain, float4* staged) {
    const float4* rows = args.transforms + 3 * domain;
    const float4 x_row = __ldg(rows), y_row = __ldg(rows + 1), z_row = __ldg(rows + 2);
    const float inverse_scale = __ldg(args.inverse_scales + domain);
    const float x0[3][4] = {{rest[0].x, rest[0].y, rest[0].z, rest[0].w},
                            {rest[1].x, rest[1].y, rest[1].z, rest[1].w},
                            {rest[2].x, rest[2].y, rest[2].z, rest[2].w}};
    float world_positions[12];
#pragma unroll
    for (unsigned vertex = 0; vertex < 4; ++vertex) {
        const float x = x0[0][vertex] + u[0][vertex] * inverse_scale, y = x0[1][vertex] + u[1][vertex] * inverse_scale,
                    z = x0[2][vertex] + u[2][vertex] * inverse_scale;
        world_positions[3 * vertex] = transform_row(x_row, x, y, z);
        world_positions[3 * vertex + 1] = transform_row(y_row, x, y, z);
        world_positions[3 * vertex + 2] = transform_row(z_row, x, y, z);
    }
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        staged[i] = make_float4(world_positions[4 * i], world_positions[4 * i + 1], world_positions[4 * i + 2],
                                world_positions[4 * i + 3]);
    }
}

// Stores the staged positions of the four domains `first_domain` + 0, 2, 4 and 6. Eight lanes store one domain, in
// coalesced stores of 128 bytes.
__device__ __forceinline__ void store_staged(const BatchMmaArgs& args, const WarpPart& part, unsigned first_domain,
                                      const float4* staged) {
    const unsigned domain_pair = lane_id() / 8, domain = first_domain + 2 * domain_pair;
    if (domain >= args.domains) {
        return;
    }
    float* dst = args.positions + 3 * ((size_t)args.first_vertices[domain] + part.first_vertex);
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        const unsigned vector = 8 * i + lane_id() % 8;
        const float4 coordinates = staged[STRIDE * domain_pair + vector];
        if (args.is_aligned && 4 * vector + 4 <= part.coordinates) {
            __stcs((float4*)dst + vector, coordinates);
        } else {
            const float components[4] = {coordinates.x, coordinates.y, coordinates.z, coordinates.w};
#pragma unroll
            for (unsigned k = 0; k < 4; ++k) {
                if (4 * vector + k < part.coordinates) {
                    __stcs(dst + 4 * vector + k, components[k]);
                }
            }
        }
    }
}

// Computes and stores the positions of all domains. A pass computes the four domains of a group that have equal parity.
__device__ __forceinline__ void store_positions(const BatchMmaArgs& args, const WarpPart& part, const Sums& sums,
                                         float4* staged) {
    float4 rest[3];
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        rest[axis] = __ldg(args.rest + 3 * (size_t)part.rest_quad + axis);
    }
    const unsigned quad = lane_id() / 4, domain_pair = lane_id() % 4;
#pragma unroll
    for (unsigned group = 0; group < GROUPS; ++group) {
#pragma unroll
        for (unsigned parity = 0; parity < 2; ++parity) {
            float u[3][4];
#pragma unroll
            for (unsigned i = 0; i < 12; ++i) {
                const unsigned axis = i / 4, vertex = i % 4;
                u[axis][vertex] = sums[2 * axis + vertex / 2][group][2 * (vertex % 2) + parity];
            }
            const unsigned first_domain = 8 * group + parity;
            stage_positions(args, rest, u, first_domain + 2 * domain_pair, staged + STRIDE * domain_pair + 3 * quad);
            __syncwarp();
            store_staged(args, part, first_domain, staged);
            __syncwarp();
        }
    }
}
#endif

extern "C" __global__ void __launch_bounds__(32 * WARPS, MIN_BLOCKS_PER_SM)
    batch_mma(const __grid_constant__ BatchMmaArgs args) {
#if __CUDA_ARCH__ >= 800
    __shared__ float4 staged[WARPS][4 * STRIDE];
    const WarpPart part = warp_part(args);
    if (part.coordinates == 0) {
        return;
    }
    Sums sums = {};
    sum_modes(args, part, sums);
    store_positions(args, part, sums, staged[threadIdx.x / 32]);
#endif
}
