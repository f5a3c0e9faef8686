// Compute rasterizer: one sample per pixel. For each sample it finds the nearest depth and the index of its triangle,
// by an atomic minimum of `~depth << 32 | triangle`. Depth is 1 at the near plane and 0 at the far plane. The result
// does not depend on the order of execution. A tile is 64 x 64 samples of the window.
//   raster           a thread per triangle of a range: culls the triangle, draws it if its rectangle has few samples,
//                    or appends it to the medium or the large queue
//   raster_cut_outs  the same for cut-out triangles
//   raster_warps     draws the triangles of the medium queue, with a warp per triangle
//   raster_tiles     draws the triangles of the large queue, which contains all clipped triangles, with a warp per tile
//                    of a triangle, or per strip of a tile if there are few tiles
// Macros:
//   DEPTH_ONLY          the target is f32 depth without triangle indices: a shadow map
//   CUT_OUTS            triangles from `first_cut_out` on are cut-outs, which pass an alpha test before the atomic
//   COUNT_TRIANGLES     count the triangles per `TriangleBin`
//   MAX_THREAD_SAMPLES  maximum number of samples in the rectangle of a triangle that a thread draws
//   MAX_WARP_EXTENT     maximum width and height, in 1/256 pixel, of a triangle that a warp draws; at most 16384 (64
//                       pixels), so that 32 bits hold its edge functions, at most 2 * 16384^2 = 2^29
// Launch: BLOCK threads per block. raster and raster_cut_outs need a thread per triangle. raster_warps and raster_tiles
// loop over their queues, with any number of blocks. CPU twin: VisibilityBuffer::draw.
// VisibilityBuffer is in src/compute/reference/raster.rs.
#include "cut_out.cuh"
#include "raster_setup.cuh"

constexpr unsigned BLOCK = 128, WARPS = BLOCK / 32;
constexpr int TILE_SIZE = 64;
constexpr unsigned MAX_STRIP_SPLITS = 3;  // a tile is halved at most three times, into strips of 8 rows
constexpr unsigned TILE_COUNT_BITS = 40;  // low bits of `RasterCounters::large_count`, with the number of tiles

// Draws a triangle with one thread. AlphaTestPolicy is `OpaqueTest` or `AlphaTest`.
template <typename AlphaTestPolicy>
__device__ inline void draw_small(const RasterArgs& args, const BinnedTriangle& binned, unsigned triangle) {
    const TriangleSetup<int> setup(binned.a, binned.b, binned.c, binned.is_flipped, (int)binned.doubled_area);
    const AlphaTestPolicy alpha_test(args, triangle);
    for (int row = binned.rect.y0; row <= binned.rect.y1; ++row) {
        for (int column = binned.rect.x0; column <= binned.rect.x1; ++column) {
            float depth;
            if (setup.covers(column, row, depth)) {
                write_sample(args, alpha_test, column, row, depth, triangle);
            }
        }
    }
}

// Appends the medium triangles of a warp to the medium queue with one atomic. All lanes must call this.
__device__ inline void push_medium(const RasterArgs& args, bool is_medium, unsigned triangle) {
    const unsigned medium_lanes = __ballot_sync(0xffffffffu, is_medium), lane = threadIdx.x % 32;
    if (medium_lanes == 0) {
        return;
    }
    unsigned first_entry = 0;
    if (lane == 0) {
        first_entry = atomicAdd(&((RasterCounters*)args.counters)->medium_count, __popc(medium_lanes));
    }
    first_entry = __shfl_sync(0xffffffffu, first_entry, 0);
    if (is_medium) {
        ((unsigned*)args.medium_queue)[first_entry + __popc(medium_lanes & ((1u << lane) - 1))] = triangle;
    }
}

// Appends a triangle to the large queue. One atomic counts the entry and its tiles, and returns the previous counts:
// the index of the entry and its first tile. The first tiles therefore ascend with the entries.
__device__ inline void push_large(const RasterArgs& args, const PixelRect& rect, unsigned triangle) {
    const unsigned x = rect.x0 / TILE_SIZE, y = rect.y0 / TILE_SIZE;
    const unsigned column_count = rect.x1 / TILE_SIZE - x + 1, row_count = rect.y1 / TILE_SIZE - y + 1;
    const unsigned long long increment = 1ull << TILE_COUNT_BITS | (unsigned long long)column_count * row_count;
    const unsigned long long previous = atomicAdd(&((RasterCounters*)args.counters)->large_count, increment);
    LargeTriangle entry;
    entry.first_tile = previous & ((1ull << TILE_COUNT_BITS) - 1);
    entry.triangle = triangle;
    entry.tile_rect = x | y << 8 | (column_count - 1) << 16;
    ((LargeTriangle*)args.large_queue)[previous >> TILE_COUNT_BITS] = entry;
}

// Counts the triangles of a warp per bin. All lanes must call this. Does nothing without COUNT_TRIANGLES.
__device__ inline void count_bins(const RasterArgs& args, TriangleBin bin) {
#ifdef COUNT_TRIANGLES
    for (unsigned bin_index = 0; bin_index < NO_BIN; ++bin_index) {
        const unsigned bin_lanes = __ballot_sync(0xffffffffu, bin == bin_index);
        if (threadIdx.x % 32 == 0 && bin_lanes != 0) {
            atomicAdd(&((RasterCounters*)args.counters)->bin_counts[bin_index], __popc(bin_lanes));
        }
    }
#endif
}

// Culls, draws or queues this thread's triangle of the range.
template <typename AlphaTestPolicy>
__device__ inline void draw_range(const RasterArgs& args) {
    const unsigned index = blockIdx.x * BLOCK + threadIdx.x, triangle = args.first_triangle + index;
    BinnedTriangle binned;
    binned.bin = NO_BIN;
    if (index < args.triangle_count) {
        classify_triangle(args, triangle, args.culls_back_faces == 1, binned);
    }
    __syncwarp();
    push_medium(args, binned.bin == MEDIUM, triangle);
    count_bins(args, binned.bin);
    if (binned.bin == LARGE) {
        push_large(args, binned.rect, triangle);
    }
    if (binned.bin == SMALL) {
        draw_small<AlphaTestPolicy>(args, binned, triangle);
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) raster(const __grid_constant__ RasterArgs args) {
    draw_range<OpaqueTest>(args);
}

#ifdef CUT_OUTS
extern "C" __global__ void __launch_bounds__(BLOCK) raster_cut_outs(const __grid_constant__ RasterArgs args) {
    draw_range<AlphaTest>(args);
}
#endif

// Draws an unclipped triangle with a warp, which tests 8 x 4 samples at a time.
template <typename AlphaTestPolicy>
__device__ inline void draw_medium(const RasterArgs& args, unsigned triangle) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    BinnedTriangle binned;
    setup_unclipped(args, false, corners, binned);
    const TriangleSetup<int> setup(binned.a, binned.b, binned.c, binned.is_flipped, (int)binned.doubled_area);
    const AlphaTestPolicy alpha_test(args, triangle);
    const int lane = (int)threadIdx.x % 32;
    for (int row = binned.rect.y0 + lane / 8; row <= binned.rect.y1; row += 4) {
        for (int column = binned.rect.x0 + lane % 8; column <= binned.rect.x1; column += 8) {
            float depth;
            if (setup.covers(column, row, depth)) {
                write_sample(args, alpha_test, column, row, depth, triangle);
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

// The compiler limits the registers so that at least four blocks are resident per multiprocessor.
extern "C" __global__ void __launch_bounds__(BLOCK, 4) raster_warps(const __grid_constant__ RasterArgs args) {
    const unsigned queue_length = ((const RasterCounters*)args.counters)->medium_count, warp_count = gridDim.x * WARPS;
    for (unsigned index = blockIdx.x * WARPS + threadIdx.x / 32; index < queue_length; index += warp_count) {
        const unsigned triangle = ((const unsigned*)args.medium_queue)[index];
        if (is_cut_out(args, triangle)) {
            draw_medium<AlphaTest>(args, triangle);
        } else {
            draw_medium<OpaqueTest>(args, triangle);
        }
    }
}

// Finds the entry of the large queue that contains `tile`, the index of a tile among the tiles of all entries: the last
// entry whose first tile is at most `tile`. The warp tests 32 entries at a time.
__device__ inline LargeTriangle find_large_triangle(const RasterArgs& args, unsigned entry_count, unsigned long long tile) {
    const LargeTriangle* queue = (const LargeTriangle*)args.large_queue;
    unsigned low = 0, high = entry_count;
    while (high - low > 1) {
        const unsigned step = (high - low + 31) / 32, probe = low + step * (threadIdx.x % 32);
        const unsigned preceding_count = __popc(__ballot_sync(0xffffffffu, probe < high && queue[probe].first_tile <= tile));
        low += step * (preceding_count - 1);
        high = min(low + step, high);
    }
    return queue[low];
}

// Draws the part of a triangle inside `rect` with a warp, which tests 8 x 4 samples at a time.
template <typename AlphaTestPolicy>
__device__ inline void draw_tile(const RasterArgs& args, const AlphaTestPolicy& alpha_test,
                                 const TriangleSetup<long long>& setup, const PixelRect& rect, unsigned triangle) {
    if (is_outside_edge(setup.b, setup.c, setup.min_edge_a, rect) ||
        is_outside_edge(setup.c, setup.a, setup.min_edge_b, rect) ||
        is_outside_edge(setup.a, setup.b, setup.min_edge_c, rect)) {
        return;
    }
    const int lane = (int)threadIdx.x % 32;
    for (int row = rect.y0 + lane / 8; row <= rect.y1; row += 4) {
        for (int column = rect.x0 + lane % 8; column <= rect.x1; column += 8) {
            float depth;
            if (setup.covers(column, row, depth)) {
                write_sample(args, alpha_test, column, row, depth, triangle);
            }
        }
    }
}

// The work of all warps: jobs, each of which is one tile or strip of one triangle. This struct and `TileJob` are in
// shared memory to save registers.
struct TileSchedule {
    unsigned long long job_count;
    unsigned entry_count;
    unsigned strip_splits; // number of times that each tile is halved
};

// The work of a warp in one iteration: the part of a clipped triangle inside a tile or strip.
struct TileJob {
    ClippedPolygon polygon;
    PixelRect rect; // intersection of the tile or strip with the rectangle of the polygon
    unsigned triangle;
};

// A warp needs 64 x 64 / 32 = 128 iterations for a whole tile. If there are fewer tiles than warps, the time for one
// tile would be the run time of the kernel. Tiles are then halved into strips, as long as there is a warp for every
// strip.
__device__ inline void schedule_tiles(const RasterArgs& args, TileSchedule& schedule) {
    const unsigned long long large_count = ((const RasterCounters*)args.counters)->large_count;
    const unsigned long long tile_count = large_count & ((1ull << TILE_COUNT_BITS) - 1);
    schedule.entry_count = (unsigned)(large_count >> TILE_COUNT_BITS);
    schedule.strip_splits = 0;
    while (schedule.strip_splits < MAX_STRIP_SPLITS && tile_count << (schedule.strip_splits + 1) <= WARPS * gridDim.x) {
        ++schedule.strip_splits;
    }
    schedule.job_count = tile_count << schedule.strip_splits;
}

__device__ inline void load_tile_job(const RasterArgs& args, const TileSchedule& schedule, const LargeTriangle& entry,
                                     unsigned long long job_index, TileJob& job) {
    const unsigned tile_in_entry = (unsigned)((job_index >> schedule.strip_splits) - entry.first_tile);
    const unsigned column_count = (entry.tile_rect >> 16 & 255) + 1;
    const int strip_height = TILE_SIZE >> schedule.strip_splits, strip = (int)job_index & ((1 << schedule.strip_splits) - 1);
    const int x = TILE_SIZE * (int)((entry.tile_rect & 255) + tile_in_entry % column_count);
    const int y = TILE_SIZE * (int)((entry.tile_rect >> 8 & 255) + tile_in_entry / column_count) + strip_height * strip;
    load_clipped_polygon(args, entry.triangle, job.polygon);
    job.rect = intersect_rects(pixel_rect(args, job.polygon), {x, y, x + TILE_SIZE - 1, y + strip_height - 1});
    job.triangle = entry.triangle;
}

// Draws a polygon as a fan of triangles, which have the orientation of the polygon. A triangle that rounding has
// inverted is skipped, because the other triangles of the fan cover all of its samples.
template <typename AlphaTestPolicy>
__device__ inline void draw_fan(const RasterArgs& args, const TileJob& job) {
    const ClippedPolygon& polygon = job.polygon;
    const bool is_flipped = doubled_area(polygon) < 0;
    const AlphaTestPolicy alpha_test(args, job.triangle);
    for (unsigned i = 1; i + 1 < polygon.count; ++i) {
        const SnappedVertex &a = polygon.corners[0], &b = polygon.corners[i], &c = polygon.corners[i + 1];
        const long long signed_area = doubled_area(a, b, c), triangle_area = is_flipped ? -signed_area : signed_area;
        if (triangle_area > 0) {
            draw_tile(args, alpha_test, TriangleSetup<long long>(a, b, c, is_flipped, triangle_area), job.rect, job.triangle);
        }
    }
}

// The compiler limits the registers so that at least five blocks are resident per multiprocessor.
extern "C" __global__ void __launch_bounds__(BLOCK, 5) raster_tiles(const __grid_constant__ RasterArgs args) {
    __shared__ TileSchedule schedule;
    __shared__ TileJob jobs[WARPS];
    if (threadIdx.x == 0) {
        schedule_tiles(args, schedule);
    }
    __syncthreads();
    TileJob& job = jobs[threadIdx.x / 32];
    for (unsigned long long job_index = blockIdx.x * WARPS + threadIdx.x / 32; job_index < schedule.job_count;
         job_index += WARPS * gridDim.x) {
        const LargeTriangle entry = find_large_triangle(args, schedule.entry_count, job_index >> schedule.strip_splits);
        if (threadIdx.x % 32 == 0) {
            load_tile_job(args, schedule, entry, job_index, job);
        }
        __syncwarp();
        if (is_cut_out(args, job.triangle)) {
            draw_fan<AlphaTest>(args, job);
        } else {
            draw_fan<OpaqueTest>(args, job);
        }
        __syncwarp();
    }
}
