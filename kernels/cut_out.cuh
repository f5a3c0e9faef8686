// Alpha test of cut-out triangles at their samples.
//
// The texture coordinates of a sample are weighted sums of those of the corners. The weights are the edge functions of
// the corners in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates",
// 1997): perspective-correct without clipping, also for corners behind the eye. The corners are first taken relative to
// the sample, so that a small triangle far from the center keeps its precision. The products neither over- nor
// underflow as long as w is between 2^-50 and 2^50. Twin: src/compute/reference/raster/cut_out.rs, with the same bits
// up to the texture filter.
#pragma once

#include "raster.cuh"

// A triangle without a cut-out: every sample is kept.
struct Whole {
    __device__ Whole(const RasterArgs&, unsigned) {}

    __device__ bool keeps(const RasterArgs&, int, int) const {
        return true;
    }
};

struct Surface {
    unsigned long long image;             // texture of alpha, 0 for none
    float alpha, least;
};

__device__ inline float sum_of(float a, float b, float c) {
    return plus(plus(a, b), c);
}

// a d - b c
__device__ inline float cross_of(float a, float b, float c, float d) {
    return plus(times(a, d), -times(b, c));
}

struct CutOut {
    float x[3], y[3], w[3], u[3], v[3];
    Surface surface;

    __device__ CutOut(const RasterArgs& args, unsigned triangle) {
        const unsigned at = triangle - args.cut;
        const uint4 words = __ldg((const uint4*)args.table + __ldg((const unsigned*)args.surfaces + at));
        surface.image = (unsigned long long)words.y << 32 | words.x;
        surface.alpha = __uint_as_float(words.z);
        surface.least = __uint_as_float(words.w);
        if (surface.image == 0) {
            return;
        }
        float4 corners[3];
        load_triangle(args, triangle, corners);
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            x[i] = corners[i].x;
            y[i] = corners[i].y;
            w[i] = corners[i].w;
            const float2 uv = __ldg((const float2*)args.uvs + 3 * (size_t)at + i);
            u[i] = uv.x;
            v[i] = uv.y;
        }
    }

    __device__ bool keeps(const RasterArgs& args, int column, int row) const {
        return times(surface.alpha, surface.image == 0 ? 1.0f : image_at(args, column, row)) >= surface.least;
    }

    __device__ float image_at(const RasterArgs& args, int column, int row) const {
        const float step_x = __frcp_rn(args.half_width), step_y = __frcp_rn(args.half_height);
        const float sample_x = plus(times(plus((float)column, 0.5f), step_x), -1.0f);
        const float sample_y = plus(1.0f, -times(plus((float)row, 0.5f), step_y));
        float px[3], py[3], edge[3];
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            px[i] = plus(x[i], -times(sample_x, w[i]));
            py[i] = plus(y[i], -times(sample_y, w[i]));
        }
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const unsigned j = (i + 1) % 3, k = (i + 2) % 3;
            edge[i] = cross_of(px[j], py[j], px[k], py[k]);
        }
        const float inverse = __frcp_rn(sum_of(edge[0], edge[1], edge[2]));
        // Snapping may put a sample outside the unsnapped corners, so clamp the weights to zero.
        const float a = fmaxf(times(edge[0], inverse), 0.0f), b = fmaxf(times(edge[1], inverse), 0.0f),
                    c = fmaxf(times(edge[2], inverse), 0.0f);
        const float whole = __frcp_rn(sum_of(a, b, c));
        float2 uv = {times(sum_of(times(a, u[0]), times(b, u[1]), times(c, u[2])), whole),
                     times(sum_of(times(a, v[0]), times(b, v[1]), times(c, v[2])), whole)};
        // Derivatives of the weights by the pixel in x and y, times the differences of the corners' texture coordinates
        // from this sample's.
        float2 across = {0.0f, 0.0f}, down = {0.0f, 0.0f};
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const unsigned j = (i + 1) % 3, k = (i + 2) % 3;
            const float by_x = cross_of(py[j], py[k], w[j], w[k]), by_y = cross_of(px[j], px[k], w[j], w[k]);
            const float du = plus(u[i], -uv.x), dv = plus(v[i], -uv.y);
            across.x = plus(across.x, times(by_x, du));
            across.y = plus(across.y, times(by_x, dv));
            down.x = plus(down.x, times(by_y, du));
            down.y = plus(down.y, times(by_y, dv));
        }
        const float rate_x = times(step_x, inverse), rate_y = times(step_y, inverse);
        across = {times(across.x, rate_x), times(across.y, rate_x)};
        down = {times(down.x, rate_y), times(down.y, rate_y)};
        const float4 changes = {across.x, across.y, down.x, down.y};
        if (!is_finite(changes) || !is_finite({uv.x, uv.y, 0.0f, 0.0f})) {
            uv = across = down = {0.0f, 0.0f};
        }
        return tex2DGrad<float>((cudaTextureObject_t)surface.image, uv.x, uv.y, across, down);
    }
};
