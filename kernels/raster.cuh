// Triangle setup of the compute rasterizer: corners in clip space, clipping, snapping to 1/256 pixel, edge functions
// and depth. Every float sum and product is rounded separately (no fused multiply-add), so that host and device give
// the same bits. Windows have y down; the first sample of the first row is at (1/2, 1/2). Twin:
// src/compute/reference/raster.rs.
#pragma once

constexpr int SUBPIXEL_STEPS = 256;                 // subpixel steps per pixel
constexpr unsigned MAX_CORNERS = 8;      // three, and one more for each of five planes
constexpr float MIN_W = 0x1p-100f;      // below this, 1 / w is not usable

struct RasterArgs {
    unsigned long long positions;         // [vertices][3] f32
    unsigned long long triangles;         // [triangles][3] u32: vertices
    unsigned long long target;            // [height][width] u64: depth, id; or f32: depth                 (in, out)
    unsigned long long medium;            // [triangles] u32: triangles that warps draw                    (out, in)
    unsigned long long large;             // [triangles] Large: triangles that are drawn by tiles          (out, in)
    unsigned long long counters;             // Tally                                                         (in, out)
    unsigned long long uvs;               // [triangles - first_cut_out][3][2] f32
    unsigned long long material_indices;          // [triangles - first_cut_out] u32: indices into the table
    unsigned long long materials;             // [surfaces] Surface
    float clip[16];                       // clip from positions, row-major
    float half_width, half_height;        // pixels
    float guard_x, guard_y;               // |x| and |y| up to which nothing is clipped, in units of w
    unsigned width, height;
    unsigned first, count;                // the triangles of this launch
    unsigned faces;                       // 0: both, 1: front faces (counterclockwise with y up)
    unsigned first_cut_out;               // first cut-out triangle; with CUT_OUTS, as uvs, surfaces and table
};

struct LargeTriangle {
    unsigned long long first;             // number of tiles of the entries before
    unsigned triangle;
    unsigned box;                         // first tile: x, y; tiles across - 1: 8 bits each
};

struct RasterCounters {
    unsigned medium, pad;
    unsigned long long large;             // entries << TILES_BITS | tiles
    unsigned counts[8];                   // by Path
};

enum TriangleBin { SMALL, MEDIUM, LARGE, NOT_FINITE, OUTSIDE_FRUSTUM, DEGENERATE, BACK_FACING, NO_SAMPLE, NO_BIN };

struct SnappedVertex {
    int x, y;                             // 1/256 pixel
    float z;                              // depth in the window
};

struct ClippedPolygon {
    unsigned count;
    SnappedVertex corners[MAX_CORNERS];
};

// A range of samples, both ends included.
struct PixelRect {
    int x0, y0, x1, y1;
};

__device__ inline float mul_rn(float a, float b) {
    return __fmul_rn(a, b);
}

__device__ inline float add_rn(float a, float b) {
    return __fadd_rn(a, b);
}

__device__ inline float4 to_clip(const RasterArgs& args, unsigned vertex) {
    const float* p = (const float*)args.positions + 3 * (size_t)vertex;
    const float x = __ldg(p), y = __ldg(p + 1), z = __ldg(p + 2);
    const float* m = args.clip;
    float4 out;
    out.x = add_rn(add_rn(add_rn(mul_rn(m[0], x), mul_rn(m[1], y)), mul_rn(m[2], z)), m[3]);
    out.y = add_rn(add_rn(add_rn(mul_rn(m[4], x), mul_rn(m[5], y)), mul_rn(m[6], z)), m[7]);
    out.z = add_rn(add_rn(add_rn(mul_rn(m[8], x), mul_rn(m[9], y)), mul_rn(m[10], z)), m[11]);
    out.w = add_rn(add_rn(add_rn(mul_rn(m[12], x), mul_rn(m[13], y)), mul_rn(m[14], z)), m[15]);
    return out;
}

__device__ inline void load_triangle(const RasterArgs& args, unsigned triangle, float4 (&corners)[3]) {
    const unsigned* vertices = (const unsigned*)args.triangles + 3 * (size_t)triangle;
#pragma unroll
    for (unsigned i = 0; i < 3; ++i) {
        corners[i] = to_clip(args, __ldg(vertices + i));
    }
}

__device__ inline bool is_finite(float4 v) {
    constexpr float LARGEST = 0x1.fffffep127f;
    return fabsf(v.x) <= LARGEST && fabsf(v.y) <= LARGEST && fabsf(v.z) <= LARGEST && fabsf(v.w) <= LARGEST;
}

// Whether all three corners lie outside one plane of the view frustum.
__device__ inline bool is_outside(const float4 (&v)[3]) {
    return (v[0].x > v[0].w && v[1].x > v[1].w && v[2].x > v[2].w) ||
           (v[0].x < -v[0].w && v[1].x < -v[1].w && v[2].x < -v[2].w) ||
           (v[0].y > v[0].w && v[1].y > v[1].w && v[2].y > v[2].w) ||
           (v[0].y < -v[0].w && v[1].y < -v[1].w && v[2].y < -v[2].w) ||
           (v[0].z > v[0].w && v[1].z > v[1].w && v[2].z > v[2].w) ||
           (v[0].z < -v[0].w && v[1].z < -v[1].w && v[2].z < -v[2].w);
}

// Signed distance to a plane, not negative on the inner side: the near plane, then the sides of the guard band.
__device__ inline float plane_distance(const RasterArgs& args, float4 v, unsigned plane) {
    const float x = mul_rn(args.guard_x, v.w), y = mul_rn(args.guard_y, v.w);
    return plane == 0 ? add_rn(v.z, v.w) : plane == 1 ? add_rn(x, -v.x) : plane == 2 ? add_rn(x, v.x)
         : plane == 3 ? add_rn(y, -v.y) : add_rn(y, v.y);
}

__device__ inline bool is_inside_guard_band(const RasterArgs& args, float4 v) {
    const float x = mul_rn(args.guard_x, v.w), y = mul_rn(args.guard_y, v.w);
    return add_rn(v.z, v.w) >= 0.0f && add_rn(x, -v.x) >= 0.0f && add_rn(x, v.x) >= 0.0f && add_rn(y, -v.y) >= 0.0f &&
           add_rn(y, v.y) >= 0.0f && v.w >= MIN_W;
}

__device__ inline SnappedVertex snap(const RasterArgs& args, float4 v) {
    const float inverse = __frcp_rn(v.w);
    const float x = add_rn(mul_rn(mul_rn(v.x, inverse), args.half_width), args.half_width);
    const float y = add_rn(mul_rn(-mul_rn(v.y, inverse), args.half_height), args.half_height);
    SnappedVertex corner;
    corner.x = __float2int_rn(mul_rn(x, (float)SUBPIXEL_STEPS));
    corner.y = __float2int_rn(mul_rn(y, (float)SUBPIXEL_STEPS));
    corner.z = add_rn(mul_rn(mul_rn(v.z, inverse), 0.5f), 0.5f);
    return corner;
}

// Intersection of an edge with a plane, always computed from the inner end, so that both triangles of an edge get the
// same bits.
__device__ inline float4 clip_edge(float4 in, float4 out, float d_in, float d_out) {
    const float t = __fdiv_rn(d_in, add_rn(d_in, -d_out));
    float4 v;
    v.x = add_rn(in.x, mul_rn(t, add_rn(out.x, -in.x)));
    v.y = add_rn(in.y, mul_rn(t, add_rn(out.y, -in.y)));
    v.z = add_rn(in.z, mul_rn(t, add_rn(out.z, -in.z)));
    v.w = add_rn(in.w, mul_rn(t, add_rn(out.w, -in.w)));
    return v;
}

// Sutherland-Hodgman clipping by the near plane and the guard band; no corners if nothing remains. Rarely called.
__device__ __noinline__ void clip_triangle(const RasterArgs& args, float4 a, float4 b, float4 c, ClippedPolygon& polygon) {
    float4 lists[2][MAX_CORNERS];
    unsigned count = 3, from = 0;
    lists[0][0] = a;
    lists[0][1] = b;
    lists[0][2] = c;
    for (unsigned plane = 0; plane < 5; ++plane) {
        unsigned kept = 0;
        for (unsigned i = 0; i < count; ++i) {
            const float4 a = lists[from][i], b = lists[from][i + 1 == count ? 0 : i + 1];
            const float da = plane_distance(args, a, plane), db = plane_distance(args, b, plane);
            if (da >= 0.0f && kept < MAX_CORNERS) {
                lists[1 - from][kept++] = a;
            }
            if ((da >= 0.0f) != (db >= 0.0f) && kept < MAX_CORNERS) {
                lists[1 - from][kept++] = da >= 0.0f ? clip_edge(a, b, da, db) : clip_edge(b, a, db, da);
            }
        }
        from = 1 - from;
        count = kept;
    }
    polygon.count = count < 3 ? 0 : count;
    for (unsigned i = 0; i < polygon.count; ++i) {
        if (!(lists[from][i].w >= MIN_W)) {
            polygon.count = 0;
            return;
        }
        polygon.corners[i] = snap(args, lists[from][i]);
    }
}

// Twice the signed area; positive when a, b, c are clockwise on the screen.
__device__ inline long long area_of(const SnappedVertex& a, const SnappedVertex& b, const SnappedVertex& c) {
    return (long long)(b.x - a.x) * (c.y - a.y) - (long long)(b.y - a.y) * (c.x - a.x);
}

// The samples between two corners in 1/256 pixel, clipped to the window.
__device__ inline PixelRect pixel_rect(const RasterArgs& args, int x0, int y0, int x1, int y1) {
    constexpr int MIDDLE = SUBPIXEL_STEPS / 2;
    return {max(0, (x0 + MIDDLE - 1) >> 8), max(0, (y0 + MIDDLE - 1) >> 8), min((int)args.width - 1, (x1 - MIDDLE) >> 8),
            min((int)args.height - 1, (y1 - MIDDLE) >> 8)};
}

__device__ inline long long area_of(const ClippedPolygon& polygon) {
    long long area = 0;
    for (unsigned i = 1; i + 1 < polygon.count; ++i) {
        area += area_of(polygon.corners[0], polygon.corners[i], polygon.corners[i + 1]);
    }
    return area;
}

__device__ inline PixelRect pixel_rect(const RasterArgs& args, const ClippedPolygon& polygon) {
    const SnappedVertex& first = polygon.corners[0];
    int x0 = first.x, x1 = first.x, y0 = first.y, y1 = first.y;
    for (unsigned i = 1; i < polygon.count; ++i) {
        const SnappedVertex& corner = polygon.corners[i];
        x0 = min(x0, corner.x);
        x1 = max(x1, corner.x);
        y0 = min(y0, corner.y);
        y1 = max(y1, corner.y);
    }
    return pixel_rect(args, x0, y0, x1, y1);
}

// A triangle with its corners clockwise on the screen. `Wide` must hold its edge functions at all samples tested.
template <typename Wide>
struct TriangleSetup {
    SnappedVertex a, b, c;
    float inverse, rise_b, rise_c;        // 1 / area; depth from a to b and to c
    int least_a, least_b, least_c;        // least covered value of the edge opposite each corner: top-left rule

    __device__ static int top_left_bias(const SnappedVertex& from, const SnappedVertex& to) {
        return to.y < from.y || (to.y == from.y && to.x > from.x) ? 0 : 1;
    }

    __device__ TriangleSetup(const SnappedVertex& first, const SnappedVertex& second, const SnappedVertex& third, bool is_flipped, Wide area) {
        a = first;
        b = is_flipped ? third : second;
        c = is_flipped ? second : third;
        inverse = __frcp_rn((float)area);
        rise_b = add_rn(b.z, -a.z);
        rise_c = add_rn(c.z, -a.z);
        least_a = top_left_bias(b, c);
        least_b = top_left_bias(c, a);
        least_c = top_left_bias(a, b);
    }

    __device__ static Wide edge(const SnappedVertex& from, const SnappedVertex& to, int x, int y) {
        return (Wide)(to.x - from.x) * (y - from.y) - (Wide)(to.y - from.y) * (x - from.x);
    }

    // Whether a pixel's sample lies inside the triangle and in front of the far plane. `depth` is then at least 0.
    __device__ bool covers(int column, int row, float& depth) const {
        const int x = SUBPIXEL_STEPS * column + SUBPIXEL_STEPS / 2, y = SUBPIXEL_STEPS * row + SUBPIXEL_STEPS / 2;
        const Wide at_b = edge(c, a, x, y), at_c = edge(a, b, x, y);
        if (edge(b, c, x, y) < least_a || at_b < least_b || at_c < least_c) {
            return false;
        }
        const float share_b = mul_rn((float)at_b, inverse), share_c = mul_rn((float)at_c, inverse);
        const float z = add_rn(a.z, add_rn(mul_rn(share_b, rise_b), mul_rn(share_c, rise_c)));
        depth = z > 0.0f ? z : 0.0f;
        return z <= 1.0f;
    }
};

// Depths are not negative, so their bits order like the numbers. The plain read may be stale, but the target only
// decreases: if the test fails, the atomic would change nothing, and the alpha of a hidden sample need not be read.
template <typename Kind>
__device__ inline void write_sample(const RasterArgs& args, const Kind& surface, int column, int row, float depth, unsigned triangle) {
    const size_t at = (size_t)row * args.width + column;
    const unsigned bits = __float_as_uint(depth);
#ifdef DEPTH_ONLY
    unsigned* target = (unsigned*)args.target + at;
    if (bits < __ldcg(target) && surface.passes_alpha_test(args, column, row)) {
        atomicMin(target, bits);
    }
#else
    const unsigned long long key = (unsigned long long)bits << 32 | triangle;
    unsigned long long* target = (unsigned long long*)args.target + at;
    if (key < __ldcg(target) && surface.passes_alpha_test(args, column, row)) {
        atomicMin(target, key);
    }
#endif
}
