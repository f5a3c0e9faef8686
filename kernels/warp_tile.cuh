// The tile of a warp: which vertices and corners its lanes compute, and coalesced stores of the results.
#pragma once
#include "layout.cuh"

// Vertices or corners per lane. With ONE_ITEM_PER_LANE a lane has one, and four warps share a tile, so that small scenes fill the
// device too.
#ifdef ONE_ITEM_PER_LANE
constexpr unsigned ITEMS_PER_LANE = 1;
#else
constexpr unsigned ITEMS_PER_LANE = 4;
#endif
constexpr unsigned WARPS_PER_TILE = 4 / ITEMS_PER_LANE; // warps per tile
constexpr unsigned FLOATS_PER_LANE = 3 * ITEMS_PER_LANE;

__device__ __forceinline__ unsigned lane_id() {
    return threadIdx.x % 32;
}

// One lane's part of a tile.
struct LaneSlice {
    unsigned kind;
    unsigned quad; // in the tile
    unsigned width;
    unsigned chunks;
    unsigned long long first_word;
    unsigned within; // first item of the lane in its quad
    unsigned item;   // its packed index: a vertex, or a corner in a tile of corners alone
    unsigned count;  // number of items to write
    unsigned domain;
    unsigned run;    // items of the whole warp in a tile of one domain, from lane 0 on; else 0
    unsigned rest;   // quad of x0, normals and tangents: the tile's first, or the lane's own in a mixed tile
    unsigned stride; // float4 from one component of the quad to the next
    unsigned first_q;
    unsigned first_scale;
};

// A lane without an item has a count of 0 and reads the items of quad 0.
__device__ __forceinline__ LaneSlice load_lane_slice(const DeformArgs& args, unsigned tile, unsigned share) {
    const uint4 head = __ldg((const uint4*)(args.tiles + tile));
    const uint4 tail = __ldg((const uint4*)(args.tiles + tile) + 1);
    const unsigned place = share * 32 + lane_id();
    LaneSlice part;
    part.quad = place / WARPS_PER_TILE;
    part.within = place % WARPS_PER_TILE * ITEMS_PER_LANE;
    part.kind = tail.w >> 24;
    part.width = tail.w >> 16 & 0xff;
    part.chunks = tail.w & 0xffff;
    part.first_word = head.x | (unsigned long long)head.y << 32;
    const unsigned last = part.kind & TILE_LAST;
    unsigned items = 0;
    part.run = 0;
    part.item = part.domain = part.rest = part.first_q = part.first_scale = 0;
    part.stride = last > 0 ? part.width : 1;
    if (last > 0) {
        items = part.quad + 1 == part.width ? last : part.quad < part.width ? 4 : 0;
        part.item = head.z + 4 * part.quad;
        const unsigned all = 4 * (part.width - 1) + last, before = 32 * ITEMS_PER_LANE * share;
        part.run = all > before ? min(32 * ITEMS_PER_LANE, all - before) : 0;
        part.domain = tail.x;
        part.rest = head.w;
        part.first_q = tail.y;
        part.first_scale = tail.z;
    } else {
        const unsigned at = head.z + (part.quad < part.width ? part.quad : 0);
        const uint4 lane = __ldg((const uint4*)(args.mixed_quads + at));
        items = part.quad < part.width ? 1 + lane.z % 4 : 0;
        part.item = lane.x;
        part.domain = lane.z / 4;
        part.rest = lane.y;
        part.first_q = lane.w;
#ifdef STORE_INT8
        part.first_scale = __ldg(args.mixed_quad_scales + at);
#endif
    }
    part.item += part.within;
    part.count = items > part.within ? min(ITEMS_PER_LANE, items - part.within) : 0;
    if (part.quad >= part.width) {
        part.quad = part.within = 0;
    }
    return part;
}

// Shared memory for coalesced stores of a warp, [lane][item][component], and the destination of each lane's items.
struct OutputStage {
    float4 numbers[32 * ITEMS_PER_LANE]; // capacity for four components per item
    uint2 item_ranges[32];          // first item and number of items
};

__device__ __forceinline__ float* stage_data(OutputStage& stage) {
    return (float*)stage.numbers;
}

// Stages three components per item; `first` is the lane's first item.
__device__ __forceinline__ void stage_triples(OutputStage& stage, const LaneSlice& part, unsigned first, const float (&numbers)[FLOATS_PER_LANE]) {
#ifdef ONE_ITEM_PER_LANE
    float* to = stage_data(stage) + 3 * lane_id();
    to[0] = numbers[0];
    to[1] = numbers[1];
    to[2] = numbers[2];
#else
    float4* to = stage.numbers + 3 * lane_id();
    to[0] = make_float4(numbers[0], numbers[1], numbers[2], numbers[3]);
    to[1] = make_float4(numbers[4], numbers[5], numbers[6], numbers[7]);
    to[2] = make_float4(numbers[8], numbers[9], numbers[10], numbers[11]);
#endif
    stage.item_ranges[lane_id()] = make_uint2(first, part.count);
}

// Writes the staged numbers so that whole sectors are written. A warp of one domain writes one run, with 16 bytes per
// lane if the run is aligned.
__device__ __forceinline__ void store_stage(float* packed, OutputStage& stage, const LaneSlice& part) {
    __syncwarp();
    if (part.kind & TILE_LAST) {
        const unsigned first = stage.item_ranges[0].x, floats = 3 * part.run;
        float* run = packed + 3 * (size_t)first;
        const unsigned fours = first % 4 == 0 ? floats / 4 : 0;
#pragma unroll
        for (unsigned i = lane_id(); i < 8 * FLOATS_PER_LANE; i += 32) {
            if (i < fours) {
                __stcs((float4*)run + i, stage.numbers[i]);
            }
        }
        for (unsigned i = 4 * fours + lane_id(); i < floats; i += 32) {
            __stcs(run + i, stage_data(stage)[i]);
        }
    } else {
        // Number 32 k + lane of the stage belongs to lane (32 k + lane) / FLOATS. The pattern repeats every three k,
        // shifted by a whole number of lanes.
        unsigned owner[3], within[3];
#pragma unroll
        for (unsigned k = 0; k < 3; ++k) {
            owner[k] = (32 * k + lane_id()) / FLOATS_PER_LANE;
            within[k] = (32 * k + lane_id()) % FLOATS_PER_LANE;
        }
#pragma unroll
        for (unsigned k = 0; k < FLOATS_PER_LANE; ++k) {
            const uint2 place = stage.item_ranges[owner[k % 3] + 96 / FLOATS_PER_LANE * (k / 3)];
            if (within[k % 3] < 3 * place.y) {
                __stcs(packed + (3 * (size_t)place.x + within[k % 3]), stage_data(stage)[32 * k + lane_id()]);
            }
        }
    }
    __syncwarp();
}

// Writes four components per item, which are already staged; the destinations are those of the last `stage_triples`.
__device__ __forceinline__ void store_quadruples(float4* packed, OutputStage& stage) {
    __syncwarp();
#pragma unroll
    for (unsigned k = 0; k < ITEMS_PER_LANE; ++k) {
        const unsigned i = 32 * k + lane_id();
        const uint2 place = stage.item_ranges[i / ITEMS_PER_LANE];
        if (i % ITEMS_PER_LANE < place.y) {
            __stcs(packed + place.x + i % ITEMS_PER_LANE, stage.numbers[i]);
        }
    }
    __syncwarp();
}

// One component of each of a lane's items.
struct LaneItems {
    float values[ITEMS_PER_LANE];
};

// The first component of a lane's first item in a table with `numbers` components per item: [tile][numbers][width]
// float4, or [quad][numbers] float4 for quads of mixed tiles.
__device__ __forceinline__ const float* item_pointer(const float4* table, const LaneSlice& part, unsigned numbers) {
    const unsigned quad = part.kind & TILE_LAST ? part.quad : 0;
    return (const float*)(table + numbers * (size_t)part.rest + quad) + part.within;
}

// Component `number` of a lane's items.
__device__ __forceinline__ LaneItems load_items(const float4* table, const LaneSlice& part, unsigned numbers, unsigned number) {
    const float* from = item_pointer(table, part, numbers) + 4 * number * part.stride;
    LaneItems items;
#ifdef ONE_ITEM_PER_LANE
    items.values[0] = __ldg(from);
#else
    const float4 four = __ldg((const float4*)from);
    items.values[0] = four.x;
    items.values[1] = four.y;
    items.values[2] = four.z;
    items.values[3] = four.w;
#endif
    return items;
}
