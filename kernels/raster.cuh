// Triangle setup of the compute rasterizer: corners in clip space, clipping, snapping to 1/256 pixel, edge functions
// and depth. Every float sum and product is rounded separately (no fused multiply-add), so that host and device give
// the same bits. In window coordinates (pixels) y points down. Each pixel has one sample, at its center: the sample of
// the first pixel is at (1/2, 1/2). Depth is reversed: 1 at the near plane, 0 at the far plane. raster.cu describes the
// macros DEPTH_ONLY and CUT_OUTS. Twin: src/compute/reference/raster.rs.
#pragma once

constexpr int SUBPIXEL_STEPS = 256;  // per pixel
constexpr unsigned MAX_CORNERS = 8;  // of a clipped triangle: three, and at most one more for each of five clip planes
constexpr float MIN_W = 0x1p-100f;   // smallest accepted w; 1 / w overflows below about 2^-128, so 2^-100 has a margin

// Device addresses and parameters of a launch. Twin: src/compute/gpu/executor/raster.rs.
struct RasterArgs {
    unsigned long long positions;        // [vertices][3] f32
    unsigned long long triangles;        // [triangles][3] u32: indices of vertices
    unsigned long long target;           // (in, out) [height][width] u64: ~depth << 32 | triangle, or f32 depth
    unsigned long long medium_queue;     // [triangles] u32: triangles that `raster` leaves to `raster_warps`
    unsigned long long large_queue;      // [triangles] LargeTriangle: triangles that `raster` leaves to `raster_tiles`
    unsigned long long counters;         // RasterCounters: lengths of the queues
    unsigned long long uvs;              // with CUT_OUTS: [triangles - first_cut_out][3][2] f32
    unsigned long long material_indices; // with CUT_OUTS: [triangles - first_cut_out] u32: indices into `materials`
    unsigned long long materials;        // with CUT_OUTS: [materials] AlphaMaterial
    float clip_from_position[16];        // row-major
    float half_width, half_height;       // half the size of the window, in pixels
    float guard_x, guard_y;              // half the size of the guard band in x / w and y / w
    unsigned width, height;              // pixels
    unsigned first_triangle, triangle_count; // range that this launch draws
    unsigned culls_back_faces;           // 1: only front faces (counterclockwise with y up) are drawn
    unsigned first_cut_out;              // with CUT_OUTS: the first cut-out triangle; all later ones are cut-outs too
};

// An entry of the large queue. A tile is 64 x 64 pixels of the window.
struct LargeTriangle {
    unsigned long long first_tile; // number of tiles of all preceding entries
    unsigned triangle;
    unsigned tile_rect;            // from bit 0, 8 bits each: column and row of the first tile, tile columns - 1
};

struct RasterCounters {
    unsigned medium_count, pad;
    unsigned long long large_count; // number of entries << TILE_COUNT_BITS (raster.cu) | number of tiles of all entries
    unsigned bin_counts[8];         // number of triangles per TriangleBin, only with COUNT_TRIANGLES
};

// How a triangle is drawn (SMALL by a thread, MEDIUM by a warp, LARGE by a warp per tile), or why it is not drawn.
// NO_BIN: the thread has no triangle.
enum TriangleBin { SMALL, MEDIUM, LARGE, NOT_FINITE, OUTSIDE_FRUSTUM, DEGENERATE, BACK_FACING, NO_SAMPLE, NO_BIN };

struct SnappedVertex {
    int x, y; // in 1/256 pixel
    float z;  // window depth, 1 (near) to 0 (far)
};

struct ClippedPolygon {
    unsigned count; // number of corners; 0 if nothing remains
    SnappedVertex corners[MAX_CORNERS];
};

// Columns x0 to x1 and rows y0 to y1 of pixels, all included. Empty if x0 > x1 or y0 > y1.
struct PixelRect {
    int x0, y0, x1, y1;
};

// Product and sum, each rounded to nearest. The compiler does not fuse them.
__device__ inline float mul_rn(float a, float b) {
    return __fmul_rn(a, b);
}

__device__ inline float add_rn(float a, float b) {
    return __fadd_rn(a, b);
}

// Position of a vertex in clip space.
__device__ inline float4 to_clip(const RasterArgs& args, unsigned vertex) {
    const float* position = (const float*)args.positions + 3 * (size_t)vertex;
    const float x = __ldg(position), y = __ldg(position + 1), z = __ldg(position + 2);
    const float* matrix = args.clip_from_position;
    float4 clip;
    clip.x = add_rn(add_rn(add_rn(mul_rn(matrix[0], x), mul_rn(matrix[1], y)), mul_rn(matrix[2], z)), matrix[3]);
    clip.y = add_rn(add_rn(add_rn(mul_rn(matrix[4], x), mul_rn(matrix[5], y)), mul_rn(matrix[6], z)), matrix[7]);
    clip.z = add_rn(add_rn(add_rn(mul_rn(matrix[8], x), mul_rn(matrix[9], y)), mul_rn(matrix[10], z)), matrix[11]);
    clip.w = add_rn(add_rn(add_rn(mul_rn(matrix[12], x), mul_rn(matrix[13], y)), mul_rn(matrix[14], z)), matrix[15]);
    return clip;
}

// Loads the corners of a triangle in clip space.
__device__ inline void load_triangle(const RasterArgs& args, unsigned triangle, float4 (&corners)[3]) {
    const unsigned* vertices = (const unsigned*)args.triangles + 3 * (size_t)triangle;
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        corners[i] = to_clip(args, __ldg(vertices + i));
    }
}

__device__ inline bool is_finite(float4 v) {
    constexpr float MAX_FINITE = 0x1.fffffep127f;
    return fabsf(v.x) <= MAX_FINITE && fabsf(v.y) <= MAX_FINITE && fabsf(v.z) <= MAX_FINITE && fabsf(v.w) <= MAX_FINITE;
}

// Whether one plane of the view frustum has all three corners on its outer side.
__device__ inline bool is_outside(const float4 (&corners)[3]) {
    return (corners[0].x > corners[0].w && corners[1].x > corners[1].w && corners[2].x > corners[2].w) ||
           (corners[0].x < -corners[0].w && corners[1].x < -corners[1].w && corners[2].x < -corners[2].w) ||
           (corners[0].y > corners[0].w && corners[1].y > corners[1].w && corners[2].y > corners[2].w) ||
           (corners[0].y < -corners[0].w && corners[1].y < -corners[1].w && corners[2].y < -corners[2].w) ||
           (corners[0].z > corners[0].w && corners[1].z > corners[1].w && corners[2].z > corners[2].w) ||
           (corners[0].z < 0.0f && corners[1].z < 0.0f && corners[2].z < 0.0f);
}

// Signed distance of a corner from a clip plane; at least 0 on the inner side. Plane 0 is the near plane. Planes 1 to 4
// are the sides of the guard band, the region around the window inside which snapped coordinates cannot overflow.
__device__ inline float plane_distance(const RasterArgs& args, float4 corner, unsigned plane) {
    const float x = mul_rn(args.guard_x, corner.w), y = mul_rn(args.guard_y, corner.w);
    return plane == 0 ? add_rn(corner.w, -corner.z) : plane == 1 ? add_rn(x, -corner.x) : plane == 2 ? add_rn(x, corner.x)
         : plane == 3 ? add_rn(y, -corner.y) : add_rn(y, corner.y);
}

__device__ inline bool is_inside_guard_band(const RasterArgs& args, float4 corner) {
    const float x = mul_rn(args.guard_x, corner.w), y = mul_rn(args.guard_y, corner.w);
    return add_rn(corner.w, -corner.z) >= 0.0f && add_rn(x, -corner.x) >= 0.0f && add_rn(x, corner.x) >= 0.0f &&
           add_rn(y, -corner.y) >= 0.0f && add_rn(y, corner.y) >= 0.0f && corner.w >= MIN_W;
}

// Projects a corner to the window and rounds x and y to 1/256 pixel.
__device__ inline SnappedVertex snap(const RasterArgs& args, float4 corner) {
    const float inverse_w = __frcp_rn(corner.w);
    const float x = add_rn(mul_rn(mul_rn(corner.x, inverse_w), args.half_width), args.half_width);
    const float y = add_rn(mul_rn(-mul_rn(corner.y, inverse_w), args.half_height), args.half_height);
    SnappedVertex snapped;
    snapped.x = __float2int_rn(mul_rn(x, (float)SUBPIXEL_STEPS));
    snapped.y = __float2int_rn(mul_rn(y, (float)SUBPIXEL_STEPS));
    snapped.z = mul_rn(corner.z, inverse_w);
    return snapped;
}

// Intersection of an edge with a clip plane. It is always computed from the inside end, so that both triangles that
// share an edge get the same bits.
__device__ inline float4 clip_edge(float4 inside, float4 outside, float inside_distance, float outside_distance) {
    const float t = __fdiv_rn(inside_distance, add_rn(inside_distance, -outside_distance));
    float4 intersection;
    intersection.x = add_rn(inside.x, mul_rn(t, add_rn(outside.x, -inside.x)));
    intersection.y = add_rn(inside.y, mul_rn(t, add_rn(outside.y, -inside.y)));
    intersection.z = add_rn(inside.z, mul_rn(t, add_rn(outside.z, -inside.z)));
    intersection.w = add_rn(inside.w, mul_rn(t, add_rn(outside.w, -inside.w)));
    return intersection;
}

// Sutherland-Hodgman clipping by the near plane and the guard band, from one of two corner lists to the other for each
// plane. Not inlined, because few triangles are clipped.
__device__ __noinline__ void clip_triangle(const RasterArgs& args, float4 a, float4 b, float4 c, ClippedPolygon& polygon) {
    float4 corner_lists[2][MAX_CORNERS];
    unsigned corner_count = 3, source = 0;
    corner_lists[0][0] = a;
    corner_lists[0][1] = b;
    corner_lists[0][2] = c;
    for (unsigned plane = 0; plane < 5; ++plane) {
        unsigned new_count = 0;
        for (unsigned i = 0; i < corner_count; ++i) {
            const float4 start = corner_lists[source][i], end = corner_lists[source][i + 1 == corner_count ? 0 : i + 1];
            const float start_distance = plane_distance(args, start, plane), end_distance = plane_distance(args, end, plane);
            if (start_distance >= 0.0f && new_count < MAX_CORNERS) {
                corner_lists[1 - source][new_count++] = start;
            }
            if ((start_distance >= 0.0f) != (end_distance >= 0.0f) && new_count < MAX_CORNERS) {
                corner_lists[1 - source][new_count++] = start_distance >= 0.0f
                                                            ? clip_edge(start, end, start_distance, end_distance)
                                                            : clip_edge(end, start, end_distance, start_distance);
            }
        }
        source = 1 - source;
        corner_count = new_count;
    }
    polygon.count = corner_count < 3 ? 0 : corner_count;
    for (unsigned i = 0; i < polygon.count; ++i) {
        if (!(corner_lists[source][i].w >= MIN_W)) {
            polygon.count = 0;
            return;
        }
        polygon.corners[i] = snap(args, corner_lists[source][i]);
    }
}

// Twice the signed area; positive when a, b, c are clockwise on the screen.
__device__ inline long long doubled_area(const SnappedVertex& a, const SnappedVertex& b, const SnappedVertex& c) {
    return (long long)(b.x - a.x) * (c.y - a.y) - (long long)(b.y - a.y) * (c.x - a.x);
}

// The pixels of the window whose samples lie inside a rectangle, which is given in 1/256 pixel. The sample of column c
// is at x = 256 c + 128. The first column whose sample is at or after x0 is therefore ceil((x0 - 128) / 256), and the
// last one whose sample is at or before x1 is floor((x1 - 128) / 256).
__device__ inline PixelRect pixel_rect(const RasterArgs& args, int x0, int y0, int x1, int y1) {
    constexpr int HALF_PIXEL = SUBPIXEL_STEPS / 2;
    return {max(0, (x0 + HALF_PIXEL - 1) >> 8), max(0, (y0 + HALF_PIXEL - 1) >> 8),
            min((int)args.width - 1, (x1 - HALF_PIXEL) >> 8),
            min((int)args.height - 1, (y1 - HALF_PIXEL) >> 8)};
}

__device__ inline long long doubled_area(const ClippedPolygon& polygon) {
    long long area = 0;
    for (unsigned i = 1; i + 1 < polygon.count; ++i) {
        area += doubled_area(polygon.corners[0], polygon.corners[i], polygon.corners[i + 1]);
    }
    return area;
}

__device__ inline PixelRect pixel_rect(const RasterArgs& args, const ClippedPolygon& polygon) {
    const SnappedVertex& first_corner = polygon.corners[0];
    int x0 = first_corner.x, x1 = first_corner.x, y0 = first_corner.y, y1 = first_corner.y;
    for (unsigned i = 1; i < polygon.count; ++i) {
        const SnappedVertex& corner = polygon.corners[i];
        x0 = min(x0, corner.x);
        x1 = max(x1, corner.x);
        y0 = min(y0, corner.y);
        y1 = max(y1, corner.y);
    }
    return pixel_rect(args, x0, y0, x1, y1);
}

// A triangle with its corners clockwise on the screen; a is the farthest corner. EdgeInt is the type of edge functions;
// it must be wide enough for their values at all tested samples.
template <typename EdgeInt>
struct TriangleSetup {
    SnappedVertex a, b, c;
    float slope_b, slope_c;                 // depth differences from a to b and from a to c, over the doubled area
    int min_edge_a, min_edge_b, min_edge_c; // `min_covered_edge` of the edge opposite to a, b and c

    // Minimum of the edge function at covered samples. It is 0 for a top or left edge, because such an edge covers the
    // samples on it, else 1.
    __device__ static int min_covered_edge(const SnappedVertex& start, const SnappedVertex& end) {
        return end.y < start.y || (end.y == start.y && end.x > start.x) ? 0 : 1;
    }

    // `doubled_area` is positive. `is_flipped` is true if v0, v1, v2 are counterclockwise on the screen.
    __device__ TriangleSetup(const SnappedVertex& v0, const SnappedVertex& v1, const SnappedVertex& v2, bool is_flipped,
                             EdgeInt doubled_area) {
        const SnappedVertex second = is_flipped ? v2 : v1, third = is_flipped ? v1 : v2;
        const bool starts_at_second = second.z < v0.z && second.z <= third.z;
        const bool starts_at_third = !starts_at_second && third.z < v0.z;
        a = starts_at_second ? second : starts_at_third ? third : v0;
        b = starts_at_second ? third : starts_at_third ? v0 : second;
        c = starts_at_second ? v0 : starts_at_third ? second : third;
        const float inverse_area = __frcp_rn((float)doubled_area);
        slope_b = mul_rn(add_rn(b.z, -a.z), inverse_area);
        slope_c = mul_rn(add_rn(c.z, -a.z), inverse_area);
        min_edge_a = min_covered_edge(b, c);
        min_edge_b = min_covered_edge(c, a);
        min_edge_c = min_covered_edge(a, b);
    }

    // Twice the signed area of the triangle with the corners `start`, `end` and (x, y), which are in 1/256 pixel.
    // Positive on the inner side of the edge.
    __device__ static EdgeInt edge_function(const SnappedVertex& start, const SnappedVertex& end, int x, int y) {
        return (EdgeInt)(end.x - start.x) * (y - start.y) - (EdgeInt)(end.y - start.y) * (x - start.x);
    }

    // Whether a pixel's sample lies inside the triangle and not behind the far plane. Sets `depth`, clamped to at most
    // 1. a is the farthest corner, so no term of the sum is negative, and its relative error is a few roundings, also
    // where depth is small.
    __device__ bool covers(int column, int row, float& depth) const {
        const int x = SUBPIXEL_STEPS * column + SUBPIXEL_STEPS / 2, y = SUBPIXEL_STEPS * row + SUBPIXEL_STEPS / 2;
        const EdgeInt edge_b = edge_function(c, a, x, y), edge_c = edge_function(a, b, x, y);
        if (edge_function(b, c, x, y) < min_edge_a || edge_b < min_edge_b || edge_c < min_edge_c) {
            return false;
        }
        const float z = add_rn(a.z, add_rn(mul_rn((float)edge_b, slope_b), mul_rn((float)edge_c, slope_c)));
        depth = z < 1.0f ? z : 1.0f;
        return z >= 0.0f;
    }
};

// Writes a sample if it is nearer than the one in the target. Depths are not negative, so their bits have the order of
// the numbers. A depth-only target keeps the largest depth. A target of keys keeps the smallest key, which has inverted
// depth bits, so that at equal depths the smallest triangle index wins. The plain read may be stale, but the target
// only changes in one direction: if the comparison fails, the atomic would change nothing. The alpha texture is read
// only for samples that pass the comparison.
template <typename AlphaTestPolicy>
__device__ inline void write_sample(const RasterArgs& args, const AlphaTestPolicy& alpha_test, int column, int row,
                                    float depth, unsigned triangle) {
    const size_t sample = (size_t)row * args.width + column;
    const unsigned bits = __float_as_uint(depth);
#ifdef DEPTH_ONLY
    unsigned* target = (unsigned*)args.target + sample;
    if (bits > __ldcg(target) && alpha_test.passes_alpha_test(args, column, row)) {
        atomicMax(target, bits);
    }
#else
    const unsigned long long key = (unsigned long long)~bits << 32 | triangle;
    unsigned long long* target = (unsigned long long*)args.target + sample;
    if (key < __ldcg(target) && alpha_test.passes_alpha_test(args, column, row)) {
        atomicMin(target, key);
    }
#endif
}
