// x = T (x0 + U q) for every vertex of every domain of a scene, and a box of each warp's x, in one launch over a flat
// list of tiles.
//   tiles, lanes  the work of each warp (layout.cuh)                                                        (in)
//   words         U, per tile [chunks][3][width] words of 16 bytes (chunk.cuh)                              (in)
//   rest          x0, [quads][12] f32: 4 x, 4 y, 4 z                                                        (in)
//   transforms    [domains][3] float4: the rows of world_from_domain, relative to the state's origin        (in)
//   q             packed coordinates, times the factor of their mode with STORE_F16 and STORE_BF16          (in)
//   scales        with STORE_INT8: per tile of U and mode                                                   (in)
//   kept          with TRUNCATED: per domain the chunks that are summed, ascending                          (in)
//   positions     [vertices][3] f32, in the header                                                          (out)
//   displacements with DISPLACEMENTS: u, [vertices][3] f32 in the domain's frame, in the header; and nothing else with
//                 WITHOUT_POSITIONS, for measuring                                                          (out)
//   boxes         [blocks][6] u32: `ordered` maxima of -x, -y, -z, x, y, z                                  (out)
// Launch: one warp a block. A lane computes a quad, or with NARROW one vertex of it, four blocks a tile: then small
// scenes fill the device too. Domains that have not changed since this output was written are passed over.
// CPU twin: src/reference/deform.rs.
//
// The modes of a vertex are summed in their order, from +0, by fused multiply-adds, whatever the tile and the lane: runs
// agree bit by bit. What is not finite in f32 is computed again in f64, so that only what f32 cannot hold is lost.
#include "layout.cuh"
#include "chunk.cuh"
#include "ordered.cuh"

// Vertices of a lane, and the chunks that it reads before it sums the first.
#ifdef NARROW
constexpr unsigned SPAN = 1;
#define AHEAD (16 / CHUNK_MODES)
#else
constexpr unsigned SPAN = 4;
#define AHEAD 4
#endif
constexpr unsigned FLOATS = 3 * SPAN;
// Blocks that a multiprocessor is to hold: fewer would not keep the memory busy, more would spill registers.
constexpr unsigned RESIDENT = 24;

// One lane's part of a tile.
struct Part {
    const uint4* words; // the quad's first
    unsigned stride;    // to its next word
    unsigned chunks;
    unsigned within; // the lane's first vertex in its quad
    unsigned vertex; // the same, packed
    unsigned count;  // vertices to be written
    unsigned domain;
    const float* q;
    const float* scales;
    const float4* rest;
};

// A lane without a vertex has a count of 0 and looks at those of vertex 0.
__device__ __forceinline__ Part part_of(const DeformArgs& args) {
    constexpr unsigned SHARE = 4 / SPAN;
    const unsigned tile_index = blockIdx.x / SHARE;
    const uint4 head = __ldg((const uint4*)(args.tiles + tile_index));
    const uint4 tail = __ldg((const uint4*)(args.tiles + tile_index) + 1);
    const unsigned item = blockIdx.x % SHARE * 32 + threadIdx.x;
    const unsigned quad = item / SHARE;
    const unsigned width = tail.w >> 16 & 0xff, kind = tail.w >> 24;
    Part part;
    part.words = args.words + (head.x | (unsigned long long)head.y << 32) + quad;
    part.stride = width;
    part.chunks = tail.w & 0xffff;
    part.within = item % SHARE * SPAN;
    unsigned vertices = 0, rest = 0, first_q = 0, first_scale = 0;
    if (kind > 0) {
        vertices = quad + 1 == width ? kind : quad < width ? 4 : 0;
        part.vertex = head.z + 4 * quad;
        part.domain = tail.x;
        rest = head.w + quad;
        first_q = tail.y;
        first_scale = tail.z;
    } else if (quad < width) {
        const uint4 lane = __ldg((const uint4*)(args.lanes + head.z + quad));
        vertices = 1 + lane.z % 4;
        part.vertex = lane.x;
        part.domain = lane.z / 4;
        rest = lane.y;
        first_q = lane.w;
#ifdef STORE_INT8
        first_scale = __ldg(args.lane_scales + head.z + quad);
#endif
    } else {
        part.vertex = 0;
        part.domain = 0;
    }
    part.vertex += part.within;
    part.count = vertices > part.within ? min(SPAN, vertices - part.within) : 0;
    part.rest = args.rest + 3 * (size_t)rest;
    part.q = args.q + first_q;
    part.scales = args.scales + first_scale;
    return part;
}

#ifdef MODES
// What entry (mode, axis) of the chunks is multiplied with.
struct Amounts {
    float of[CHUNK_MODES];
};

__device__ __forceinline__ Amounts amounts_of(const Part& part, unsigned chunk) {
    Amounts amounts;
#if defined(STORE_INT8)
    const float4 q = __ldg((const float4*)part.q + chunk), scale = __ldg((const float4*)part.scales + chunk);
    amounts.of[0] = q.x * scale.x;
    amounts.of[1] = q.y * scale.y;
    amounts.of[2] = q.z * scale.z;
    amounts.of[3] = q.w * scale.w;
#elif defined(STORE_F16) || defined(STORE_BF16)
    const float2 q = __ldg((const float2*)part.q + chunk);
    amounts.of[0] = q.x;
    amounts.of[1] = q.y;
#else
    amounts.of[0] = __ldg(part.q + chunk);
#endif
    return amounts;
}

// Sums of products, three to a vertex. COMPENSATED carries what rounding took away (Ogita, Rump and Oishi, "Accurate sum
// and dot product", algorithm Dot2) and costs as many registers again.
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
            entries[i] = entry_at(words, part.stride, i / 3, i % 3, part.within);
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
            const uint4 word = __ldcs(from + i * part.stride);
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
        list = args.kept + (part.q - args.q) / CHUNK_MODES;
        count = part.chunks == 0 ? 0 : __ldg(args.kept_counts + part.domain);
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

__device__ __forceinline__ void sum_modes(const DeformArgs& args, const Part& part, Sums& sums) {
    const Chosen chosen(args, part);
    const size_t step = 3 * (size_t)part.stride;
    unsigned i = 0;
    for (; i + AHEAD <= chosen.count; i += AHEAD) {
        Chunk chunks[AHEAD];
#pragma unroll
        for (unsigned k = 0; k < AHEAD; ++k) {
            chunks[k].load(part, part.words + chosen[i + k] * step);
        }
#pragma unroll
        for (unsigned k = 0; k < AHEAD; ++k) {
            add_chunk(sums, chunks[k], amounts_of(part, chosen[i + k]));
        }
    }
    for (; i < chosen.count; ++i) {
        Chunk chunk;
        chunk.load(part, part.words + chosen[i] * step);
        add_chunk(sums, chunk, amounts_of(part, chosen[i]));
    }
}
#endif

__device__ __forceinline__ float placed(const float4& row, float x, float y, float z) {
    return fmaf(row.x, x, fmaf(row.y, y, fmaf(row.z, z, row.w)));
}

// The x of one vertex of this lane in f64, rounded once: for what overflowed on its way in f32 although it need not.
__device__ __noinline__ float3 placed_exactly(const DeformArgs& args, unsigned vertex) {
    const Part part = part_of(args);
    const unsigned within = part.within + vertex;
    double bent[3];
    for (unsigned axis = 0; axis < 3; ++axis) {
        double sum = 0.0;
#ifdef MODES
        const Chosen chosen(args, part);
        for (unsigned i = 0; i < chosen.count; ++i) {
            const Amounts amounts = amounts_of(part, chosen[i]);
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const uint4* words = part.words + chosen[i] * 3 * (size_t)part.stride;
                sum += (double)entry_at(words, part.stride, mode, axis, within) * (double)amounts.of[mode];
            }
        }
#endif
        bent[axis] = (double)((const float*)part.rest)[4 * axis + within] + sum;
    }
    const float4* rows = args.transforms + 3 * (size_t)part.domain;
    float placed[3];
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float4 row = rows[axis];
        placed[axis] = (float)(row.x * bent[0] + row.y * bent[1] + row.z * bent[2] + row.w);
    }
    return make_float3(placed[0], placed[1], placed[2]);
}

// x0 + sums, in place of the sums' three numbers per vertex.
__device__ __forceinline__ void add_rest(const Part& part, float (&bent)[FLOATS]) {
#ifdef NARROW
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        bent[axis] += __ldg((const float*)part.rest + 4 * axis + part.within);
    }
#else
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float4 rest = __ldg(part.rest + axis);
        bent[4 * axis] += rest.x;
        bent[4 * axis + 1] += rest.y;
        bent[4 * axis + 2] += rest.z;
        bent[4 * axis + 3] += rest.w;
    }
#endif
}

// A warp's numbers on their way out, [lane][vertex][axis], and where each lane's vertices belong.
struct Stage {
    float numbers[32][FLOATS];
    unsigned places[32];
    unsigned counts[32];
};

__device__ __forceinline__ void put(Stage& stage, const Part& part, const float (&numbers)[FLOATS]) {
#pragma unroll
    for (unsigned i = 0; i < FLOATS; ++i) {
        stage.numbers[threadIdx.x][i] = numbers[i];
    }
    stage.places[threadIdx.x] = 3 * part.vertex;
    stage.counts[threadIdx.x] = 3 * part.count;
}

// Lanes of one domain write one run, so that sectors are written whole.
__device__ __forceinline__ void store(float* packed, const Stage& stage) {
    __syncwarp();
#pragma unroll
    for (unsigned i = threadIdx.x; i < 32 * FLOATS; i += 32) {
        const unsigned lane = i / FLOATS, within = i % FLOATS;
        if (within < stage.counts[lane]) {
            __stcs(packed + stage.places[lane] + within, stage.numbers[lane][within]);
        }
    }
    __syncwarp();
}

// The six sides of what a lane staged, as keys. Vertices that are not there count as the first.
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
        keys[axis] = ordered(-low);
        keys[3 + axis] = ordered(high);
    }
}

// Computes anew what is not finite, and says what the box is then: a NaN wins.
__device__ __noinline__ void mend(const DeformArgs& args, float* numbers, unsigned count, unsigned (&keys)[6]) {
    for (unsigned side = 0; side < 6; ++side) {
        keys[side] = 0;
    }
    for (unsigned vertex = 0; vertex < count; ++vertex) {
        float* at = numbers + 3 * vertex;
        if (!isfinite(at[0]) || !isfinite(at[1]) || !isfinite(at[2])) {
            const float3 exact = placed_exactly(args, vertex);
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

extern "C" __global__ void __launch_bounds__(32, RESIDENT) deform(const __grid_constant__ DeformArgs args) {
    __shared__ Stage stage;
    __shared__ unsigned mended[32][6];
    const Part part = part_of(args);
    const bool stale = part.count > 0 && is_stale(args.header, args.stamps, part.domain);
    if (!__any_sync(0xffffffffu, stale)) {
        return;
    }
    float bent[FLOATS];
#ifdef MODES
    Sums sums;
    sums.clear();
    if (part.count > 0) {
        sum_modes(args, part, sums);
    }
#pragma unroll
    for (unsigned i = 0; i < FLOATS; ++i) {
        bent[i] = sums.total(i);
    }
#else
#pragma unroll
    for (unsigned i = 0; i < FLOATS; ++i) {
        bent[i] = 0.0f;
    }
#endif
    float world[FLOATS];
#ifdef DISPLACEMENTS
#pragma unroll
    for (unsigned i = 0; i < FLOATS; ++i) {
        world[i] = bent[i % 3 * SPAN + i / 3];
    }
    put(stage, part, world);
    store(args.header->displacements, stage);
#endif
#ifndef WITHOUT_POSITIONS
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
    if (part.count > 0) {
        add_rest(part, bent);
        const float4* rows = args.transforms + 3 * (size_t)part.domain;
        const float4 a = __ldg(rows), b = __ldg(rows + 1), c = __ldg(rows + 2);
        float total = 0.0f;
#pragma unroll
        for (unsigned vertex = 0; vertex < SPAN; ++vertex) {
            const float x = bent[vertex], y = bent[SPAN + vertex], z = bent[2 * SPAN + vertex];
            world[3 * vertex] = placed(a, x, y, z);
            world[3 * vertex + 1] = placed(b, x, y, z);
            world[3 * vertex + 2] = placed(c, x, y, z);
            // Zero, unless one of them is not finite.
            total = fmaf(0.0f, world[3 * vertex] + world[3 * vertex + 1] + world[3 * vertex + 2], total);
        }
        put(stage, part, world);
        box_of(world, part.count, keys);
        if (total != 0.0f) {
            mend(args, stage.numbers[threadIdx.x], part.count, mended[threadIdx.x]);
#pragma unroll
            for (unsigned side = 0; side < 6; ++side) {
                keys[side] = mended[threadIdx.x][side];
            }
        }
    } else {
        stage.counts[threadIdx.x] = 0;
    }
    store(args.header->positions, stage);
#pragma unroll
    for (unsigned side = 0; side < 6; ++side) {
        const unsigned key = warp_max(keys[side]);
        if (threadIdx.x == side) {
            args.boxes[6 * (size_t)blockIdx.x + side] = key;
        }
    }
#endif
}
