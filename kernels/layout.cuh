// Structs and constants that host and kernels share. The host's copy is src/compute/gpu/tables/layout.rs; tests compare
// the size of every struct and the offset of every field. The comment at the top of each kernel file describes the
// arrays in the kernel's arguments.
//
// Terms:
// - A shape is a mesh with its modes U. Several domains can use one shape.
// - An item is a vertex or a corner (a vertex of a triangle, with its normal). A quad is four consecutive items of a
//   domain.
// - A tile is up to 32 quads, the work of one warp. A mixed tile has quads of several domains.
// - A chunk is 1, 2 or 4 modes, depending on the storage type of U (chunk.cuh).
// - A full step computes all domains. A partial step computes only the dirty tiles: those of domains that changed after
//   the step that the output buffers contain.
// - The tables of all domains are concatenated: the packed index of a vertex or corner counts the vertices or corners
//   of all preceding domains too.
// - A field `first_X` is the index of the first element in the table of X: `first_word` in `words`, `first_q` in `q`.
//   An index of a quad refers to the quads of `rest_positions`, `rest_normals` and `rest_tangents`.
#pragma once

// Threads per block of `apply`, `bounds` and `normals`, and packed corners per block of `normals`.
constexpr unsigned BLOCK = 256;
// Maximum number of quads of a tile, which is the work of one warp.
constexpr unsigned TILE_QUADS = 32;
// `first_tangent` of a shape without tangents.
constexpr unsigned NO_TANGENTS = 0xffffffffu;
// `first_corner_group` of a shape without smoothing groups.
constexpr unsigned NO_GROUPS = 0xffffffffu;
// Flag of a ring entry that is the first vertex of a fan (normals.cu).
constexpr unsigned RING_START = 0x80000000u;

// `TransformLink::frame` of a domain that is its own transform root.
constexpr unsigned NO_FRAME = 0xffffffffu;

// Start of the upload of a step: output addresses, and which parts to compute.
struct StepHeader {
    float* positions;
    float* normals;
    float4* tangents;
    float* displacements;
    unsigned output_step;      // number of the last step that the output buffers contain before the launch
    unsigned last_full_step;   // number of the last full step
    unsigned step;             // number of this step, counted from 1
    unsigned change_count;     // number of `Change` entries for `apply`
    unsigned dirty_tile_count; // number of entries of `tile_list`
    unsigned reserved[3];
    // Output of `bounds`, zero before the launch: `float_to_ordered` maxima of -x, -y, -z, x, y, z of all positions.
    // With ORIENTED_BOUNDS, six more maxima, with the coordinates along `BoundsArgs::bounding_axes` instead of x, y, z.
    unsigned bounds[12];
};
static_assert(sizeof(StepHeader) == 112, "StepHeader differs from src/compute/gpu/tables/layout.rs");

// Bit masks of `WarpTile::kind`. The items of a tile with TILE_VERTICES are vertices. If such a tile also has
// TILE_CORNERS, then it also computes the corners of the shape with the same indices as its vertices. The items of a
// tile with only TILE_CORNERS are corners.
constexpr unsigned LAST_QUAD_ITEMS = 7; // number of items of the last quad, 1 to 4; 0 in a mixed tile
constexpr unsigned TILE_VERTICES = 8;   // the tile computes positions
constexpr unsigned TILE_CORNERS = 16;   // the tile computes normals and tangents

// A tile. Its part of U is [chunk_count][3][quad_count] words of 16 bytes.
struct WarpTile {
    unsigned long long first_word;
    unsigned first_item;           // packed index of the first item; in a mixed tile, first entry of `mixed_quads`
    unsigned rest_quad;            // index of the first quad
    unsigned domain;
    unsigned first_q;
    unsigned first_scale;          // in a mixed tile, `mixed_quad_scales` is used instead
    unsigned short chunk_count;
    unsigned char quad_count;
    unsigned char kind;
};
static_assert(sizeof(WarpTile) == 32, "WarpTile differs from src/compute/gpu/tables/layout.rs");

// A quad of a mixed tile.
struct MixedQuad {
    unsigned first_item;    // packed index of the first item
    unsigned rest_quad;     // index of the quad in `rest_positions`, `rest_normals` and `rest_tangents`
    unsigned packed_domain; // 4 * index of the domain + number of items of the quad - 1
    unsigned first_q;
};
static_assert(sizeof(MixedQuad) == 16, "MixedQuad differs from src/compute/gpu/tables/layout.rs");

// Offsets of a domain for `normals`. Domains of one shape differ only in `first_corner` and `first_vertex`.
struct NormalSlot {
    unsigned first_corner;       // packed index
    unsigned first_normal;       // index into each of the three parts (x, y, z) of `rest_normals`
    unsigned first_tangent;      // index into `rest_tangents`, or NO_TANGENTS
    unsigned first_vertex;       // packed index
    unsigned first_corner_group; // index into `corner_groups`, or NO_GROUPS
};
static_assert(sizeof(NormalSlot) == 20, "NormalSlot differs from src/compute/gpu/tables/layout.rs");

// An entry of the list of changed domains that `apply` reads.
struct Change {
    unsigned domain;
    unsigned first_q;     // index into `q`
    unsigned q_count;     // number of coordinates
    unsigned first_new_q; // index into `new_q`
};
static_assert(sizeof(Change) == 16, "Change differs from src/compute/gpu/tables/layout.rs");

// The transform root of a domain (the domain whose transform it uses), and the frame of a follower: its constant
// transform relative to its root. Used only with FOLLOWERS.
struct TransformLink {
    unsigned root;  // index into `transforms`
    unsigned frame; // index into `follower_frames`, or NO_FRAME for a root
};
static_assert(sizeof(TransformLink) == 8, "TransformLink differs from src/compute/gpu/tables/layout.rs");

struct DeformArgs {
    const StepHeader* header;
    const WarpTile* tiles;
    const MixedQuad* mixed_quads;
    const uint4* words;
    const float4* rest_positions;
    const float4* rest_normals;
    const float4* rest_tangents;
    const unsigned* corner_offsets;
    const float* scales;
    const unsigned* mixed_quad_scales; // per mixed quad, `first_scale`
    const float4* transforms;
    const TransformLink* transform_links;
    const float4* follower_frames;
    const float* q;
    const unsigned* tile_list;
    unsigned* boxes;
    unsigned tile_count;
    unsigned reserved;
};
static_assert(sizeof(DeformArgs) == 136, "DeformArgs differs from src/compute/gpu/tables/layout.rs");

// A group of domains of one shape, for which `batch` reads U once. The domains are the members of the group.
struct BatchGroup {
    unsigned long long first_word;
    unsigned rest_quad; // index of the shape's first quad
    unsigned first_scale;
    unsigned vertex_count; // number of vertices of the shape
    unsigned first_member;
    unsigned chunk_count;
    unsigned member_count;
};
static_assert(sizeof(BatchGroup) == 32, "BatchGroup differs from src/compute/gpu/tables/layout.rs");

// A domain of a group.
struct BatchMember {
    unsigned first_vertex; // packed index
    unsigned first_q;
    unsigned domain;
    unsigned first_tile; // index of the domain's first tile among the tiles of `deform`, four boxes each in `boxes`
};
static_assert(sizeof(BatchMember) == 16, "BatchMember differs from src/compute/gpu/tables/layout.rs");

// The work of one block of `batch`.
struct BatchBlock {
    unsigned group;
    unsigned first_tile; // first tile of the block, counted from the first tile of the shape
    unsigned end_tile;   // one past the last tile
    unsigned reserved;
};
static_assert(sizeof(BatchBlock) == 16, "BatchBlock differs from src/compute/gpu/tables/layout.rs");

struct BatchArgs {
    const StepHeader* header;
    const BatchBlock* blocks;
    const BatchGroup* groups;
    const BatchMember* members;
    const uint4* words;
    const float4* rest_positions;
    const float* scales;
    const float4* transforms;
    const TransformLink* transform_links;
    const float4* follower_frames;
    const float* q;
    unsigned* boxes;
};
static_assert(sizeof(BatchArgs) == 96, "BatchArgs differs from src/compute/gpu/tables/layout.rs");

// A part of a domain that `bounds` reduces to one box.
struct BoxSegment {
    unsigned first_item; // packed index of the first vertex, or index of the first box in `boxes`
    unsigned item_count;
    unsigned domain;
    unsigned is_vertex_range; // 1: the items are vertices, 0: the items are boxes
};
static_assert(sizeof(BoxSegment) == 16, "BoxSegment differs from src/compute/gpu/tables/layout.rs");

struct BoundsArgs {
    StepHeader* header;
    const unsigned* boxes;
    const BoxSegment* segments;
    const unsigned* change_steps;
    unsigned* segment_boxes;
    unsigned box_count;
    unsigned segment_count;
    float bounding_axes[9]; // with ORIENTED_BOUNDS: three orthogonal unit vectors
    unsigned reserved;
};
static_assert(sizeof(BoundsArgs) == 88, "BoundsArgs differs from src/compute/gpu/tables/layout.rs");

struct ApplyArgs {
    const StepHeader* header;
    const Change* changes;
    const float4* new_transforms;
    const float* new_q;
    const unsigned* dirty_tiles;
    const TransformLink* transform_links;
    float4* transforms;
    float* q;
    unsigned* change_steps;
    unsigned* tile_list;
};
static_assert(sizeof(ApplyArgs) == 80, "ApplyArgs differs from src/compute/gpu/tables/layout.rs");

struct NormalsArgs {
    const StepHeader* header;
    const NormalSlot* slots;
    const unsigned* first_domains;
    const float* rest_normals;
    const float4* rest_tangents;
    const float4* transforms;
    const TransformLink* transform_links;
    const float4* follower_frames;
    const unsigned* change_steps;
    const unsigned* corner_groups;
    const unsigned* ring_offsets;
    const unsigned* rings;
    const float* group_normals;
    unsigned corner_count;      // of all domains
    unsigned rest_corner_count; // of all shapes
    unsigned group_count;       // smoothing groups of all shapes
    unsigned reserved;
};
static_assert(sizeof(NormalsArgs) == 120, "NormalsArgs differs from src/compute/gpu/tables/layout.rs");

// Whether a domain changed after the step that the output buffers contain.
__device__ inline bool is_dirty(const StepHeader* header, const unsigned* change_steps, unsigned domain) {
    return max(__ldg(&header->last_full_step), __ldg(change_steps + domain)) > __ldg(&header->output_step);
}

// Finds the domain of a packed corner in a block of `normals`: the last domain whose first corner is at or before the
// corner. `first_domains[b]` is the domain of the first corner of block b, and the last entry is the last domain. A
// block inside one domain needs no search.
__device__ inline unsigned find_domain(const NormalSlot* slots, const unsigned* first_domains, unsigned corner) {
    unsigned low = first_domains[blockIdx.x];
    unsigned high = first_domains[blockIdx.x + 1];
    while (low < high) {
        const unsigned mid = (low + high + 1) / 2;
        if (slots[mid].first_corner <= corner) {
            low = mid;
        } else {
            high = mid - 1;
        }
    }
    return low;
}

// Copies three floats per item of the block from `staged` to `packed`, as one contiguous range, so that warps write
// whole sectors of 32 bytes. `item_count` is the number of items of all blocks. The caller must synchronize the block
// between its writes to `staged` and this call.
__device__ inline void store_triples(float* packed, const float* staged, unsigned item_count) {
    const unsigned first_item = blockIdx.x * BLOCK;
    const unsigned float_count = 3 * min(BLOCK, item_count - first_item);
    for (unsigned i = threadIdx.x; i < float_count; i += BLOCK) {
        packed[3 * first_item + i] = staged[i];
    }
}
