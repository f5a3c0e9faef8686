// A warp's tile: which vertices and corners its lanes have, and the way out for what they compute.
#pragma once
#include "layout.cuh"

// Vertices or corners of a lane. With NARROW a lane has one, and four warps share a tile: small scenes then fill the
// device too.
#ifdef NARROW
constexpr unsigned SPAN = 1;
#else
constexpr unsigned SPAN = 4;
#endif
constexpr unsigned SHARE = 4 / SPAN; // warps of a tile
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
    unsigned within; // the lane's first item in its quad
    unsigned item;   // the same, packed: a vertex, or a corner of a tile of corners alone
    unsigned count;  // items to be written
    unsigned domain;
    unsigned rest; // quad of x0, and of normals and tangents
    unsigned first_q;
    unsigned first_scale;
};

// A lane without an item has a count of 0 and looks at those of quad 0.
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
    part.item = part.domain = part.rest = part.first_q = part.first_scale = 0;
    if (last > 0) {
        items = part.quad + 1 == part.width ? last : part.quad < part.width ? 4 : 0;
        part.item = head.z + 4 * part.quad;
        part.domain = tail.x;
        part.rest = head.w + part.quad;
        part.first_q = tail.y;
        part.first_scale = tail.z;
    } else if (part.quad < part.width) {
        const uint4 lane = __ldg((const uint4*)(args.lanes + head.z + part.quad));
        items = 1 + lane.z % 4;
        part.item = lane.x;
        part.domain = lane.z / 4;
        part.rest = lane.y;
        part.first_q = lane.w;
#ifdef STORE_INT8
        part.first_scale = __ldg(args.lane_scales + head.z + part.quad);
#endif
    }
    part.item += part.within;
    part.count = items > part.within ? min(SPAN, items - part.within) : 0;
    if (part.quad >= part.width) {
        part.quad = part.within = 0;
    }
    return part;
}

// A warp's numbers on their way out, [lane][item][axis], and where each lane's items belong.
struct Stage {
    float4 numbers[32 * SPAN]; // room for four numbers an item
    unsigned places[32];
    unsigned counts[32];
};

__device__ __forceinline__ float* staged(Stage& stage) {
    return (float*)stage.numbers;
}

__device__ __forceinline__ void put(Stage& stage, const float (&numbers)[FLOATS], unsigned item, unsigned count) {
#pragma unroll
    for (unsigned i = 0; i < FLOATS; ++i) {
        staged(stage)[FLOATS * lane_of() + i] = numbers[i];
    }
    stage.places[lane_of()] = item;
    stage.counts[lane_of()] = count;
}

// Three numbers an item. Lanes of one domain write one run, so that sectors are written whole; where a whole warp has
// one run that begins at 16 bytes, it writes 16 bytes a lane.
__device__ __forceinline__ void store(float* packed, Stage& stage, bool is_run) {
    __syncwarp();
    const unsigned first = stage.places[0];
    if (is_run && first % 4 == 0 && stage.counts[31] == SPAN) {
        float4* run = (float4*)(packed + 3 * (size_t)first);
#pragma unroll
        for (unsigned i = lane_of(); i < 8 * FLOATS; i += 32) {
            __stcs(run + i, stage.numbers[i]);
        }
    } else {
#pragma unroll
        for (unsigned i = lane_of(); i < 32 * FLOATS; i += 32) {
            const unsigned lane = i / FLOATS, within = i % FLOATS;
            if (within < 3 * stage.counts[lane]) {
                __stcs(packed + 3 * (size_t)stage.places[lane] + within, staged(stage)[i]);
            }
        }
    }
    __syncwarp();
}

// Four numbers an item, which lie in the stage already; places and counts are those of the last `put`.
__device__ __forceinline__ void store_quadruples(float4* packed, Stage& stage) {
    __syncwarp();
#pragma unroll
    for (unsigned i = lane_of(); i < 32 * SPAN; i += 32) {
        const unsigned lane = i / SPAN, within = i % SPAN;
        if (within < stage.counts[lane]) {
            __stcs(packed + stage.places[lane] + within, stage.numbers[i]);
        }
    }
    __syncwarp();
}

// Four numbers of a quad, or with NARROW one of them: `from` is [numbers][4].
struct Items {
    float of[SPAN];
};

__device__ __forceinline__ Items items_of(const float4* from, unsigned within) {
    Items items;
#ifdef NARROW
    items.of[0] = __ldg((const float*)from + within);
#else
    const float4 four = __ldg(from);
    items.of[0] = four.x;
    items.of[1] = four.y;
    items.of[2] = four.z;
    items.of[3] = four.w;
#endif
    return items;
}

// Asks for the line of an address, so that whoever loads it later finds it in the L2.
__device__ __forceinline__ void prefetch(const void* address) {
    asm volatile("prefetch.global.L2 [%0];" ::"l"(address));
}
