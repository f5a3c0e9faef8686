// What the host hands to the kernels, and how a thread finds its domain. Twin: src/gpu/layout.rs; tests compare the size
// and the offset of every field.
#pragma once

// Threads of a block, and the packed vertices or corners that one block computes.
constexpr unsigned BLOCK = 256;
// `first_tangent` of a shape without tangents.
constexpr unsigned NO_TANGENTS = 0xffffffffu;

// Where the vertices of one domain lie. Instances share `first_entry`, domains with common coordinates `first_q`.
struct VertexSlot {
    unsigned long long first_entry; // of x0 and U in `columns`
    unsigned first;                 // packed vertex
    unsigned stride;                // floats from one plane of `columns` to the next
    unsigned rank;                  // r
    unsigned first_q;
};
static_assert(sizeof(VertexSlot) == 24, "VertexSlot differs from src/gpu/layout.rs");

// Where the corners of one domain lie. Instances share `first_normal` and `first_tangent`.
struct CornerSlot {
    unsigned first; // packed corner
    unsigned first_normal;
    unsigned first_tangent;
};
static_assert(sizeof(CornerSlot) == 12, "CornerSlot differs from src/gpu/layout.rs");

struct DeformArgs {
    const VertexSlot* slots;
    const unsigned* first_domains;
    const float* columns;
    const float4* transforms;
    const float* q;
    float* positions;
    unsigned* bounds;
    unsigned vertices;
    unsigned reserved;
};
static_assert(sizeof(DeformArgs) == 64, "DeformArgs differs from src/gpu/layout.rs");

struct OrientArgs {
    const CornerSlot* slots;
    const unsigned* first_domains;
    const float* rest_normals;
    const float4* rest_tangents;
    const float4* transforms;
    float* normals;
    float4* tangents;
    unsigned corners;
    unsigned rest_corners;
};
static_assert(sizeof(OrientArgs) == 64, "OrientArgs differs from src/gpu/layout.rs");

// The domain of a packed vertex or corner: the last slot that begins at or before it. `first_domains[b]` is the domain
// of the first item of block b, and one more entry names the last domain; inside one domain nothing is searched.
template <typename Slot>
__device__ inline unsigned domain_of(const Slot* slots, const unsigned* first_domains, unsigned item) {
    unsigned low = first_domains[blockIdx.x];
    unsigned high = first_domains[blockIdx.x + 1];
    while (low < high) {
        const unsigned middle = (low + high + 1) / 2;
        if (slots[middle].first <= item) {
            low = middle;
        } else {
            high = middle - 1;
        }
    }
    return low;
}

// Writes a block's three numbers per item as one run, so that a warp fills whole sectors. `staged` is complete when
// the caller's last barrier was.
__device__ inline void store_triples(float* packed, const float* staged, unsigned items) {
    const unsigned begin = blockIdx.x * BLOCK;
    const unsigned floats = 3 * min(BLOCK, items - begin);
    for (unsigned i = threadIdx.x; i < floats; i += BLOCK) {
        packed[3 * begin + i] = staged[i];
    }
}
