// Classification of a triangle by the number of samples that it may cover, and its clipped polygon. Shared by the
// rasterizers: raster.cu, which draws a window, and views.cu, which draws tiles of many small views. Twin:
// src/compute/reference/raster.rs.
//   MAX_THREAD_SAMPLES, MAX_WARP_EXTENT  macros, as raster.cu describes them
#pragma once

#include "raster.cuh"

#ifndef MAX_THREAD_SAMPLES
#define MAX_THREAD_SAMPLES 32
#endif
#ifndef MAX_WARP_EXTENT
#define MAX_WARP_EXTENT 16384
#endif

// The bin of a triangle and its setup. The fields from `is_flipped` on are valid only for unclipped triangles.
struct BinnedTriangle {
    TriangleBin bin;
    PixelRect rect;
    bool is_flipped;        // whether a, b, c are counterclockwise on the screen
    long long doubled_area; // not negative
    SnappedVertex a, b, c;
};

__device__ inline bool is_empty(const PixelRect& rect) {
    return rect.x0 > rect.x1 || rect.y0 > rect.y1;
}

// Culls a triangle by its signed area (positive if clockwise on the screen) and its samples. Returns LARGE if the
// triangle is not culled; `setup_unclipped` may replace LARGE by a smaller bin.
__device__ inline TriangleBin classify_by_area(bool culls_back_faces, long long doubled_area, const PixelRect& rect) {
    return doubled_area == 0                    ? DEGENERATE
           : culls_back_faces && doubled_area > 0 ? BACK_FACING
           : is_empty(rect)                     ? NO_SAMPLE
                                                : LARGE;
}

// Setup of a clipped triangle. This struct is in local memory, because its address is passed to a function that is not
// inlined. The setup of the many unclipped triangles is a separate struct, so that it stays in registers.
struct ClippedSetup {
    TriangleBin bin;
    PixelRect rect;
};

__device__ __noinline__ void setup_clipped(const RasterArgs& args, bool culls_back_faces, float4 a, float4 b, float4 c,
                                           ClippedSetup& clipped) {
    ClippedPolygon polygon;
    clip_triangle(args, a, b, c, polygon);
    if (polygon.count == 0) {
        clipped.bin = OUTSIDE_FRUSTUM;
        return;
    }
    clipped.rect = pixel_rect(args, polygon);
    clipped.bin = classify_by_area(culls_back_faces, doubled_area(polygon), clipped.rect);
}

__device__ inline void setup_unclipped(const RasterArgs& args, bool culls_back_faces, const float4 (&corners)[3],
                                       BinnedTriangle& binned) {
    const SnappedVertex a = snap(args, corners[0]), b = snap(args, corners[1]), c = snap(args, corners[2]);
    const int x0 = min(a.x, min(b.x, c.x)), x1 = max(a.x, max(b.x, c.x));
    const int y0 = min(a.y, min(b.y, c.y)), y1 = max(a.y, max(b.y, c.y));
    binned.rect = pixel_rect(args, x0, y0, x1, y1);
    binned.doubled_area = doubled_area(a, b, c);
    binned.bin = classify_by_area(culls_back_faces, binned.doubled_area, binned.rect);
    if (binned.bin == LARGE && x1 - x0 <= MAX_WARP_EXTENT && y1 - y0 <= MAX_WARP_EXTENT) {
        const int sample_count = (binned.rect.x1 - binned.rect.x0 + 1) * (binned.rect.y1 - binned.rect.y0 + 1);
        binned.bin = sample_count <= MAX_THREAD_SAMPLES ? SMALL : MEDIUM;
    }
    binned.is_flipped = binned.doubled_area < 0;
    binned.doubled_area = binned.is_flipped ? -binned.doubled_area : binned.doubled_area;
    binned.a = a;
    binned.b = b;
    binned.c = c;
}

__device__ inline void classify_triangle(const RasterArgs& args, unsigned triangle, bool culls_back_faces,
                                         BinnedTriangle& binned) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    if (!is_finite(corners[0]) || !is_finite(corners[1]) || !is_finite(corners[2])) {
        binned.bin = NOT_FINITE;
    } else if (is_outside(corners)) {
        binned.bin = OUTSIDE_FRUSTUM;
    } else if (is_inside_guard_band(args, corners[0]) && is_inside_guard_band(args, corners[1]) &&
               is_inside_guard_band(args, corners[2])) {
        setup_unclipped(args, culls_back_faces, corners, binned);
    } else {
        ClippedSetup clipped;
        setup_clipped(args, culls_back_faces, corners[0], corners[1], corners[2], clipped);
        binned.bin = clipped.bin;
        binned.rect = clipped.rect;
    }
}

// Loads a triangle, and clips it unless all corners are inside the guard band.
__device__ inline void load_clipped_polygon(const RasterArgs& args, unsigned triangle, ClippedPolygon& polygon) {
    float4 corners[3];
    load_triangle(args, triangle, corners);
    if (is_inside_guard_band(args, corners[0]) && is_inside_guard_band(args, corners[1]) &&
        is_inside_guard_band(args, corners[2])) {
        polygon.count = 3;
        for (unsigned i = 0; i < 3; ++i) {
            polygon.corners[i] = snap(args, corners[i]);
        }
    } else {
        clip_triangle(args, corners[0], corners[1], corners[2], polygon);
    }
}

__device__ inline PixelRect intersect_rects(const PixelRect& a, const PixelRect& b) {
    return {max(a.x0, b.x0), max(a.y0, b.y0), min(a.x1, b.x1), min(a.y1, b.y1)};
}

// Whether all samples of a rectangle lie outside an edge. The edge function has its maximum at one of the four corners.
__device__ inline bool is_outside_edge(const SnappedVertex& edge_start, const SnappedVertex& edge_end,
                                       int min_covered_edge, const PixelRect& rect) {
    const int x = SUBPIXEL_STEPS * (edge_end.y > edge_start.y ? rect.x0 : rect.x1) + SUBPIXEL_STEPS / 2;
    const int y = SUBPIXEL_STEPS * (edge_end.x > edge_start.x ? rect.y1 : rect.y0) + SUBPIXEL_STEPS / 2;
    return TriangleSetup<long long>::edge_function(edge_start, edge_end, x, y) < min_covered_edge;
}

