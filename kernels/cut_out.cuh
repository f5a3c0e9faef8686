// Alpha test of cut-out triangles at their samples: a sample passes if the alpha of its material and texture reaches
// the cutoff.
//
// The texture coordinates of a sample are weighted sums of those of the corners. The weights are the edge functions of
// the corners in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates",
// 1997). They are perspective-correct without clipping, also for corners behind the eye. They are computed relative to
// the sample, because a small triangle far from the center of the image would otherwise lose precision. No product
// overflows or underflows as long as w is between 2^-50 and 2^50. Twin: src/compute/reference/raster/cut_out.rs, with
// the same bits except for the texture filter.
#pragma once

#include "raster.cuh"

// Alpha test of an opaque triangle: every sample passes.
struct OpaqueTest {
    __device__ OpaqueTest(const RasterArgs&, unsigned) {}

    __device__ bool passes_alpha_test(const RasterArgs&, int, int) const {
        return true;
    }
};

// Twin: src/compute/gpu/executor/raster/cut_out.rs.
struct AlphaMaterial {
    unsigned long long image; // texture object of the alpha image, or 0
    float alpha, cutoff;
};

__device__ inline float sum3(float a, float b, float c) {
    return add_rn(add_rn(a, b), c);
}

// a d - b c
__device__ inline float cross2(float a, float b, float c, float d) {
    return add_rn(mul_rn(a, d), -mul_rn(b, c));
}

// Alpha test of a cut-out triangle: its corners in clip space (x, y, w) with texture coordinates, and its material.
struct AlphaTest {
    float x[3], y[3], w[3], u[3], v[3];
    AlphaMaterial material;

    __device__ AlphaTest(const RasterArgs& args, unsigned triangle) {
        const unsigned cut_out_index = triangle - args.first_cut_out;
        const unsigned material_index = __ldg((const unsigned*)args.material_indices + cut_out_index);
        const uint4 material_words = __ldg((const uint4*)args.materials + material_index);
        material.image = (unsigned long long)material_words.y << 32 | material_words.x;
        material.alpha = __uint_as_float(material_words.z);
        material.cutoff = __uint_as_float(material_words.w);
        if (material.image == 0) {
            return;
        }
        float4 corners[3];
        load_triangle(args, triangle, corners);
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            x[i] = corners[i].x;
            y[i] = corners[i].y;
            w[i] = corners[i].w;
            const float2 uv = __ldg((const float2*)args.uvs + 3 * (size_t)cut_out_index + i);
            u[i] = uv.x;
            v[i] = uv.y;
        }
    }

    __device__ bool passes_alpha_test(const RasterArgs& args, int column, int row) const {
        return mul_rn(material.alpha, material.image == 0 ? 1.0f : sample_alpha(args, column, row)) >= material.cutoff;
    }

    __device__ float sample_alpha(const RasterArgs& args, int column, int row) const {
        // Size of a pixel in normalized device coordinates: 2 / width and 2 / height.
        const float step_x = __frcp_rn(args.half_width), step_y = __frcp_rn(args.half_height);
        const float sample_x = add_rn(mul_rn(add_rn((float)column, 0.5f), step_x), -1.0f);
        const float sample_y = add_rn(1.0f, -mul_rn(add_rn((float)row, 0.5f), step_y));
        float relative_x[3], relative_y[3], edge_weights[3];
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            relative_x[i] = add_rn(x[i], -mul_rn(sample_x, w[i]));
            relative_y[i] = add_rn(y[i], -mul_rn(sample_y, w[i]));
        }
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const unsigned j = (i + 1) % 3, k = (i + 2) % 3;
            edge_weights[i] = cross2(relative_x[j], relative_y[j], relative_x[k], relative_y[k]);
        }
        const float inverse_edge_sum = __frcp_rn(sum3(edge_weights[0], edge_weights[1], edge_weights[2]));
        // Coverage uses the snapped triangle, so a covered sample may lie outside of the exact triangle. Clamp its
        // negative weights to zero.
        const float weight_a = fmaxf(mul_rn(edge_weights[0], inverse_edge_sum), 0.0f);
        const float weight_b = fmaxf(mul_rn(edge_weights[1], inverse_edge_sum), 0.0f);
        const float weight_c = fmaxf(mul_rn(edge_weights[2], inverse_edge_sum), 0.0f);
        const float inverse_weight_sum = __frcp_rn(sum3(weight_a, weight_b, weight_c));
        float2 uv = {mul_rn(sum3(mul_rn(weight_a, u[0]), mul_rn(weight_b, u[1]), mul_rn(weight_c, u[2])), inverse_weight_sum),
                     mul_rn(sum3(mul_rn(weight_a, v[0]), mul_rn(weight_b, v[1]), mul_rn(weight_c, v[2])), inverse_weight_sum)};
        // Derivatives of uv by column (dx) and row (dy). uv = sum_i e_i uv_i / s, with the edge functions e_i
        // (`edge_weights`), their sum s, and the texture coordinates uv_i of corner i. With ' for a derivative:
        // uv' = sum_i e_i' (uv_i - uv) / s. From relative_x = x - sample_x * w follows the derivative of e_i by
        // sample_x: cross2(relative_y[j], relative_y[k], w[j], w[k]). The derivative by sample_y has a minus sign,
        // which is canceled because sample_y decreases with the row.
        float2 uv_dx = {0.0f, 0.0f}, uv_dy = {0.0f, 0.0f};
#pragma unroll
        for (unsigned i = 0; i < 3; ++i) {
            const unsigned j = (i + 1) % 3, k = (i + 2) % 3;
            const float weight_dx = cross2(relative_y[j], relative_y[k], w[j], w[k]);
            const float weight_dy = cross2(relative_x[j], relative_x[k], w[j], w[k]);
            const float du = add_rn(u[i], -uv.x), dv = add_rn(v[i], -uv.y);
            uv_dx.x = add_rn(uv_dx.x, mul_rn(weight_dx, du));
            uv_dx.y = add_rn(uv_dx.y, mul_rn(weight_dx, dv));
            uv_dy.x = add_rn(uv_dy.x, mul_rn(weight_dy, du));
            uv_dy.y = add_rn(uv_dy.y, mul_rn(weight_dy, dv));
        }
        const float scale_x = mul_rn(step_x, inverse_edge_sum), scale_y = mul_rn(step_y, inverse_edge_sum);
        uv_dx = {mul_rn(uv_dx.x, scale_x), mul_rn(uv_dx.y, scale_x)};
        uv_dy = {mul_rn(uv_dy.x, scale_y), mul_rn(uv_dy.y, scale_y)};
        const float4 derivatives = {uv_dx.x, uv_dx.y, uv_dy.x, uv_dy.y};
        if (!is_finite(derivatives) || !is_finite({uv.x, uv.y, 0.0f, 0.0f})) {
            uv = uv_dx = uv_dy = {0.0f, 0.0f};
        }
        return tex2DGrad<float>((cudaTextureObject_t)material.image, uv.x, uv.y, uv_dx, uv_dy);
    }
};
