// Rigid normals and tangents of a tile: the rest normals and tangents, transformed by T without U q (equation 3.8 of
// the thesis). Normals are transformed by the inverse transpose of the linear part of T, tangents by the linear part. A
// T with a reflection flips the sign of the bitangent. CPU twin: src/compute/reference/rigid_normals.rs.
//
// Each lane scales its matrix by a power of two, so that the largest entry is about 1. If the scaled matrix makes a
// unit vector shorter than 0.1, the result has lost precision in f32 and is computed again in f64. deform.cu includes
// this file and describes the macros.
#pragma once
#include "warp_tile.cuh"
#include "direction.cuh"

// A transformed direction with at most this squared length (0.1^2) has lost too much precision to cancellation.
constexpr float MIN_SQUARED_LENGTH = 0.01f;

struct Mat3f {
    float3 row0, row1, row2;
};

// The power of two that scales a positive number to [1, 2), or as near as f32 allows. A number with the exponent bits e
// has the exponent e - 127, so the power of two has the exponent bits 127 - (e - 127) = 254 - e.
__device__ __forceinline__ float power_of_two_scale(float max_entry) {
    const unsigned exponent = __float_as_uint(max_entry) >> 23;
    return __uint_as_float(max(254 - (int)exponent, 1) << 23);
}

__device__ __forceinline__ float max_abs(float a, float b, float c) {
    return fmaxf(fmaxf(fabsf(a), fabsf(b)), fabsf(c));
}

// The linear part of a transform, scaled so that its largest entry is about 1. The scale is a power of two and thus
// rounds nothing.
__device__ __forceinline__ Mat3f to_scaled_mat3f(const Affine& t) {
    const float4 a = t.row0, b = t.row1, c = t.row2;
    const float max_entry = fmaxf(fmaxf(max_abs(a.x, a.y, a.z), max_abs(b.x, b.y, b.z)), max_abs(c.x, c.y, c.z));
    const float scale = power_of_two_scale(max_entry);
    return {make_float3(a.x * scale, a.y * scale, a.z * scale), make_float3(b.x * scale, b.y * scale, b.z * scale),
            make_float3(c.x * scale, c.y * scale, c.z * scale)};
}

#ifdef FOLLOWERS
// One row of the product A F: `t` is a row of the linear part A of T, `f` is the linear part of the follower frame F.
__device__ __forceinline__ float4 compose_linear_row(const float3& t, const Mat3f& f) {
    return make_float4(fmaf(t.x, f.row0.x, fmaf(t.y, f.row1.x, t.z * f.row2.x)),
                       fmaf(t.x, f.row0.y, fmaf(t.y, f.row1.y, t.z * f.row2.y)),
                       fmaf(t.x, f.row0.z, fmaf(t.y, f.row1.z, t.z * f.row2.z)), 0.0f);
}
#endif

// The scaled linear part of T of a domain. Both factors of a follower's T are scaled before the product, to avoid
// overflow.
__device__ __forceinline__ Mat3f load_scaled_linear_part(const Transforms& transforms, unsigned domain) {
#ifdef FOLLOWERS
    const TransformLink link = load_transform_link(transforms, domain);
    const Mat3f t = to_scaled_mat3f(load_affine(transforms.rows, link.root));
    if (link.frame == NO_FRAME) {
        return t;
    }
    const Mat3f f = to_scaled_mat3f(load_affine(transforms.follower_frames, link.frame));
    return to_scaled_mat3f(Affine{compose_linear_row(t.row0, f), compose_linear_row(t.row1, f), compose_linear_row(t.row2, f)});
#else
    return to_scaled_mat3f(load_affine(transforms.rows, domain));
#endif
}

#ifdef SHEAR
// The matrix scaled by a power of two so that its largest entry is in [1, 2), rounded once to f32. As in
// `power_of_two_scale`, but for f64, whose exponent bias is 1023: 2046 = 2 * 1023.
__device__ __forceinline__ Mat3f to_scaled_mat3f(const Mat3d& m) {
    const double row0_max = fmax(fmax(fabs(m.row0.x), fabs(m.row0.y)), fabs(m.row0.z));
    const double row1_max = fmax(fmax(fabs(m.row1.x), fabs(m.row1.y)), fabs(m.row1.z));
    const double row2_max = fmax(fmax(fabs(m.row2.x), fabs(m.row2.y)), fabs(m.row2.z));
    const double max_entry = fmax(fmax(row0_max, row1_max), row2_max);
    const int exponent = (__double2hiint(max_entry) >> 20) & 0x7ff;
    const double scale = max_entry > 0.0 ? __hiloint2double((2046 - exponent) << 20, 0) : 0.0;
    return {make_float3(m.row0.x * scale, m.row0.y * scale, m.row0.z * scale),
            make_float3(m.row1.x * scale, m.row1.y * scale, m.row1.z * scale),
            make_float3(m.row2.x * scale, m.row2.y * scale, m.row2.z * scale)};
}
#endif

// Repeats the transformation in f64 for the corners of a lane in the bit mask `imprecise_corners`. The other corners
// keep their results, so that the result of a corner does not depend on the corners in the same lane. `rest_directions`
// points to the x component of the lane's first direction; the y component is `axis_stride` floats later.
// `component_count` is the number of staged floats per direction: 3 for normals and 4 for tangents.
__device__ __noinline__ void retransform_directions_f64(Transforms transforms, unsigned domain,
                                                        const float* rest_directions, unsigned axis_stride,
                                        float* staged_directions, unsigned imprecise_corners, unsigned component_count) {
    const Mat3d m = load_linear_part(transforms, domain);
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        if (imprecise_corners >> i & 1) {
            const double3 v = make_double3(rest_directions[i], rest_directions[axis_stride + i],
                                           rest_directions[2 * axis_stride + i]);
            const float3 direction = component_count == 3 ? transform_normal(m, v) : transform_direction(m, v);
            staged_directions[component_count * i] = direction.x;
            staged_directions[component_count * i + 1] = direction.y;
            staged_directions[component_count * i + 2] = direction.z;
        }
    }
}

// Transforms and normalizes a direction. Sets the bit `corner_bit` in `imprecise_corners` if the result lost too much
// precision.
__device__ __forceinline__ float3 transform_direction_f32(const Mat3f& m, float x, float y, float z, unsigned corner_bit,
                                                          unsigned& imprecise_corners) {
    const float3 v = make_float3(fmaf(m.row0.x, x, fmaf(m.row0.y, y, m.row0.z * z)),
                                 fmaf(m.row1.x, x, fmaf(m.row1.y, y, m.row1.z * z)),
                                 fmaf(m.row2.x, x, fmaf(m.row2.y, y, m.row2.z * z)));
    const float squared_length = fmaf(v.x, v.x, fmaf(v.y, v.y, v.z * v.z));
    // A NaN counts as short.
    imprecise_corners |= squared_length > MIN_SQUARED_LENGTH ? 0 : corner_bit;
    // The error of `rsqrtf` is at most two units in the last place.
    const float inverse_length = rsqrtf(squared_length);
    return make_float3(v.x * inverse_length, v.y * inverse_length, v.z * inverse_length);
}

// Rest normals of a lane's corners.
struct RestNormals {
    LaneItems x, y, z;
    __device__ __forceinline__ void load(const DeformArgs& args, const LaneSlice& slice) {
        x = load_items(args.rest_normals, slice, 3, 0);
        y = load_items(args.rest_normals, slice, 3, 1);
        z = load_items(args.rest_normals, slice, 3, 2);
    }
};

__device__ __forceinline__ void write_rigid_normals(const DeformArgs& args, OutputStaging& staging, const LaneSlice& slice,
                                                    const RestNormals& rest_normals, const Mat3f& matrix, unsigned first_corner) {
    float normals[FLOATS_PER_LANE];
    unsigned imprecise_corners = 0;
#pragma unroll
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        const unsigned corner_bit = i < slice.item_count ? 1u << i : 0;
        const float3 normal = transform_direction_f32(matrix, rest_normals.x.values[i], rest_normals.y.values[i],
                                                      rest_normals.z.values[i], corner_bit,
                                                      imprecise_corners);
        normals[3 * i] = normal.x;
        normals[3 * i + 1] = normal.y;
        normals[3 * i + 2] = normal.z;
    }
    stage_triples(staging, slice, first_corner, normals);
    if (imprecise_corners != 0) {
        retransform_directions_f64(transforms_of(args), slice.domain, item_pointer(args.rest_normals, slice, 3),
                                   4 * slice.component_stride, staged_floats(staging) + FLOATS_PER_LANE * lane_id(),
                                   imprecise_corners, 3);
    }
    store_staged_triples(args.header->normals, staging, slice);
}

#ifdef NORMAL_MAPS
__device__ __forceinline__ void write_rigid_tangents(const DeformArgs& args, OutputStaging& staging, const LaneSlice& slice,
                                                const Mat3f& matrix, float handedness) {
    const LaneItems x = load_items(args.rest_tangents, slice, 4, 0), y = load_items(args.rest_tangents, slice, 4, 1),
                z = load_items(args.rest_tangents, slice, 4, 2), bitangent_signs = load_items(args.rest_tangents, slice, 4, 3);
    unsigned imprecise_corners = 0;
#pragma unroll
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        // A shape without tangents has zeros, which remain zeros.
        const bool has_tangent = bitangent_signs.values[i] != 0.0f;
        const unsigned corner_bit = has_tangent ? 1u << i : 0;
        const float3 tangent = transform_direction_f32(matrix, x.values[i], y.values[i], z.values[i], corner_bit,
                                                       imprecise_corners);
        staging.vectors[ITEMS_PER_LANE * lane_id() + i] =
            has_tangent ? make_float4(tangent.x, tangent.y, tangent.z, bitangent_signs.values[i] * handedness)
                        : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
    if (imprecise_corners != 0) {
        retransform_directions_f64(transforms_of(args), slice.domain, item_pointer(args.rest_tangents, slice, 4),
                                   4 * slice.component_stride, staged_floats(staging) + 4 * ITEMS_PER_LANE * lane_id(),
                                   imprecise_corners, 4);
    }
    store_staged_quadruples(args.header->tangents, staging);
}
#endif

__device__ __forceinline__ void write_rigid_directions(const DeformArgs& args, OutputStaging& staging,
                                                       const LaneSlice& slice, const RestNormals& rest_normals) {
    unsigned first_corner = slice.first_item;
#ifdef CORNER_OFFSETS
    // In a tile with vertices, `first_item` is an index into the vertices of all domains. The offset of the domain
    // converts it to the index of the same corner in the corners of all domains.
    if (slice.kind & TILE_VERTICES) {
        first_corner += __ldg(args.corner_offsets + slice.domain);
    }
#endif
#ifdef SHEAR
    const Mat3d normal_transform = inverse_transpose(load_linear_part(transforms_of(args), slice.domain));
    write_rigid_normals(args, staging, slice, rest_normals, to_scaled_mat3f(normal_transform), first_corner);
#else
    write_rigid_normals(args, staging, slice, rest_normals, load_scaled_linear_part(transforms_of(args), slice.domain),
                        first_corner);
#endif
#ifdef NORMAL_MAPS
    const float handedness = (float)determinant_sign(load_linear_part(transforms_of(args), slice.domain));
    write_rigid_tangents(args, staging, slice, load_scaled_linear_part(transforms_of(args), slice.domain), handedness);
#endif
}
