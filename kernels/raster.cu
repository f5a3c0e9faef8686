// Compute rasterizer: one sample per pixel. For each sample it finds the least depth and the id of its triangle, by one
// atomic minimum of both. The result does not depend on the order of execution.
//   raster        a thread per triangle of a group: culls it, draws it if few samples are near, or queues it
//   raster_cut    the same for cut-out triangles
//   raster_warps  a warp per triangle of the medium queue
//   raster_tiles  a warp per tile of a triangle of the large queue, or per strip of a tile if there are few tiles; also
//                 draws clipped triangles
// Macros: DEPTH   depth alone, f32, no ids: a shadow map
//         CUT     the mesh has cut-outs: triangles from args.cut on, tested for alpha before the atomic
//         COUNT   count the triangles by path, including the reasons for culling
//         FEW     maximum number of samples near a triangle that a thread draws
//         NARROW  maximum extent, in 1/256 pixel, of a triangle that a warp draws; at most 16384, so that its edge
//                 functions fit 32 bits
// Launch: BLOCK threads per block. raster and raster_cut need a thread per triangle; the others loop over their queue,
// with any number of blocks. CPU twin: Raster::draw.
#include "cut_out.cuh"

#ifndef FEW
#define FEW 32
#endif
#ifndef NARROW
#define NARROW 16384
#endif

constexpr unsigned BLOCK = 128, WARPS = BLOCK / 32;
constexpr int TILE = 64;
constexpr unsigned HALVINGS = 3;          // maximum number of times that a tile is halved into strips
constexpr unsigned TILES_BITS = 40;

// The path of a triangle, and its setup.
struct Aim {
    Path path;
    Box box;
    bool turned;
    long long area;
    Corner a, b, c;
};

__device__ inline bool is_empty(const Box& box) {
    return box.x0 > box.x1 || box.y0 > box.y1;
}

// The path of a triangle by the sign of its area and its samples.
__device__ inline Path judge(const RasterArgs& args, long long area, const Box& box) {
    return area == 0                     ? FLAT
           : args.faces == 1 && area > 0 ? BACK
           : is_empty(box)               ? MISSED
                                         : LARGE;
}

// The path of a clipped triangle. A separate function with a struct in local memory: clipped triangles are rare, and
// the others keep their setup in registers.
struct Clipped {
    Path path;
    Box box;
};

__device__ __noinline__ void aim_clipped(const RasterArgs& args, float4 a, float4 b, float4 c, Clipped& clipped) {
    Polygon polygon;
    clip_triangle(args, a, b, c, polygon);
    if (polygon.count == 0) {
        clipped.path = OUTSIDE;
        return;
    }
    clipped.box = box_of(args, polygon);
    clipped.path = judge(args, area_of(polygon), clipped.box);
}

__device__ inline void aim_whole(const RasterArgs& args, const float4 (&corners)[3], Aim& aim) {
    const Corner a = snap(args, corners[0]), b = snap(args, corners[1]), c = snap(args, corners[2]);
    const int x0 = min(a.x, min(b.x, c.x)), x1 = max(a.x, max(b.x, c.x));
    const int y0 = min(a.y, min(b.y, c.y)), y1 = max(a.y, max(b.y, c.y));
    aim.box = box_of(args, x0, y0, x1, y1);
    aim.area = area_of(a, b, c);
    aim.path = judge(args, aim.area, aim.box);
    if (aim.path == LARGE && x1 - x0 <= NARROW && y1 - y0 <= NARROW) {
        const int samples = (aim.box.x1 - aim.box.x0 + 1) * (aim.box.y1 - aim.box.y0 + 1);
        aim.path = samples <= FEW ? SMALL : MEDIUM;
    }
    aim.turned = aim.area < 0;
    aim.area = aim.turned ? -aim.area : aim.area;
    aim.a = a;
    aim.b = b;
    aim.c = c;
}

__device__ inline void aim_at(const RasterArgs& args, unsigned triangle, Aim& aim) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    if (!is_finite(corners[0]) || !is_finite(corners[1]) || !is_finite(corners[2])) {
        aim.path = NOT_FINITE;
    } else if (is_outside(corners)) {
        aim.path = OUTSIDE;
    } else if (is_whole(args, corners[0]) && is_whole(args, corners[1]) && is_whole(args, corners[2])) {
        aim_whole(args, corners, aim);
    } else {
        Clipped clipped;
        aim_clipped(args, corners[0], corners[1], corners[2], clipped);
        aim.path = clipped.path;
        aim.box = clipped.box;
    }
}

template <typename Kind>
__device__ inline void draw_small(const RasterArgs& args, const Aim& aim, unsigned triangle) {
    const Piece<int> piece(aim.a, aim.b, aim.c, aim.turned, (int)aim.area);
    const Kind surface(args, triangle);
    for (int row = aim.box.y0; row <= aim.box.y1; ++row) {
        for (int column = aim.box.x0; column <= aim.box.x1; ++column) {
            float depth;
            if (piece.covers(column, row, depth)) {
                put(args, surface, column, row, depth, triangle);
            }
        }
    }
}

// One atomic per warp; all lanes of the warp take part.
__device__ inline void push_medium(const RasterArgs& args, bool wanted, unsigned triangle) {
    const unsigned lanes = __ballot_sync(0xffffffffu, wanted), lane = threadIdx.x % 32;
    if (lanes == 0) {
        return;
    }
    unsigned first = 0;
    if (lane == 0) {
        first = atomicAdd(&((Tally*)args.tally)->medium, __popc(lanes));
    }
    first = __shfl_sync(0xffffffffu, first, 0);
    if (wanted) {
        ((unsigned*)args.medium)[first + __popc(lanes & ((1u << lane) - 1))] = triangle;
    }
}

// One atomic returns both the queue entry and its first tile, so first tiles ascend with the entries.
__device__ inline void push_large(const RasterArgs& args, const Box& box, unsigned triangle) {
    const unsigned x = box.x0 / TILE, y = box.y0 / TILE;
    const unsigned across = box.x1 / TILE - x + 1, down = box.y1 / TILE - y + 1;
    const unsigned long long own = 1ull << TILES_BITS | (unsigned long long)across * down;
    const unsigned long long before = atomicAdd(&((Tally*)args.tally)->large, own);
    Large entry;
    entry.first = before & ((1ull << TILES_BITS) - 1);
    entry.triangle = triangle;
    entry.box = x | y << 8 | (across - 1) << 16;
    ((Large*)args.large)[before >> TILES_BITS] = entry;
}

__device__ inline void count(const RasterArgs& args, Path path) {
#ifdef COUNT
    for (unsigned own = 0; own < NOTHING; ++own) {
        const unsigned lanes = __ballot_sync(0xffffffffu, path == own);
        if (threadIdx.x % 32 == 0 && lanes != 0) {
            atomicAdd(&((Tally*)args.tally)->counts[own], __popc(lanes));
        }
    }
#endif
}

template <typename Kind>
__device__ inline void draw_group(const RasterArgs& args) {
    const unsigned at = blockIdx.x * BLOCK + threadIdx.x, triangle = args.first + at;
    Aim aim;
    aim.path = NOTHING;
    if (at < args.count) {
        aim_at(args, triangle, aim);
    }
    __syncwarp();
    push_medium(args, aim.path == MEDIUM, triangle);
    count(args, aim.path);
    if (aim.path == LARGE) {
        push_large(args, aim.box, triangle);
    }
    if (aim.path == SMALL) {
        draw_small<Kind>(args, aim, triangle);
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) raster(const __grid_constant__ RasterArgs args) {
    draw_group<Whole>(args);
}

#ifdef CUT
extern "C" __global__ void __launch_bounds__(BLOCK) raster_cut(const __grid_constant__ RasterArgs args) {
    draw_group<CutOut>(args);
}
#endif

template <typename Kind>
__device__ inline void draw_medium(const RasterArgs& args, unsigned triangle) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    Aim aim;
    aim_whole(args, corners, aim);
    const Piece<int> piece(aim.a, aim.b, aim.c, aim.turned, (int)aim.area);
    const Kind surface(args, triangle);
    const int lane = (int)threadIdx.x % 32;
    for (int row = aim.box.y0 + lane / 8; row <= aim.box.y1; row += 4) {
        for (int column = aim.box.x0 + lane % 8; column <= aim.box.x1; column += 8) {
            float depth;
            if (piece.covers(column, row, depth)) {
                put(args, surface, column, row, depth, triangle);
            }
        }
    }
}

__device__ inline bool is_cut(const RasterArgs& args, unsigned triangle) {
#ifdef CUT
    return triangle >= args.cut;
#else
    return false;
#endif
}

extern "C" __global__ void __launch_bounds__(BLOCK, 4) raster_warps(const __grid_constant__ RasterArgs args) {
    const unsigned queued = ((const Tally*)args.tally)->medium, warps = gridDim.x * WARPS;
    for (unsigned at = blockIdx.x * WARPS + threadIdx.x / 32; at < queued; at += warps) {
        const unsigned triangle = ((const unsigned*)args.medium)[at];
        if (is_cut(args, triangle)) {
            draw_medium<CutOut>(args, triangle);
        } else {
            draw_medium<Whole>(args, triangle);
        }
    }
}

// The last entry whose first tile is at or before `tile`. The warp tests 32 entries at a time.
__device__ inline Large find(const RasterArgs& args, unsigned entries, unsigned long long tile) {
    const Large* list = (const Large*)args.large;
    unsigned low = 0, high = entries;
    while (high - low > 1) {
        const unsigned step = (high - low + 31) / 32, own = low + step * (threadIdx.x % 32);
        const unsigned before = __popc(__ballot_sync(0xffffffffu, own < high && list[own].first <= tile));
        low += step * (before - 1);
        high = min(low + step, high);
    }
    return list[low];
}

__device__ inline void corners_of(const RasterArgs& args, unsigned triangle, Polygon& polygon) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    if (is_whole(args, corners[0]) && is_whole(args, corners[1]) && is_whole(args, corners[2])) {
        polygon.count = 3;
        for (unsigned i = 0; i < 3; ++i) {
            polygon.corners[i] = snap(args, corners[i]);
        }
    } else {
        clip_triangle(args, corners[0], corners[1], corners[2], polygon);
    }
}

__device__ inline Box common(const Box& one, const Box& other) {
    return {max(one.x0, other.x0), max(one.y0, other.y0), min(one.x1, other.x1), min(one.y1, other.y1)};
}

// Whether all samples of a box lie outside one edge: the edge function has its largest value at one of the four
// corners.
__device__ inline bool is_beyond(const Corner& from, const Corner& to, int least, const Box& box) {
    const int x = CELL * (to.y > from.y ? box.x0 : box.x1) + CELL / 2;
    const int y = CELL * (to.x > from.x ? box.y1 : box.y0) + CELL / 2;
    return Piece<long long>::edge(from, to, x, y) < least;
}

template <typename Kind>
__device__ inline void draw_tile(const RasterArgs& args, const Kind& surface, const Piece<long long>& piece, const Box& box,
                                 unsigned triangle) {
    if (is_beyond(piece.b, piece.c, piece.least_a, box) || is_beyond(piece.c, piece.a, piece.least_b, box) ||
        is_beyond(piece.a, piece.b, piece.least_c, box)) {
        return;
    }
    const int lane = (int)threadIdx.x % 32;
    for (int row = box.y0 + lane / 8; row <= box.y1; row += 4) {
        for (int column = box.x0 + lane % 8; column <= box.x1; column += 8) {
            float depth;
            if (piece.covers(column, row, depth)) {
                put(args, surface, column, row, depth, triangle);
            }
        }
    }
}

// The work of all warps. In shared memory, to save registers, like `Turn`.
struct Turns {
    unsigned long long count;
    unsigned entries;
    unsigned halvings;                    // of each tile into strips
};

// What a warp draws in one iteration.
struct Turn {
    Polygon polygon;
    Box box;
    unsigned triangle;
};

// A tile takes 128 iterations of a warp. If there are fewer tiles than warps, one tile would determine the run time, so
// tiles are split into strips.
__device__ inline void plan_turns(const RasterArgs& args, Turns& turns) {
    const unsigned long long large = ((const Tally*)args.tally)->large, tiles = large & ((1ull << TILES_BITS) - 1);
    turns.entries = (unsigned)(large >> TILES_BITS);
    turns.halvings = 0;
    while (turns.halvings < HALVINGS && tiles << (turns.halvings + 1) <= WARPS * gridDim.x) {
        ++turns.halvings;
    }
    turns.count = tiles << turns.halvings;
}

__device__ inline void take_turn(const RasterArgs& args, const Turns& turns, const Large& entry, unsigned long long at,
                                 Turn& turn) {
    const unsigned own = (unsigned)((at >> turns.halvings) - entry.first), across = (entry.box >> 16 & 255) + 1;
    const int tall = TILE >> turns.halvings, strip = (int)at & ((1 << turns.halvings) - 1);
    const int x = TILE * (int)((entry.box & 255) + own % across);
    const int y = TILE * (int)((entry.box >> 8 & 255) + own / across) + tall * strip;
    corners_of(args, entry.triangle, turn.polygon);
    turn.box = common(box_of(args, turn.polygon), {x, y, x + TILE - 1, y + tall - 1});
    turn.triangle = entry.triangle;
}

// All pieces of a polygon have the orientation of the whole. A piece that rounding turned around has no samples of its
// own.
template <typename Kind>
__device__ inline void draw_pieces(const RasterArgs& args, const Turn& turn) {
    const Polygon& polygon = turn.polygon;
    const bool turned = area_of(polygon) < 0;
    const Kind surface(args, turn.triangle);
    for (unsigned i = 1; i + 1 < polygon.count; ++i) {
        const Corner &a = polygon.corners[0], &b = polygon.corners[i], &c = polygon.corners[i + 1];
        const long long area = area_of(a, b, c), own = turned ? -area : area;
        if (own > 0) {
            draw_tile(args, surface, Piece<long long>(a, b, c, turned, own), turn.box, turn.triangle);
        }
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK, 5) raster_tiles(const __grid_constant__ RasterArgs args) {
    __shared__ Turns turns;
    __shared__ Turn own[WARPS];
    if (threadIdx.x == 0) {
        plan_turns(args, turns);
    }
    __syncthreads();
    Turn& turn = own[threadIdx.x / 32];
    for (unsigned long long at = blockIdx.x * WARPS + threadIdx.x / 32; at < turns.count; at += WARPS * gridDim.x) {
        const Large entry = find(args, turns.entries, at >> turns.halvings);
        if (threadIdx.x % 32 == 0) {
            take_turn(args, turns, entry, at, turn);
        }
        __syncwarp();
        if (is_cut(args, turn.triangle)) {
            draw_pieces<CutOut>(args, turn);
        } else {
            draw_pieces<Whole>(args, turn);
        }
        __syncwarp();
    }
}
