// Rigid normals and tangents of a tile: those at rest, rotated by T alone (equation 3.8 of the thesis; normals by the
// inverse transpose of A, tangents by A; a reflection flips the sign of the bitangent). CPU twin:
// src/compute/reference/rigid_normals.rs.
//
// A lane's matrix is scaled by a power of two so that its entries are about 1. If a transformed direction is shorter
// than a tenth, it has lost precision in f32 and is computed again in f64.
#pragma once
#include "warp_tile.cuh"
#include "direction.cuh"

// A direction whose squared length is at most this was transformed with too much cancellation.
constexpr float MIN_SQUARED_LENGTH = 0.01f;

struct Mat3f {
    float3 a, b, c;
};

// A power of two that scales a number to [1, 2), or as near as f32 allows.
__device__ __forceinline__ float scale_of(float largest) {
    const unsigned exponent = __float_as_uint(largest) >> 23;
    return __uint_as_float(max(254 - (int)exponent, 1) << 23);
}

__device__ __forceinline__ float largest_of(float a, float b, float c) {
    return fmaxf(fmaxf(fabsf(a), fabsf(b)), fabsf(c));
}

// The linear part of a transform, scaled so that its largest entry is about 1; a power of two rounds nothing.
__device__ __forceinline__ Mat3f scaled(const Affine& t) {
    const float4 a = t.a, b = t.b, c = t.c;
    const float largest = fmaxf(fmaxf(largest_of(a.x, a.y, a.z), largest_of(b.x, b.y, b.z)), largest_of(c.x, c.y, c.z));
    const float scale = scale_of(largest);
    return {make_float3(a.x * scale, a.y * scale, a.z * scale), make_float3(b.x * scale, b.y * scale, b.z * scale),
            make_float3(c.x * scale, c.y * scale, c.z * scale)};
}

#ifdef FOLLOWERS
__device__ __forceinline__ float4 compose_linear_row(const float3& t, const Mat3f& f) {
    return make_float4(fmaf(t.x, f.a.x, fmaf(t.y, f.b.x, t.z * f.c.x)), fmaf(t.x, f.a.y, fmaf(t.y, f.b.y, t.z * f.c.y)),
                       fmaf(t.x, f.a.z, fmaf(t.y, f.b.z, t.z * f.c.z)), 0.0f);
}
#endif

// The scaled matrix of a domain. Both factors of a follower's matrix are scaled before the product, to avoid overflow.
__device__ __forceinline__ Mat3f scaled_linear_part(const Transforms& transforms, unsigned domain) {
#ifdef FOLLOWERS
    const TransformLink own = load_transform_link(transforms, domain);
    const Mat3f t = scaled(load_affine(transforms.rows, own.root));
    if (own.frame == NO_FRAME) {
        return t;
    }
    const Mat3f f = scaled(load_affine(transforms.frames, own.frame));
    return scaled(Affine{compose_linear_row(t.a, f), compose_linear_row(t.b, f), compose_linear_row(t.c, f)});
#else
    return scaled(load_affine(transforms.rows, domain));
#endif
}

#ifdef SHEAR
// The matrix scaled by a power of two so that its largest entry is in [1, 2), rounded once.
__device__ __forceinline__ Mat3f scaled_to_f32(const Mat3d& m) {
    const double row_a = fmax(fmax(fabs(m.a.x), fabs(m.a.y)), fabs(m.a.z));
    const double row_b = fmax(fmax(fabs(m.b.x), fabs(m.b.y)), fabs(m.b.z));
    const double row_c = fmax(fmax(fabs(m.c.x), fabs(m.c.y)), fabs(m.c.z));
    const double largest = fmax(fmax(row_a, row_b), row_c);
    const int exponent = (__double2hiint(largest) >> 20) & 0x7ff;
    const double scale = largest > 0.0 ? __hiloint2double((2046 - exponent) << 20, 0) : 0.0;
    return {make_float3(m.a.x * scale, m.a.y * scale, m.a.z * scale),
            make_float3(m.b.x * scale, m.b.y * scale, m.b.z * scale),
            make_float3(m.c.x * scale, m.c.y * scale, m.c.z * scale)};
}

__device__ __forceinline__ Mat3d signed_cofactors(const Mat3d& m) {
    const double hand = determinant_sign(m);
    return {cross(m.b, m.c, hand), cross(m.c, m.a, hand), cross(m.a, m.b, hand)};
}
#endif


// Transforms the directions whose bits are set again in f64: normals of three components, tangents of four. Only those,
// so that the bits of a corner do not depend on the other corners of its lane. `from` is the first component of the
// first direction, `row` leads from its x to its y; `to` is staged.
__device__ __noinline__ void retransform_directions_f64(Transforms transforms, unsigned domain, const float* from, unsigned row,
                                        float* to, unsigned set, unsigned numbers) {
    const Mat3d m = linear_part(transforms, domain);
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        if (set >> i & 1) {
            const double3 v = make_double3(from[i], from[row + i], from[2 * row + i]);
            const float3 direction = numbers == 3 ? transform_normal(m, v) : transform_direction(m, v);
            to[numbers * i] = direction.x;
            to[numbers * i + 1] = direction.y;
            to[numbers * i + 2] = direction.z;
        }
    }
}

// A direction, transformed and normalized. Sets `bit` in `set` when the transformation cancelled too much.
__device__ __forceinline__ float3 transform_direction_f32(const Mat3f& m, float x, float y, float z, unsigned bit, unsigned& set) {
    const float3 v = make_float3(fmaf(m.a.x, x, fmaf(m.a.y, y, m.a.z * z)), fmaf(m.b.x, x, fmaf(m.b.y, y, m.b.z * z)),
                                 fmaf(m.c.x, x, fmaf(m.c.y, y, m.c.z * z)));
    const float square = fmaf(v.x, v.x, fmaf(v.y, v.y, v.z * v.z));
    // A NaN counts as short.
    set |= square > MIN_SQUARED_LENGTH ? 0 : bit;
    // Accurate to two units in the last place.
    const float inverse = rsqrtf(square);
    return make_float3(v.x * inverse, v.y * inverse, v.z * inverse);
}

// Rest normals of a lane's corners.
struct Normals {
    LaneItems x, y, z;
    __device__ __forceinline__ void load(const DeformArgs& args, const LaneSlice& part) {
        x = load_items(args.rest_normals, part, 3, 0);
        y = load_items(args.rest_normals, part, 3, 1);
        z = load_items(args.rest_normals, part, 3, 2);
    }
};

__device__ __forceinline__ void write_rigid_normals(const DeformArgs& args, OutputStage& stage, const LaneSlice& part,
                                               const Normals& rest, const Mat3f& matrix, unsigned corner) {
    float normals[FLOATS_PER_LANE];
    unsigned set = 0;
#pragma unroll
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        const unsigned bit = i < part.count ? 1u << i : 0;
        const float3 normal = transform_direction_f32(matrix, rest.x.values[i], rest.y.values[i], rest.z.values[i], bit, set);
        normals[3 * i] = normal.x;
        normals[3 * i + 1] = normal.y;
        normals[3 * i + 2] = normal.z;
    }
    stage_triples(stage, part, corner, normals);
    if (set != 0) {
        retransform_directions_f64(transforms_of(args), part.domain, item_pointer(args.rest_normals, part, 3), 4 * part.stride,
                   stage_data(stage) + FLOATS_PER_LANE * lane_id(), set, 3);
    }
    store_stage(args.header->normals, stage, part);
}

#ifdef NORMAL_MAPS
__device__ __forceinline__ void write_rigid_tangents(const DeformArgs& args, OutputStage& stage, const LaneSlice& part,
                                                const Mat3f& matrix, float hand) {
    const LaneItems x = load_items(args.rest_tangents, part, 4, 0), y = load_items(args.rest_tangents, part, 4, 1),
                z = load_items(args.rest_tangents, part, 4, 2), sign = load_items(args.rest_tangents, part, 4, 3);
    unsigned set = 0;
#pragma unroll
    for (unsigned i = 0; i < ITEMS_PER_LANE; ++i) {
        // A shape without tangents has zeros, which remain zeros.
        const bool is_there = sign.values[i] != 0.0f;
        const unsigned bit = is_there ? 1u << i : 0;
        const float3 tangent = transform_direction_f32(matrix, x.values[i], y.values[i], z.values[i], bit, set);
        stage.numbers[ITEMS_PER_LANE * lane_id() + i] = is_there
                                                  ? make_float4(tangent.x, tangent.y, tangent.z, sign.values[i] * hand)
                                                  : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
    if (set != 0) {
        retransform_directions_f64(transforms_of(args), part.domain, item_pointer(args.rest_tangents, part, 4), 4 * part.stride,
                   stage_data(stage) + 4 * ITEMS_PER_LANE * lane_id(), set, 4);
    }
    store_quadruples(args.header->tangents, stage);
}
#endif

__device__ __forceinline__ void rigid_normals(const DeformArgs& args, OutputStage& stage, const LaneSlice& part, const Normals& rest) {
    unsigned corner = part.item;
#ifdef CORNER_OFFSETS
    if (part.kind & TILE_VERTICES) {
        corner += __ldg(args.corner_offsets + part.domain);
    }
#endif
#ifdef SHEAR
    write_rigid_normals(args, stage, part, rest, scaled_to_f32(signed_cofactors(linear_part(transforms_of(args), part.domain))), corner);
#else
    write_rigid_normals(args, stage, part, rest, scaled_linear_part(transforms_of(args), part.domain), corner);
#endif
#ifdef NORMAL_MAPS
    const float hand = (float)determinant_sign(linear_part(transforms_of(args), part.domain));
    write_rigid_tangents(args, stage, part, scaled_linear_part(transforms_of(args), part.domain), hand);
#endif
}
