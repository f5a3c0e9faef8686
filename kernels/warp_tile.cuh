// Assignment of the items (vertices or corners) of a tile to lanes, and coalesced stores of the results. layout.cuh
// defines tiles, mixed tiles and quads.
#pragma once
#include "layout.cuh"

// With ONE_ITEM_PER_LANE four warps share a tile, so that small scenes also fill the device.
#ifdef ONE_ITEM_PER_LANE
constexpr unsigned ITEMS_PER_LANE = 1;
#else
constexpr unsigned ITEMS_PER_LANE = 4;
#endif
constexpr unsigned WARPS_PER_TILE = 4 / ITEMS_PER_LANE;
constexpr unsigned FLOATS_PER_LANE = 3 * ITEMS_PER_LANE;

__device__ __forceinline__ unsigned lane_id() {
    return threadIdx.x % 32;
}

// One lane's part of a tile.
struct LaneSlice {
    unsigned kind;       // as in `WarpTile`
    unsigned quad;       // index of the lane's quad in the tile
    unsigned quad_count; // number of quads of the tile
    unsigned chunk_count;
    unsigned long long first_word; // first word of U of the tile
    unsigned item_in_quad;         // index of the lane's first item in its quad
    unsigned first_item;           // packed index of the lane's first vertex, or corner in a tile without vertices
    unsigned item_count;           // number of items to write
    unsigned domain;
    unsigned warp_item_count;  // number of items of all lanes of the warp in a tile of one domain; 0 in a mixed tile
    // Index of the tile's first quad (in a mixed tile, of the lane's quad) in the rest tables: x0, rest normals and
    // rest tangents.
    unsigned rest_quad;
    unsigned component_stride; // number of float4 vectors from one component of a quad in a rest table to the next one
    unsigned first_q;
    unsigned first_scale;
};

// Describes this lane's part of a tile. A lane without an item has `item_count` 0 and reads quad 0. `tile_warp` is the
// index of the warp in its tile.
__device__ __forceinline__ LaneSlice load_lane_slice(const DeformArgs& args, unsigned tile, unsigned tile_warp) {
    // The two halves of a `WarpTile`, with its fields in the order of layout.cuh.
    const uint4 low_words = __ldg((const uint4*)(args.tiles + tile));
    const uint4 high_words = __ldg((const uint4*)(args.tiles + tile) + 1);
    const unsigned tile_lane = tile_warp * 32 + lane_id();
    LaneSlice slice;
    slice.quad = tile_lane / WARPS_PER_TILE;
    slice.item_in_quad = tile_lane % WARPS_PER_TILE * ITEMS_PER_LANE;
    slice.kind = high_words.w >> 24;
    slice.quad_count = high_words.w >> 16 & 0xff;
    slice.chunk_count = high_words.w & 0xffff;
    slice.first_word = low_words.x | (unsigned long long)low_words.y << 32;
    const unsigned last_quad_items = slice.kind & LAST_QUAD_ITEMS;
    unsigned quad_items = 0;
    slice.warp_item_count = 0;
    slice.first_item = slice.domain = slice.rest_quad = slice.first_q = slice.first_scale = 0;
    slice.component_stride = last_quad_items > 0 ? slice.quad_count : 1;
    if (last_quad_items > 0) {
        quad_items = slice.quad + 1 == slice.quad_count ? last_quad_items : slice.quad < slice.quad_count ? 4 : 0;
        slice.first_item = low_words.z + 4 * slice.quad;
        const unsigned tile_items = 4 * (slice.quad_count - 1) + last_quad_items, preceding_items = 32 * ITEMS_PER_LANE * tile_warp;
        slice.warp_item_count = tile_items > preceding_items ? min(32 * ITEMS_PER_LANE, tile_items - preceding_items) : 0;
        slice.domain = high_words.x;
        slice.rest_quad = low_words.w;
        slice.first_q = high_words.y;
        slice.first_scale = high_words.z;
    } else {
        const unsigned mixed_quad = low_words.z + (slice.quad < slice.quad_count ? slice.quad : 0);
        // A `MixedQuad`, with its fields in the order of layout.cuh.
        const uint4 quad_words = __ldg((const uint4*)(args.mixed_quads + mixed_quad));
        quad_items = slice.quad < slice.quad_count ? 1 + quad_words.z % 4 : 0;
        slice.first_item = quad_words.x;
        slice.domain = quad_words.z / 4;
        slice.rest_quad = quad_words.y;
        slice.first_q = quad_words.w;
#ifdef STORE_INT8
        slice.first_scale = __ldg(args.mixed_quad_scales + mixed_quad);
#endif
    }
    slice.first_item += slice.item_in_quad;
    slice.item_count = quad_items > slice.item_in_quad ? min(ITEMS_PER_LANE, quad_items - slice.item_in_quad) : 0;
    if (slice.quad >= slice.quad_count) {
        slice.quad = slice.item_in_quad = 0;
    }
    return slice;
}

// Staging buffer of a warp in shared memory, for coalesced stores.
struct OutputStaging {
    float4 vectors[32 * ITEMS_PER_LANE]; // floats [lane][item][component], with three or four components per item
    uint2 item_ranges[32];               // per lane: packed index of its first item (x) and number of its items (y)
};

__device__ __forceinline__ float* staged_floats(OutputStaging& staging) {
    return (float*)staging.vectors;
}

// Writes three components per item to the staging buffer. `first_item` is the packed index of the lane's first item.
__device__ __forceinline__ void stage_triples(OutputStaging& staging, const LaneSlice& slice, unsigned first_item,
                                              const float (&triples)[FLOATS_PER_LANE]) {
#ifdef ONE_ITEM_PER_LANE
    float* lane_floats = staged_floats(staging) + 3 * lane_id();
    lane_floats[0] = triples[0];
    lane_floats[1] = triples[1];
    lane_floats[2] = triples[2];
#else
    float4* lane_vectors = staging.vectors + 3 * lane_id();
    lane_vectors[0] = make_float4(triples[0], triples[1], triples[2], triples[3]);
    lane_vectors[1] = make_float4(triples[4], triples[5], triples[6], triples[7]);
    lane_vectors[2] = make_float4(triples[8], triples[9], triples[10], triples[11]);
#endif
    staging.item_ranges[lane_id()] = make_uint2(first_item, slice.item_count);
}

// Stores a float with the cache hint of `__stcs` if `is_stored`. The store is a predicated instruction, because with a
// branch around each store the compiler would load the next float from shared memory only after the store.
__device__ __forceinline__ void store_if(bool is_stored, float* output, float number) {
    asm volatile("{ .reg .pred stored; setp.ne.u32 stored, %2, 0; @stored st.global.cs.f32 [%0], %1; }" ::"l"(output),
                 "f"(number), "r"((unsigned)is_stored)
                 : "memory");
}

// Stores the staged triples so that whole sectors of 32 bytes are written. The items of a tile of one domain are
// contiguous in the output: a lane writes 16 bytes at a time if the output is aligned, else 4 bytes. In a mixed tile, a
// lane writes 4 bytes at a time.
__device__ __forceinline__ void store_staged_triples(float* packed, OutputStaging& staging, const LaneSlice& slice) {
    __syncwarp();
    if (slice.kind & LAST_QUAD_ITEMS) {
        const unsigned first_item = staging.item_ranges[0].x, float_count = 3 * slice.warp_item_count;
        float* output = packed + 3 * (size_t)first_item;
        const unsigned vector_count = first_item % 4 == 0 ? float_count / 4 : 0;
        // The loop has a constant bound, the vectors of a full warp (32 * FLOATS_PER_LANE / 4), so that it can be
        // unrolled.
#pragma unroll
        for (unsigned i = lane_id(); i < 8 * FLOATS_PER_LANE; i += 32) {
            if (i < vector_count) {
                __stcs((float4*)output + i, staging.vectors[i]);
            }
        }
        for (unsigned i = 4 * vector_count + lane_id(); i < float_count; i += 32) {
            __stcs(output + i, staged_floats(staging)[i]);
        }
    } else {
        // In iteration k, lane i writes the staged float 32 k + i, which lane (32 k + i) / FLOATS_PER_LANE staged. The
        // pattern repeats after three iterations (96 floats), shifted by 96 / FLOATS_PER_LANE lanes, a whole number.
        unsigned owner_lane[3], number_in_lane[3];
#pragma unroll
        for (unsigned k = 0; k < 3; ++k) {
            owner_lane[k] = (32 * k + lane_id()) / FLOATS_PER_LANE;
            number_in_lane[k] = (32 * k + lane_id()) % FLOATS_PER_LANE;
        }
        // Three floats at a time, whose loads from shared memory are in flight together.
#pragma unroll
        for (unsigned first = 0; first < FLOATS_PER_LANE; first += 3) {
            bool is_stored[3];
            float *outputs[3], numbers[3];
#pragma unroll
            for (unsigned i = 0; i < 3; ++i) {
                const uint2 item_range = staging.item_ranges[owner_lane[i] + 96 / FLOATS_PER_LANE * (first / 3)];
                is_stored[i] = number_in_lane[i] < 3 * item_range.y;
                outputs[i] = packed + (3 * (size_t)item_range.x + number_in_lane[i]);
                numbers[i] = staged_floats(staging)[32 * (first + i) + lane_id()];
            }
#pragma unroll
            for (unsigned i = 0; i < 3; ++i) {
                store_if(is_stored[i], outputs[i], numbers[i]);
            }
        }
    }
    __syncwarp();
}

// Stores four staged components per item, to the item ranges of the last `stage_triples`.
__device__ __forceinline__ void store_staged_quadruples(float4* packed, OutputStaging& staging) {
    __syncwarp();
#pragma unroll
    for (unsigned k = 0; k < ITEMS_PER_LANE; ++k) {
        const unsigned i = 32 * k + lane_id();
        const uint2 item_range = staging.item_ranges[i / ITEMS_PER_LANE];
        if (i % ITEMS_PER_LANE < item_range.y) {
            __stcs(packed + item_range.x + i % ITEMS_PER_LANE, staging.vectors[i]);
        }
    }
    __syncwarp();
}

// One component of each of a lane's items.
struct LaneItems {
    float values[ITEMS_PER_LANE];
};

// Pointer to the first component of a lane's first item in a rest table (x0, normals or tangents). Such a table has
// [component][quad] float4 per tile of one domain, and [component] float4 per quad of a mixed tile. A float4 has the
// same component of the four items of a quad.
__device__ __forceinline__ const float* item_pointer(const float4* table, const LaneSlice& slice, unsigned component_count) {
    const unsigned quad = slice.kind & LAST_QUAD_ITEMS ? slice.quad : 0;
    return (const float*)(table + component_count * (size_t)slice.rest_quad + quad) + slice.item_in_quad;
}

// Loads one component of a lane's items.
__device__ __forceinline__ LaneItems load_items(const float4* table, const LaneSlice& slice, unsigned component_count,
                                                unsigned component) {
    const float* source = item_pointer(table, slice, component_count) + 4 * component * slice.component_stride;
    LaneItems items;
#ifdef ONE_ITEM_PER_LANE
    items.values[0] = __ldg(source);
#else
    const float4 vector = __ldg((const float4*)source);
    items.values[0] = vector.x;
    items.values[1] = vector.y;
    items.values[2] = vector.z;
    items.values[3] = vector.w;
#endif
    return items;
}
