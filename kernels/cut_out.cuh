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
struct OpaqueTest {
    __device__ OpaqueTest(const RasterArgs&, unsigned) {}

    __device__ bool passes_alpha_test(const RasterArgs&, int, int) const {
        return true;
    }
};

struct AlphaMaterial {
    unsigned long long image;             // texture of alpha, 0 for none
    float alpha, cutoff;
};

__device__ inline float sum3(float a, float b, float c) {
    return add_rn(add_rn(a, b), c);
}

// a d - b c
__device__ inline float cross2(float a, float b, float c, float d) {
    return add_rn(mul_rn(a, d), -mul_rn(b, c));
}

struct AlphaTest {
    float x[3], y[3], w[3], u[3], v[3];
    AlphaMaterial surface;

    __device__ AlphaTest(const RasterArgs& args, unsigned triangle) {
        const unsigned at = triangle - args.first_cut_out;
        const uint4 words = __ldg((const uint4*)args.materials + __ldg((const unsigned*)args.material_indices + at));
        surface.image = (unsigned long long)words.y << 32 | words.x;
        surface.alpha = __uint_as_float(words.z);
        surface.cutoff = __uint_as_float(words.w);
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

    __device__ bool passes_alpha_test(const RasterArgs& args, int column, int row) const {
        return mul_rn(surface.alpha, surface.image == 0 ? 1.0f : sample_alpha(args, column, row)) >= surface.cutoff;
    }

    __device__ float sample_alpha(const RasterArgs& args, int column, int row) const {
        const float step_x = __frcp_rn(args.half_width), step_y = __frcp_rn(args.half_height);
        const float sample_x = add_rn(mul_rn(add_rn((float)column, 0.5f), step_x), -1.0f);
        const float sample_y = add_rn(1.0f, -mul_rn(add_rn((float)row, 0.5f), step_y));
        float px[3], py[3], edge[3];
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            px[i] = add_rn(x[i], -mul_rn(sample_x, w[i]));
            py[i] = add_rn(y[i], -mul_rn(sample_y, w[i]));
        }
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const unsigned j = (i + 1) % 3, k = (i + 2) % 3;
            edge[i] = cross2(px[j], py[j], px[k], py[k]);
        }
        const float inverse = __frcp_rn(sum3(edge[0], edge[1], edge[2]));
        // Snapping may put a sample outside the unsnapped corners, so clamp the weights to zero.
        const float a = fmaxf(mul_rn(edge[0], inverse), 0.0f), b = fmaxf(mul_rn(edge[1], inverse), 0.0f),
                    c = fmaxf(mul_rn(edge[2], inverse), 0.0f);
        const float whole = __frcp_rn(sum3(a, b, c));
        float2 uv = {mul_rn(sum3(mul_rn(a, u[0]), mul_rn(b, u[1]), mul_rn(c, u[2])), whole),
                     mul_rn(sum3(mul_rn(a, v[0]), mul_rn(b, v[1]), mul_rn(c, v[2])), whole)};
        // Derivatives of the weights by the pixel in x and y, times the differences of the corners' texture coordinates
        // from this sample's.
        float2 across = {0.0f, 0.0f}, down = {0.0f, 0.0f};
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const unsigned j = (i + 1) % 3, k = (i + 2) % 3;
            const float by_x = cross2(py[j], py[k], w[j], w[k]), by_y = cross2(px[j], px[k], w[j], w[k]);
            const float du = add_rn(u[i], -uv.x), dv = add_rn(v[i], -uv.y);
            across.x = add_rn(across.x, mul_rn(by_x, du));
            across.y = add_rn(across.y, mul_rn(by_x, dv));
            down.x = add_rn(down.x, mul_rn(by_y, du));
            down.y = add_rn(down.y, mul_rn(by_y, dv));
        }
        const float rate_x = mul_rn(step_x, inverse), rate_y = mul_rn(step_y, inverse);
        across = {mul_rn(across.x, rate_x), mul_rn(across.y, rate_x)};
        down = {mul_rn(down.x, rate_y), mul_rn(down.y, rate_y)};
        const float4 changes = {across.x, across.y, down.x, down.y};
        if (!is_finite(changes) || !is_finite({uv.x, uv.y, 0.0f, 0.0f})) {
            uv = across = down = {0.0f, 0.0f};
        }
        return tex2DGrad<float>((cudaTextureObject_t)surface.image, uv.x, uv.y, across, down);
    }
};
