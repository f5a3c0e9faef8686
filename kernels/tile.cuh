// The tile of a warp: which vertices and corners its lanes compute, and coalesced stores of the results.
#pragma once
#include "layout.cuh"

// Vertices or corners per lane. With NARROW a lane has one, and four warps share a tile, so that small scenes fill the
// device too.
#ifdef NARROW
constexpr unsigned SPAN = 1;
#else
constexpr unsigned SPAN = 4;
#endif
constexpr unsigned SHARE = 4 / SPAN; // warps per tile
constexpr unsigned FLOATS = 3 * SPAN;

__device__ __forceinline__ unsigned lane_of() {
    return threadIdx.x % 32;
}

// One lane's part of a tile.
struct Part {
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
__device__ __forceinline__ Part part_of(const DeformArgs& args, unsigned tile, unsigned share) {
    const uint4 head = __ldg((const uint4*)(args.tiles + tile));
    const uint4 tail = __ldg((const uint4*)(args.tiles + tile) + 1);
    const unsigned place = share * 32 + lane_of();
    Part part;
    part.quad = place / SHARE;
    part.within = place % SHARE * SPAN;
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
        const unsigned all = 4 * (part.width - 1) + last, before = 32 * SPAN * share;
        part.run = all > before ? min(32 * SPAN, all - before) : 0;
        part.domain = tail.x;
        part.rest = head.w;
        part.first_q = tail.y;
        part.first_scale = tail.z;
    } else {
        const unsigned at = head.z + (part.quad < part.width ? part.quad : 0);
        const uint4 lane = __ldg((const uint4*)(args.lanes + at));
        items = part.quad < part.width ? 1 + lane.z % 4 : 0;
        part.item = lane.x;
        part.domain = lane.z / 4;
        part.rest = lane.y;
        part.first_q = lane.w;
#ifdef STORE_INT8
        part.first_scale = __ldg(args.lane_scales + at);
#endif
    }
    part.item += part.within;
    part.count = items > part.within ? min(SPAN, items - part.within) : 0;
    if (part.quad >= part.width) {
        part.quad = part.within = 0;
    }
    return part;
}

// Shared memory for coalesced stores of a warp, [lane][item][component], and the destination of each lane's items.
struct Stage {
    float4 numbers[32 * SPAN]; // capacity for four components per item
    uint2 places[32];          // first item and number of items
};

__device__ __forceinline__ float* staged(Stage& stage) {
    return (float*)stage.numbers;
}

// Stages three components per item; `first` is the lane's first item.
__device__ __forceinline__ void put(Stage& stage, const Part& part, unsigned first, const float (&numbers)[FLOATS]) {
#ifdef NARROW
    float* to = staged(stage) + 3 * lane_of();
    to[0] = numbers[0];
    to[1] = numbers[1];
    to[2] = numbers[2];
#else
    float4* to = stage.numbers + 3 * lane_of();
    to[0] = make_float4(numbers[0], numbers[1], numbers[2], numbers[3]);
    to[1] = make_float4(numbers[4], numbers[5], numbers[6], numbers[7]);
    to[2] = make_float4(numbers[8], numbers[9], numbers[10], numbers[11]);
#endif
    stage.places[lane_of()] = make_uint2(first, part.count);
}

// Writes the staged numbers so that whole sectors are written. A warp of one domain writes one run, with 16 bytes per
// lane if the run is aligned.
__device__ __forceinline__ void store(float* packed, Stage& stage, const Part& part) {
    __syncwarp();
    if (part.kind & TILE_LAST) {
        const unsigned first = stage.places[0].x, floats = 3 * part.run;
        float* run = packed + 3 * (size_t)first;
        const unsigned fours = first % 4 == 0 ? floats / 4 : 0;
#pragma unroll
        for (unsigned i = lane_of(); i < 8 * FLOATS; i += 32) {
            if (i < fours) {
                __stcs((float4*)run + i, stage.numbers[i]);
            }
        }
        for (unsigned i = 4 * fours + lane_of(); i < floats; i += 32) {
            __stcs(run + i, staged(stage)[i]);
        }
    } else {
        // Number 32 k + lane of the stage belongs to lane (32 k + lane) / FLOATS. The pattern repeats every three k,
        // shifted by a whole number of lanes.
        unsigned owner[3], within[3];
#pragma unroll
        for (unsigned k = 0; k < 3; ++k) {
            owner[k] = (32 * k + lane_of()) / FLOATS;
            within[k] = (32 * k + lane_of()) % FLOATS;
        }
#pragma unroll
        for (unsigned k = 0; k < FLOATS; ++k) {
            const uint2 place = stage.places[owner[k % 3] + 96 / FLOATS * (k / 3)];
            if (within[k % 3] < 3 * place.y) {
                __stcs(packed + (3 * (size_t)place.x + within[k % 3]), staged(stage)[32 * k + lane_of()]);
            }
        }
    }
    __syncwarp();
}

// Writes four components per item, which are already staged; the destinations are those of the last `put`.
__device__ __forceinline__ void store_quadruples(float4* packed, Stage& stage) {
    __syncwarp();
#pragma unroll
    for (unsigned k = 0; k < SPAN; ++k) {
        const unsigned i = 32 * k + lane_of();
        const uint2 place = stage.places[i / SPAN];
        if (i % SPAN < place.y) {
            __stcs(packed + place.x + i % SPAN, stage.numbers[i]);
        }
    }
    __syncwarp();
}

// One component of each of a lane's items.
struct Items {
    float of[SPAN];
};

// The first component of a lane's first item in a table with `numbers` components per item: [tile][numbers][width]
// float4, or [quad][numbers] float4 for quads of mixed tiles.
__device__ __forceinline__ const float* first_of(const float4* table, const Part& part, unsigned numbers) {
    const unsigned quad = part.kind & TILE_LAST ? part.quad : 0;
    return (const float*)(table + numbers * (size_t)part.rest + quad) + part.within;
}

// Component `number` of a lane's items.
__device__ __forceinline__ Items items_of(const float4* table, const Part& part, unsigned numbers, unsigned number) {
    const float* from = first_of(table, part, numbers) + 4 * number * part.stride;
    Items items;
#ifdef NARROW
    items.of[0] = __ldg(from);
#else
    const float4 four = __ldg((const float4*)from);
    items.of[0] = four.x;
    items.of[1] = four.y;
    items.of[2] = four.z;
    items.of[3] = four.w;
#endif
    return items;
}
