// Compute rasterizer: one sample per pixel. For each sample it finds the least depth and the id of its triangle, by one
// atomic minimum of both. The result does not depend on the order of execution.
//   raster        a thread per triangle of a group: culls it, draws it if few samples are near, or queues it
//   raster_cut_outs    the same for cut-out triangles
//   raster_warps  a warp per triangle of the medium queue
//   raster_tiles  a warp per tile of a triangle of the large queue, or per strip of a tile if there are few tiles; also
//                 draws clipped triangles
// Macros: DEPTH_ONLY   depth alone, f32, no ids: a shadow map
//         CUT_OUTS     the mesh has cut-outs: triangles from args.cut on, tested for alpha before the atomic
//         COUNT_TRIANGLES   count the triangles by path, including the reasons for culling
//         MAX_THREAD_SAMPLES     maximum number of samples near a triangle that a thread draws
//         MAX_WARP_EXTENT  maximum extent, in 1/256 pixel, of a triangle that a warp draws; at most 16384, so that its edge
//                 functions fit 32 bits
// Launch: BLOCK threads per block. raster and raster_cut_outs need a thread per triangle; the others loop over their queue,
// with any number of blocks. CPU twin: VisibilityBuffer::draw.
#include "cut_out.cuh"

#ifndef MAX_THREAD_SAMPLES
#define MAX_THREAD_SAMPLES 32
#endif
#ifndef MAX_WARP_EXTENT
#define MAX_WARP_EXTENT 16384
#endif

constexpr unsigned BLOCK = 128, WARPS = BLOCK / 32;
constexpr int TILE_SIZE = 64;
constexpr unsigned MAX_STRIP_SPLITS = 3;          // maximum number of times that a tile is halved into strips
constexpr unsigned TILE_COUNT_BITS = 40;

// The path of a triangle, and its setup.
struct BinnedTriangle {
    TriangleBin path;
    PixelRect box;
    bool is_flipped;
    long long area;
    SnappedVertex a, b, c;
};

__device__ inline bool is_empty(const PixelRect& box) {
    return box.x0 > box.x1 || box.y0 > box.y1;
}

// The path of a triangle by the sign of its area and its samples.
__device__ inline TriangleBin classify_area(const RasterArgs& args, long long area, const PixelRect& box) {
    return area == 0                     ? DEGENERATE
           : args.faces == 1 && area > 0 ? BACK_FACING
           : is_empty(box)               ? NO_SAMPLE
                                         : LARGE;
}

// The path of a clipped triangle. A separate function with a struct in local memory: clipped triangles are rare, and
// the others keep their setup in registers.
struct ClippedSetup {
    TriangleBin path;
    PixelRect box;
};

__device__ __noinline__ void setup_clipped(const RasterArgs& args, float4 a, float4 b, float4 c, ClippedSetup& clipped) {
    ClippedPolygon polygon;
    clip_triangle(args, a, b, c, polygon);
    if (polygon.count == 0) {
        clipped.path = OUTSIDE_FRUSTUM;
        return;
    }
    clipped.box = pixel_rect(args, polygon);
    clipped.path = classify_area(args, area_of(polygon), clipped.box);
}

__device__ inline void setup_unclipped(const RasterArgs& args, const float4 (&corners)[3], BinnedTriangle& triangle_setup) {
    const SnappedVertex a = snap(args, corners[0]), b = snap(args, corners[1]), c = snap(args, corners[2]);
    const int x0 = min(a.x, min(b.x, c.x)), x1 = max(a.x, max(b.x, c.x));
    const int y0 = min(a.y, min(b.y, c.y)), y1 = max(a.y, max(b.y, c.y));
    triangle_setup.box = pixel_rect(args, x0, y0, x1, y1);
    triangle_setup.area = area_of(a, b, c);
    triangle_setup.path = classify_area(args, triangle_setup.area, triangle_setup.box);
    if (triangle_setup.path == LARGE && x1 - x0 <= MAX_WARP_EXTENT && y1 - y0 <= MAX_WARP_EXTENT) {
        const int samples = (triangle_setup.box.x1 - triangle_setup.box.x0 + 1) * (triangle_setup.box.y1 - triangle_setup.box.y0 + 1);
        triangle_setup.path = samples <= MAX_THREAD_SAMPLES ? SMALL : MEDIUM;
    }
    triangle_setup.is_flipped = triangle_setup.area < 0;
    triangle_setup.area = triangle_setup.is_flipped ? -triangle_setup.area : triangle_setup.area;
    triangle_setup.a = a;
    triangle_setup.b = b;
    triangle_setup.c = c;
}

__device__ inline void classify_triangle(const RasterArgs& args, unsigned triangle, BinnedTriangle& triangle_setup) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    if (!is_finite(corners[0]) || !is_finite(corners[1]) || !is_finite(corners[2])) {
        triangle_setup.path = NOT_FINITE;
    } else if (is_outside(corners)) {
        triangle_setup.path = OUTSIDE_FRUSTUM;
    } else if (is_inside_guard_band(args, corners[0]) && is_inside_guard_band(args, corners[1]) && is_inside_guard_band(args, corners[2])) {
        setup_unclipped(args, corners, triangle_setup);
    } else {
        ClippedSetup clipped;
        setup_clipped(args, corners[0], corners[1], corners[2], clipped);
        triangle_setup.path = clipped.path;
        triangle_setup.box = clipped.box;
    }
}

template <typename Kind>
__device__ inline void draw_small(const RasterArgs& args, const BinnedTriangle& triangle_setup, unsigned triangle) {
    const TriangleSetup<int> piece(triangle_setup.a, triangle_setup.b, triangle_setup.c, triangle_setup.is_flipped, (int)triangle_setup.area);
    const Kind surface(args, triangle);
    for (int row = triangle_setup.box.y0; row <= triangle_setup.box.y1; ++row) {
        for (int column = triangle_setup.box.x0; column <= triangle_setup.box.x1; ++column) {
            float depth;
            if (piece.covers(column, row, depth)) {
                write_sample(args, surface, column, row, depth, triangle);
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
        first = atomicAdd(&((RasterCounters*)args.counters)->medium, __popc(lanes));
    }
    first = __shfl_sync(0xffffffffu, first, 0);
    if (wanted) {
        ((unsigned*)args.medium)[first + __popc(lanes & ((1u << lane) - 1))] = triangle;
    }
}

// One atomic returns both the queue entry and its first tile, so first tiles ascend with the entries.
__device__ inline void push_large(const RasterArgs& args, const PixelRect& box, unsigned triangle) {
    const unsigned x = box.x0 / TILE_SIZE, y = box.y0 / TILE_SIZE;
    const unsigned across = box.x1 / TILE_SIZE - x + 1, down = box.y1 / TILE_SIZE - y + 1;
    const unsigned long long own = 1ull << TILE_COUNT_BITS | (unsigned long long)across * down;
    const unsigned long long before = atomicAdd(&((RasterCounters*)args.counters)->large, own);
    LargeTriangle entry;
    entry.first = before & ((1ull << TILE_COUNT_BITS) - 1);
    entry.triangle = triangle;
    entry.box = x | y << 8 | (across - 1) << 16;
    ((LargeTriangle*)args.large)[before >> TILE_COUNT_BITS] = entry;
}

__device__ inline void count(const RasterArgs& args, TriangleBin path) {
#ifdef COUNT_TRIANGLES
    for (unsigned own = 0; own < NO_BIN; ++own) {
        const unsigned lanes = __ballot_sync(0xffffffffu, path == own);
        if (threadIdx.x % 32 == 0 && lanes != 0) {
            atomicAdd(&((RasterCounters*)args.counters)->counts[own], __popc(lanes));
        }
    }
#endif
}

template <typename Kind>
__device__ inline void draw_group(const RasterArgs& args) {
    const unsigned at = blockIdx.x * BLOCK + threadIdx.x, triangle = args.first + at;
    BinnedTriangle triangle_setup;
    triangle_setup.path = NO_BIN;
    if (at < args.count) {
        classify_triangle(args, triangle, triangle_setup);
    }
    __syncwarp();
    push_medium(args, triangle_setup.path == MEDIUM, triangle);
    count(args, triangle_setup.path);
    if (triangle_setup.path == LARGE) {
        push_large(args, triangle_setup.box, triangle);
    }
    if (triangle_setup.path == SMALL) {
        draw_small<Kind>(args, triangle_setup, triangle);
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) raster(const __grid_constant__ RasterArgs args) {
    draw_group<OpaqueTest>(args);
}

#ifdef CUT_OUTS
extern "C" __global__ void __launch_bounds__(BLOCK) raster_cut_outs(const __grid_constant__ RasterArgs args) {
    draw_group<AlphaTest>(args);
}
#endif

template <typename Kind>
__device__ inline void draw_medium(const RasterArgs& args, unsigned triangle) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    BinnedTriangle triangle_setup;
    setup_unclipped(args, corners, triangle_setup);
    const TriangleSetup<int> piece(triangle_setup.a, triangle_setup.b, triangle_setup.c, triangle_setup.is_flipped, (int)triangle_setup.area);
    const Kind surface(args, triangle);
    const int lane = (int)threadIdx.x % 32;
    for (int row = triangle_setup.box.y0 + lane / 8; row <= triangle_setup.box.y1; row += 4) {
        for (int column = triangle_setup.box.x0 + lane % 8; column <= triangle_setup.box.x1; column += 8) {
            float depth;
            if (piece.covers(column, row, depth)) {
                write_sample(args, surface, column, row, depth, triangle);
            }
        }
    }
}

__device__ inline bool is_cut_out(const RasterArgs& args, unsigned triangle) {
#ifdef CUT_OUTS
    return triangle >= args.first_cut_out;
#else
    return false;
#endif
}

extern "C" __global__ void __launch_bounds__(BLOCK, 4) raster_warps(const __grid_constant__ RasterArgs args) {
    const unsigned queued = ((const RasterCounters*)args.counters)->medium, warps = gridDim.x * WARPS;
    for (unsigned at = blockIdx.x * WARPS + threadIdx.x / 32; at < queued; at += warps) {
        const unsigned triangle = ((const unsigned*)args.medium)[at];
        if (is_cut_out(args, triangle)) {
            draw_medium<AlphaTest>(args, triangle);
        } else {
            draw_medium<OpaqueTest>(args, triangle);
        }
    }
}

// The last entry whose first tile is at or before `tile`. The warp tests 32 entries at a time.
__device__ inline LargeTriangle find_large_triangle(const RasterArgs& args, unsigned entries, unsigned long long tile) {
    const LargeTriangle* list = (const LargeTriangle*)args.large;
    unsigned low = 0, high = entries;
    while (high - low > 1) {
        const unsigned step = (high - low + 31) / 32, own = low + step * (threadIdx.x % 32);
        const unsigned before = __popc(__ballot_sync(0xffffffffu, own < high && list[own].first <= tile));
        low += step * (before - 1);
        high = min(low + step, high);
    }
    return list[low];
}

__device__ inline void clipped_corners(const RasterArgs& args, unsigned triangle, ClippedPolygon& polygon) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    if (is_inside_guard_band(args, corners[0]) && is_inside_guard_band(args, corners[1]) && is_inside_guard_band(args, corners[2])) {
        polygon.count = 3;
        for (unsigned i = 0; i < 3; ++i) {
            polygon.corners[i] = snap(args, corners[i]);
        }
    } else {
        clip_triangle(args, corners[0], corners[1], corners[2], polygon);
    }
}

__device__ inline PixelRect intersect(const PixelRect& one, const PixelRect& other) {
    return {max(one.x0, other.x0), max(one.y0, other.y0), min(one.x1, other.x1), min(one.y1, other.y1)};
}

// Whether all samples of a box lie outside one edge: the edge function has its largest value at one of the four
// corners.
__device__ inline bool is_outside_edge(const SnappedVertex& from, const SnappedVertex& to, int top_left_bias, const PixelRect& box) {
    const int x = SUBPIXEL_STEPS * (to.y > from.y ? box.x0 : box.x1) + SUBPIXEL_STEPS / 2;
    const int y = SUBPIXEL_STEPS * (to.x > from.x ? box.y1 : box.y0) + SUBPIXEL_STEPS / 2;
    return TriangleSetup<long long>::edge(from, to, x, y) < top_left_bias;
}

template <typename Kind>
__device__ inline void draw_tile(const RasterArgs& args, const Kind& surface, const TriangleSetup<long long>& piece, const PixelRect& box,
                                 unsigned triangle) {
    if (is_outside_edge(piece.b, piece.c, piece.least_a, box) || is_outside_edge(piece.c, piece.a, piece.least_b, box) ||
        is_outside_edge(piece.a, piece.b, piece.least_c, box)) {
        return;
    }
    const int lane = (int)threadIdx.x % 32;
    for (int row = box.y0 + lane / 8; row <= box.y1; row += 4) {
        for (int column = box.x0 + lane % 8; column <= box.x1; column += 8) {
            float depth;
            if (piece.covers(column, row, depth)) {
                write_sample(args, surface, column, row, depth, triangle);
            }
        }
    }
}

// The work of all warps. In shared memory, to save registers, like `TileJob`.
struct TileSchedule {
    unsigned long long count;
    unsigned entries;
    unsigned strip_splits;                    // of each tile into strips
};

// What a warp draws in one iteration.
struct TileJob {
    ClippedPolygon polygon;
    PixelRect box;
    unsigned triangle;
};

// A tile takes 128 iterations of a warp. If there are fewer tiles than warps, one tile would determine the run time, so
// tiles are split into strips.
__device__ inline void schedule_tiles(const RasterArgs& args, TileSchedule& turns) {
    const unsigned long long large = ((const RasterCounters*)args.counters)->large, tiles = large & ((1ull << TILE_COUNT_BITS) - 1);
    turns.entries = (unsigned)(large >> TILE_COUNT_BITS);
    turns.strip_splits = 0;
    while (turns.strip_splits < MAX_STRIP_SPLITS && tiles << (turns.strip_splits + 1) <= WARPS * gridDim.x) {
        ++turns.strip_splits;
    }
    turns.count = tiles << turns.strip_splits;
}

__device__ inline void load_tile_job(const RasterArgs& args, const TileSchedule& turns, const LargeTriangle& entry, unsigned long long at,
                                 TileJob& turn) {
    const unsigned own = (unsigned)((at >> turns.strip_splits) - entry.first), across = (entry.box >> 16 & 255) + 1;
    const int tall = TILE_SIZE >> turns.strip_splits, strip = (int)at & ((1 << turns.strip_splits) - 1);
    const int x = TILE_SIZE * (int)((entry.box & 255) + own % across);
    const int y = TILE_SIZE * (int)((entry.box >> 8 & 255) + own / across) + tall * strip;
    clipped_corners(args, entry.triangle, turn.polygon);
    turn.box = intersect(pixel_rect(args, turn.polygon), {x, y, x + TILE_SIZE - 1, y + tall - 1});
    turn.triangle = entry.triangle;
}

// All pieces of a polygon have the orientation of the whole. A piece that rounding turned around has no samples of its
// own.
template <typename Kind>
__device__ inline void draw_fan(const RasterArgs& args, const TileJob& turn) {
    const ClippedPolygon& polygon = turn.polygon;
    const bool is_flipped = area_of(polygon) < 0;
    const Kind surface(args, turn.triangle);
    for (unsigned i = 1; i + 1 < polygon.count; ++i) {
        const SnappedVertex &a = polygon.corners[0], &b = polygon.corners[i], &c = polygon.corners[i + 1];
        const long long area = area_of(a, b, c), own = is_flipped ? -area : area;
        if (own > 0) {
            draw_tile(args, surface, TriangleSetup<long long>(a, b, c, is_flipped, own), turn.box, turn.triangle);
        }
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK, 5) raster_tiles(const __grid_constant__ RasterArgs args) {
    __shared__ TileSchedule turns;
    __shared__ TileJob own[WARPS];
    if (threadIdx.x == 0) {
        schedule_tiles(args, turns);
    }
    __syncthreads();
    TileJob& turn = own[threadIdx.x / 32];
    for (unsigned long long at = blockIdx.x * WARPS + threadIdx.x / 32; at < turns.count; at += WARPS * gridDim.x) {
        const LargeTriangle entry = find_large_triangle(args, turns.entries, at >> turns.strip_splits);
        if (threadIdx.x % 32 == 0) {
            load_tile_job(args, turns, entry, at, turn);
        }
        __syncwarp();
        if (is_cut_out(args, turn.triangle)) {
            draw_fan<AlphaTest>(args, turn);
        } else {
            draw_fan<OpaqueTest>(args, turn);
        }
        __syncwarp();
    }
}
