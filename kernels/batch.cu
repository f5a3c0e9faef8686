// x = T_b (x0 + U q_b) for groups of up to BATCH_SIZE domains b with the same shape (mesh and U). The domains of a
// group are its members. The kernel reads U once per group.
//
// A quad is four consecutive vertices, a tile up to 32 quads of a shape, a chunk a few modes (chunk.cuh).
//   blocks          the work of each block: a group, and a range of tiles of its shape                       (in)
//   groups          per group: its members, and the offsets of the U and x0 of its shape (layout.cuh)        (in)
//   members         the members of all groups                                                                (in)
//   words           U, per tile of a shape [chunk][3 words of a quad][quad], 16 bytes per word               (in)
//   rest_positions  x0, per tile of a shape [axis][quad][vertex in the quad] f32                             (in)
//   scales          with STORE_INT8: one scale per tile of a shape and mode                                  (in)
//   transforms, transform_links, follower_frames, q  as described in deform.cu                              (in)
//   positions       [vertices][3] f32, address in the header                                                 (out)
//   boxes           [tiles of `deform`][4 boxes][6 keys] u32: `float_to_ordered` keys of the maxima of -x, -y, -z,
//                   x, y, z. Each of the two warps of a tile writes its box twice. A warp without vertices writes
//                   none: its two boxes keep the zeros of their allocation                                   (out)
// Launch: a block of WARPS warps per `BatchBlock`. Dynamic shared memory: a `WarpStorage` per warp, one `BlockStorage`,
// and q. CPU twin: the tests of src/compute/gpu/executor/launchers/batch.rs.
//
// Each vertex sums its modes in order, from +0, by fused multiply-adds, as in `deform`, so the results are
// bit-identical. A result that is not finite in f32 is computed again in f64.
//
// Design, for 16 members. Per mode, a vertex needs 3 axes x 16 members = 48 multiply-adds. A multiprocessor receives
// 128 bytes per cycle from shared memory (one f32 for each lane of a warp), and issues 4 warp instructions per cycle.
// Cycles per warp and mode:
// - One vertex per lane: a lane loads 16 q and 3 entries of U: 19 cycles. Arithmetic takes 48 / 4 = 12 cycles.
// - Two vertices per lane: a lane loads 16 q and 6 entries: 22 cycles. Arithmetic takes 96 / 4 = 24 cycles. The kernel
//   therefore computes two vertices per lane. (Narrower entries load no faster than f32, because of bank conflicts.)
// A lane thus has 96 sums and about 128 registers, which limits a multiprocessor to 16 warps. So few warps saturate the
// memory bandwidth only if loads in flight need no registers. Therefore each warp copies U to shared memory
// asynchronously, RING_STAGES stages ahead. In flight per multiprocessor: 16 warps x 3 stages x 3 KB = 144 KB. Needed
// at 5 TB/s and a latency of 1 us: 5 MB for the device, 38 KB for each of 132 multiprocessors.
#include "batch_load.cuh"
#include "ordered_float.cuh"

// Number of resident blocks per multiprocessor for which the compiler limits the registers. A block has two warps and
// 21 KB of shared memory, plus its q. On sm_90, registers allow 8 blocks with 16 members. With fewer members, the
// shared memory of 228 KB allows 10.
#if __CUDA_ARCH__ == 900
constexpr unsigned MIN_BLOCKS_PER_SM = BATCH_SIZE == 16 ? 8 : 10;
#elif __CUDA_ARCH__ == 800 || __CUDA_ARCH__ == 1000
// 6 blocks instead of 8: the compiler needs more registers for these architectures.
constexpr unsigned MIN_BLOCKS_PER_SM = 6;
#else
// Other architectures have less shared memory: 100 KB on sm_86 and sm_89.
constexpr unsigned MIN_BLOCKS_PER_SM = 4;
#endif

// Unroll factor of the loop over chunks. An unrolled iteration has at least two modes, so that the compiler can
// interleave the loads of one mode with the sums of another.
constexpr unsigned CHUNK_UNROLL = CHUNK_MODES < 2 ? 2 : 1;

// The same component (x, y or z) of a lane's two vertices.
struct VertexPair {
    float values[2];
};

// Loads the entries of U of a lane's two vertices for one mode and axis; `mode_axis` is mode * 3 + axis. `chunk` is the
// first byte of the two vertices in a chunk in shared memory, where the words of a quad are WARP_QUADS words apart.
__device__ __forceinline__ VertexPair load_vertex_pair(const char* chunk, unsigned mode_axis) {
    const unsigned byte_offset = 4 * ENTRY_BYTES * mode_axis;
    const char* entries = chunk + byte_offset / 16 * (16 * WARP_QUADS) + byte_offset % 16;
    // `decode_entry` takes the 12 registers of a whole chunk; the two entries are in the first ones.
    unsigned registers[12] = {};
#if defined(STORE_INT8)
    registers[0] = *(const unsigned short*)entries;
#elif defined(STORE_F16) || defined(STORE_BF16)
    registers[0] = *(const unsigned*)entries;
#else
    const uint2 bits = *(const uint2*)entries;
    registers[0] = bits.x;
    registers[1] = bits.y;
#endif
    VertexPair pair;
    pair.values[0] = decode_entry(registers, 0);
#if defined(STORE_F16)
    // Convert the upper half directly, without a shift.
    asm("{ .reg .b16 low, high; mov.b32 {low, high}, %1; cvt.f32.f16 %0, high; }" : "=f"(pair.values[1]) : "r"(registers[0]));
#else
    pair.values[1] = decode_entry(registers, 1);
#endif
    return pair;
}

// u of a lane's two vertices for all members: [2 * axis + vertex][member].
typedef float Sums[6][BATCH_SIZE];

// Adds one mode to the sums of the members `first_member` to `first_member + 3`. `pairs` has the entries of each axis.
__device__ __forceinline__ void add_four_members(Sums& sums, unsigned first_member, const VertexPair (&pairs)[3],
                                                 const float4& q_of_members) {
    const float weights[4] = {q_of_members.x, q_of_members.y, q_of_members.z, q_of_members.w};
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
#pragma unroll
        for (unsigned k = 0; k < 4; ++k) {
            sums[i][first_member + k] = fmaf(pairs[i / 2].values[i % 2], weights[k], sums[i][first_member + k]);
        }
    }
}

// Adds all modes of a chunk. `q_of_members` is the first mode of the chunk in [mode][member / 4].
__device__ __forceinline__ void add_chunk(Sums& sums, const char* chunk, const float4* q_of_members) {
#pragma unroll
    for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
        const VertexPair pairs[3] = {load_vertex_pair(chunk, 3 * mode), load_vertex_pair(chunk, 3 * mode + 1),
                                     load_vertex_pair(chunk, 3 * mode + 2)};
#pragma unroll
        for (unsigned quadruple = 0; quadruple < BATCH_SIZE / 4; ++quadruple) {
            add_four_members(sums, 4 * quadruple, pairs, q_of_members[mode * (BATCH_SIZE / 4) + quadruple]);
        }
    }
}

// Sums all modes, stage by stage. The caller has started the copies of the first RING_STAGES stages. With 16-bit
// entries all registers are in use, and the stage counter spills to local memory: a few bytes, once per stage.
__device__ __forceinline__ void sum_modes(const WarpSlice& slice, WarpStorage& storage, const float4* q, Sums& sums) {
    // Two lanes share a quad, which has 16 bytes in each row of words.
    const unsigned lane_offset = 16 * (lane_id() / 2) + 2 * ENTRY_BYTES * (lane_id() % 2);
#pragma unroll 1
    for (unsigned stage = 0; STAGE_CHUNKS * stage < slice.chunk_count; ++stage) {
        cp_async_wait<RING_STAGES - 1>();
        const char* chunk = (const char*)(storage.ring + stage % RING_STAGES * STAGE_WORDS) + lane_offset;
        const unsigned chunk_count = min(STAGE_CHUNKS, slice.chunk_count - STAGE_CHUNKS * stage);
#pragma unroll CHUNK_UNROLL
        for (unsigned i = 0; i < chunk_count; ++i) {
            add_chunk(sums, chunk, q);
            chunk += 3 * 16 * WARP_QUADS; // three rows of words of 16 bytes
            q += CHUNK_MODES * (BATCH_SIZE / 4);
        }
        __syncwarp();
        if (STAGE_CHUNKS * (stage + RING_STAGES) < slice.chunk_count) {
            copy_stage(slice, storage, stage + RING_STAGES);
        }
        cp_async_commit();
    }
}

// x0 of a lane's two vertices.
struct RestPositionPair {
    float2 x, y, z; // each with the coordinate of the first vertex, then of the second
    __device__ __forceinline__ void load(const WarpStorage& storage) {
        const float* rest_positions = (const float*)(storage.rest_positions + lane_id() / 2) + 2 * (lane_id() % 2);
        x = *(const float2*)rest_positions;
        y = *(const float2*)(rest_positions + 4 * WARP_QUADS);
        z = *(const float2*)(rest_positions + 8 * WARP_QUADS);
    }
};

// Number of vertices of a lane: 0, 1 or 2.
__device__ __forceinline__ unsigned count_lane_vertices(const WarpSlice& slice) {
    return slice.vertex_count > 2 * lane_id() ? min(2u, slice.vertex_count - 2 * lane_id()) : 0;
}

// Address of the two boxes of this warp's half of a tile. A tile has four boxes of six keys, 24 keys.
__device__ __forceinline__ unsigned* warp_box_keys(const BatchArgs& args, const WarpSlice& slice, const BatchMember& member) {
    return args.boxes + 24 * (size_t)(member.first_tile + slice.tile) + 12 * (threadIdx.x / 32);
}

// Computes x of a lane's two vertices for one member, and writes it to `staged`, [vertex of the warp][3].
__device__ __forceinline__ void stage_member(const RestPositionPair& rest, const BlockStorage& block, const Sums& sums, unsigned member,
                                             float* staged) {
    const Affine& t = block.transforms[member];
    const float4 a = t.row0, b = t.row1, c = t.row2;
    float positions[6];
#pragma unroll
    for (unsigned i = 0; i < 2; ++i) {
        const float px = (i ? rest.x.y : rest.x.x) + sums[i][member], py = (i ? rest.y.y : rest.y.x) + sums[2 + i][member],
                    pz = (i ? rest.z.y : rest.z.x) + sums[4 + i][member];
        positions[3 * i] = transform_row(a, px, py, pz);
        positions[3 * i + 1] = transform_row(b, px, py, pz);
        positions[3 * i + 2] = transform_row(c, px, py, pz);
    }
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        ((float2*)staged)[3 * lane_id() + i] = make_float2(positions[2 * i], positions[2 * i + 1]);
    }
}

// Three sides of a box: the lower ones, maxima of -x, -y, -z, or the upper ones, maxima of x, y, z. A side is NaN if a
// position has a NaN.
struct BoxSides {
    float values[3];
};

// Sides of an empty box.
__device__ __forceinline__ BoxSides empty_sides() {
    const float NEGATIVE_INFINITY = __uint_as_float(0xff800000u);
    return {NEGATIVE_INFINITY, NEGATIVE_INFINITY, NEGATIVE_INFINITY};
}

// Exchanges sides with the lane that differs in `lane_bit`. The lane without this bit returns the merged sides `a` of
// both lanes, the lane with this bit the merged sides `b`. All lanes must call this.
__device__ __forceinline__ BoxSides exchange_sides(const BoxSides& a, const BoxSides& b, unsigned lane_bit) {
    const bool keeps_b = lane_id() & lane_bit;
    BoxSides merged;
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float received = __shfl_xor_sync(0xffffffffu, keeps_b ? a.values[axis] : b.values[axis], lane_bit);
        merged.values[axis] = max_or_nan(keeps_b ? b.values[axis] : a.values[axis], received);
    }
    return merged;
}

// Computes sides of the boxes of two staged members. Each half warp (16 lanes) reads one member, with four vertices
// (three float4) per lane. Lanes 0 to 7 of a half warp return lower sides, lanes 8 to 15 upper sides, each of eight
// vertices.
__device__ __forceinline__ BoxSides compute_pair_sides(const WarpSlice& slice, const float4* staged) {
    const unsigned half_lane = lane_id() % 16;
    const float4* lane_vectors = staged + 48 * (lane_id() / 16) + 3 * half_lane;
    const float4 vector0 = lane_vectors[0], vector1 = lane_vectors[1], vector2 = lane_vectors[2];
    const float coordinates[12] = {vector0.x, vector0.y, vector0.z, vector0.w, vector1.x, vector1.y,
                                   vector1.z, vector1.w, vector2.x, vector2.y, vector2.z, vector2.w};
    const float NEGATIVE_INFINITY = __uint_as_float(0xff800000u);
    BoxSides lower, upper;
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        lower.values[axis] = 4 * half_lane < slice.vertex_count ? -coordinates[axis] : NEGATIVE_INFINITY;
        upper.values[axis] = 4 * half_lane < slice.vertex_count ? coordinates[axis] : NEGATIVE_INFINITY;
    }
#pragma unroll
    for (unsigned i = 3; i < 12; ++i) {
        if (slice.vertex_count == WARP_VERTICES || 4 * half_lane + i / 3 < slice.vertex_count) {
            lower.values[i % 3] = max_or_nan(lower.values[i % 3], -coordinates[i]);
            upper.values[i % 3] = max_or_nan(upper.values[i % 3], coordinates[i]);
        }
    }
    return exchange_sides(lower, upper, 8);
}

// Number of exchanges that distribute the sides of all pairs of members over the lanes of half a warp: of the lane bits
// 4, 2, 1 with 8 pairs.
constexpr unsigned PAIR_LEVELS = BATCH_SIZE == 16 ? 3 : BATCH_SIZE == 8 ? 2 : 1;

// Writes the boxes of all members, from the sides that `store_members` has merged. Sets `has_non_finite` if a box is
// not finite; then `repair_non_finite` computes the boxes again.
__device__ __forceinline__ void write_boxes(const BatchArgs& args, WarpSlice& slice, const BlockStorage& block, BoxSides sides) {
    // With fewer pairs than lanes, several lanes have sides of the same box.
#pragma unroll
    for (unsigned lane_bit = 4 >> PAIR_LEVELS; lane_bit > 0; lane_bit /= 2) {
        sides = exchange_sides(sides, sides, lane_bit);
    }
    // Bit i of the pair is the lane bit of the exchange at level i.
    unsigned pair = 0;
#pragma unroll
    for (unsigned level = 0; level < PAIR_LEVELS; ++level) {
        pair |= (lane_id() >> (2 - level) & 1) << level;
    }
    const unsigned member = 2 * pair + lane_id() / 16;
    if (member < slice.member_count) {
        // Half a tile has two of the tile's four boxes.
        unsigned* keys = warp_box_keys(args, slice, block.members[member]) + 3 * (lane_id() / 8 % 2);
        bool is_finite = true;
#pragma unroll
        for (unsigned axis = 0; axis < 3; ++axis) {
            keys[axis] = keys[6 + axis] = non_nan_to_ordered(sides.values[axis]);
            is_finite = is_finite && isfinite(sides.values[axis]);
        }
        if (!is_finite) {
            slice.has_non_finite = 1;
        }
    }
}

// Keeps the compiler from moving loads across this call. Loads in parallel would need more registers than are
// available.
__device__ __forceinline__ void fence_loads() {
    __syncwarp();
}

// Stores the two staged members: 48 float4 each, for 64 vertices.
__device__ __forceinline__ void store_two_members(float* first_output, float* second_output, const float4* staged) {
    const unsigned lane = lane_id();
    float4 *first_vectors = (float4*)first_output, *second_vectors = (float4*)second_output;
    __stcs(first_vectors + lane, staged[lane]);
    fence_loads();
    __stcs(lane < 16 ? first_vectors + 32 + lane : second_vectors + lane - 16, staged[32 + lane]);
    fence_loads();
    __stcs(second_vectors + 16 + lane, staged[64 + lane]);
}

__device__ __forceinline__ float* output_pointer(const WarpSlice& slice, const BatchMember& member) {
    return slice.positions + 3 * (size_t)member.first_vertex;
}

// Stores the two staged members float by float, for incomplete slices and unaligned outputs.
__device__ __forceinline__ void store_floats(const WarpSlice& slice, const BlockStorage& block, unsigned first_member,
                                              const float* staged) {
    const unsigned float_count = 3 * slice.vertex_count;
#pragma unroll 1
    for (unsigned i = 0; i < 2 && first_member + i < slice.member_count; ++i) {
        float* output = output_pointer(slice, block.members[first_member + i]);
#pragma unroll 1
        for (unsigned k = lane_id(); k < float_count; k += 32) {
            __stcs(output + k, staged[i * 3 * WARP_VERTICES + k]);
        }
    }
}

// Stages and stores two members at a time. The ring of U is no longer needed, so its memory is the staging buffer. The
// loop alternates between two halves of this buffer: a barrier lies between the reads of a half and the next writes to
// it.
__device__ __forceinline__ void store_members(const BatchArgs& args, WarpSlice& slice, WarpStorage& storage,
                                              const BlockStorage& block, const Sums& sums) {
    BoxSides carries[PAIR_LEVELS + 1];
#pragma unroll
    for (unsigned member = 0; member < BATCH_SIZE; member += 2) {
        BoxSides sides = empty_sides();
        if (member < slice.member_count) {
            const bool has_two_members = member + 1 < slice.member_count;
            float* staged = (float*)storage.ring + member / 2 % 2 * (2 * 3 * WARP_VERTICES);
            RestPositionPair rest;
            rest.load(storage);
            stage_member(rest, block, sums, member, staged);
            // Without a second member, `load_members` has stored a zero transform, and the result is not stored.
            stage_member(rest, block, sums, member + 1, staged + 3 * WARP_VERTICES);
            const BatchMember &first = block.members[member], &second = block.members[member + 1];
            __syncwarp();
            sides = compute_pair_sides(slice, (const float4*)staged);
            if (has_two_members && slice.vertex_count == WARP_VERTICES && (first.first_vertex | second.first_vertex) % 4 == 0) {
                store_two_members(output_pointer(slice, first), output_pointer(slice, second), (const float4*)staged);
            } else {
                store_floats(slice, block, member, staged);
            }
        }
        // Merge two pairs with one exchange, after which half of the lanes have the sides of each pair, then two of
        // these results, and so on, like the carries of a binary counter. This takes half as many exchanges as a
        // reduction of each pair. Inline, because otherwise the compiler spills registers.
        unsigned level = 0;
#pragma unroll
        for (; member / 2 >> level & 1; ++level) {
            sides = exchange_sides(carries[level], sides, 4 >> level);
        }
        carries[level] = sides;
    }
    write_boxes(args, slice, block, carries[PAIR_LEVELS]);
}

// Computes x of one vertex of this lane in f64 and rounds it once. The member's coordinate of mode m is at
// q[m * BATCH_SIZE].
__device__ __forceinline__ float3 position_f64(const BatchArgs& args, const WarpSlice& slice, const BatchMember& member,
                                                 const float* q, unsigned vertex) {
    const unsigned quad = lane_id() / 2, vertex_in_quad = 2 * (lane_id() % 2) + vertex;
    double point[3];
    for (unsigned axis = 0; axis < 3; ++axis) {
        double sum = 0.0;
        for (unsigned chunk = 0; chunk < slice.chunk_count; ++chunk) {
            const uint4* words = slice.words + quad + chunk * 3 * (size_t)slice.tile_quads;
            for (unsigned mode = 0; mode < CHUNK_MODES; ++mode) {
                const float weight = q[(chunk * CHUNK_MODES + mode) * BATCH_SIZE];
                sum += (double)load_entry(words, slice.tile_quads, mode, axis, vertex_in_quad) * (double)weight;
            }
        }
        point[axis] = (double)((const float*)(slice.rest_positions + axis * slice.tile_quads + quad))[vertex_in_quad] + sum;
    }
    return transform_domain_point_f64(transforms_of(args), member.domain, point);
}

// Writes the box of one member's vertices in this warp, to both boxes of the warp. Lane i of 12 writes key i % 6.
__device__ __forceinline__ void write_box(const BatchArgs& args, const WarpSlice& slice, const BatchMember& member,
                                          const unsigned (&keys)[6]) {
    const unsigned key = reduce_box_keys(keys);
    if (lane_id() < 12) {
        warp_box_keys(args, slice, member)[lane_id()] = key;
    }
}

// Recomputes the positions of a warp that are not finite, and the boxes of all members. Reads the positions back from
// the output. NaN has the largest key, so a position with a NaN gives a box with a NaN.
__device__ __noinline__ void repair_non_finite(const BatchArgs& args, const BlockStorage& block, const float* q) {
    const WarpSlice& slice = block.slices[threadIdx.x / 32];
    const unsigned vertex_count = count_lane_vertices(slice);
    for (unsigned member_index = 0; member_index < slice.member_count; ++member_index) {
        const BatchMember& member = block.members[member_index];
        float* position = output_pointer(slice, member) + 6 * lane_id();
        unsigned keys[6] = {};
        for (unsigned vertex = 0; vertex < vertex_count; ++vertex, position += 3) {
            if (!isfinite(position[0]) || !isfinite(position[1]) || !isfinite(position[2])) {
                const float3 repaired_position = position_f64(args, slice, member, q + member_index, vertex);
                position[0] = repaired_position.x;
                position[1] = repaired_position.y;
                position[2] = repaired_position.z;
            }
            for (unsigned axis = 0; axis < 3; ++axis) {
                keys[axis] = max(keys[axis], float_to_ordered(-position[axis]));
                keys[3 + axis] = max(keys[3 + axis], float_to_ordered(position[axis]));
            }
        }
        write_box(args, slice, member, keys);
    }
}

// Computes the slice of this warp. The caller has started the copies of the slice's U and x0.
__device__ __forceinline__ void compute_slice(const BatchArgs& args, uint4* shared) {
    WarpStorage& storage = warp_storage(shared);
    BlockStorage& block = block_storage(shared);
    WarpSlice& slice = block.slices[threadIdx.x / 32];
    Sums sums;
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
#pragma unroll
        for (unsigned member = 0; member < BATCH_SIZE; ++member) {
            sums[i][member] = 0.0f;
        }
    }
    sum_modes(slice, storage, shared_q(shared), sums);
    cp_async_wait<0>();
    store_members(args, slice, storage, block, sums);
    // A repair reads positions that other lanes wrote, and the next tile overwrites buffers that other lanes read.
    __syncwarp();
    if (slice.has_non_finite) {
        repair_non_finite(args, block, (const float*)shared_q(shared));
    }
}

extern "C" __global__ void __launch_bounds__(32 * WARPS, MIN_BLOCKS_PER_SM) batch(const __grid_constant__ BatchArgs args) {
    extern __shared__ uint4 shared[];
    const WarpSlice& slice = block_storage(shared).slices[threadIdx.x / 32];
    // A `BatchBlock`: x is the group, y the next tile, z the end tile.
    uint4 work = __ldg((const uint4*)(args.blocks + blockIdx.x));
    bool is_first = true;
#pragma unroll 1
    do {
        load_tile_async(args, load_warp_slice(args, work.x, work.y, work.z), shared, is_first);
        if (slice.quad_count > 0) {
            compute_slice(args, shared);
        }
        // Read `work` again from shared memory, because the sums occupied all registers.
        work = {slice.group, slice.tile + 1, slice.end_tile, 0};
        is_first = false;
        __syncwarp();
    } while (work.y < work.z);
}
