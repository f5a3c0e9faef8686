// Transformation of directions by the linear part A of a transform T: normals by the inverse transpose of A, tangents
// by A. Without SHEAR, the linear part of every T is a rotation or reflection times a uniform scale, which transforms
// normals like tangents. deform.cu describes the macros.
//
// A is computed in f64, because its cofactors and determinant lose precision to cancellation if A is nearly singular.
// The sign of the determinant decides which side a surface faces. Products of two f32 are exact in f64, and every other
// operation is rounded as in the CPU twin (no fused multiply-add). The determinant thus has the sign that the twin
// computes, and is zero for the same inputs. No intermediate value overflows or underflows. For a follower (a domain
// whose T depends on another domain), A is the product of two matrices, also computed in f64. CPU twin:
// src/compute/reference/rigid_normals.rs.
#pragma once
#include "transform.cuh"

struct Mat3d {
    double3 row0, row1, row2;
};

// a d - b c
__device__ inline double minor2x2(double a, double b, double c, double d) {
    return __dsub_rn(__dmul_rn(a, d), __dmul_rn(b, c));
}

__device__ inline double dot(const double3& row, const double3& v) {
    return __dadd_rn(__dadd_rn(__dmul_rn(row.x, v.x), __dmul_rn(row.y, v.y)), __dmul_rn(row.z, v.z));
}

__device__ inline double3 linear_part_of_row(const float4& row) {
    return make_double3(row.x, row.y, row.z);
}

#ifdef FOLLOWERS
// A row of T times the linear part of the frame F, the follower's constant transform relative to its root.
__device__ inline double3 multiply_linear_row(const float4& row, const Affine& f) {
    const double3 t = linear_part_of_row(row);
    return make_double3(dot(t, make_double3(f.row0.x, f.row1.x, f.row2.x)), dot(t, make_double3(f.row0.y, f.row1.y, f.row2.y)),
                        dot(t, make_double3(f.row0.z, f.row1.z, f.row2.z)));
}
#endif

// The linear part of T of a domain.
__device__ inline Mat3d load_linear_part(const Transforms& transforms, unsigned domain) {
#ifdef FOLLOWERS
    const TransformLink link = load_transform_link(transforms, domain);
    const Affine t = load_affine(transforms.rows, link.root);
    if (link.frame != NO_FRAME) {
        const Affine f = load_affine(transforms.follower_frames, link.frame);
        return {multiply_linear_row(t.row0, f), multiply_linear_row(t.row1, f), multiply_linear_row(t.row2, f)};
    }
#else
    const Affine t = load_affine(transforms.rows, domain);
#endif
    return {linear_part_of_row(t.row0), linear_part_of_row(t.row1), linear_part_of_row(t.row2)};
}

// Sign of the determinant: +1 for positive values and +0, -1 for negative values and -0, as in the CPU twin.
__device__ inline double determinant_sign(const Mat3d& m) {
    const double term_x = __dmul_rn(m.row0.x, minor2x2(m.row1.y, m.row1.z, m.row2.y, m.row2.z));
    const double term_y = __dmul_rn(m.row0.y, minor2x2(m.row1.x, m.row1.z, m.row2.x, m.row2.z));
    const double term_z = __dmul_rn(m.row0.z, minor2x2(m.row1.x, m.row1.y, m.row2.x, m.row2.y));
    return copysign(1.0, __dadd_rn(__dsub_rn(term_x, term_y), term_z));
}

// v / |v|, or +Z if v is zero. v is first multiplied by the power of two that brings its largest component into [1, 2).
// This rounds nothing. A number with the exponent bits e is at least 2^(e - 1023), so the power of two has the exponent
// bits 1023 - (e - 1023) = 2046 - e.
__device__ inline float3 normalize(const double3& v) {
    const double max_component = fmax(fmax(fabs(v.x), fabs(v.y)), fabs(v.z));
    if (!(max_component > 0.0)) {
        return make_float3(0.0f, 0.0f, 1.0f);
    }
    const int exponent = (__double2hiint(max_component) >> 20) & 0x7ff;
    const double scale = __hiloint2double((2046 - exponent) << 20, 0);
    const float x = (float)(v.x * scale), y = (float)(v.y * scale), z = (float)(v.z * scale);
    const float inverse_length = 1.0f / sqrtf(fmaf(x, x, fmaf(y, y, z * z)));
    return make_float3(x * inverse_length, y * inverse_length, z * inverse_length);
}

__device__ inline double3 multiply(const Mat3d& m, const double3& v) {
    return make_double3(dot(m.row0, v), dot(m.row1, v), dot(m.row2, v));
}

__device__ inline float3 transform_direction(const Mat3d& m, const double3& v) {
    return normalize(multiply(m, v));
}

#ifdef SHEAR
// The cross product times `sign`.
__device__ inline double3 signed_cross(const double3& v, const double3& w, double sign) {
    return make_double3(sign * minor2x2(v.y, v.z, w.y, w.z), sign * minor2x2(v.z, v.x, w.z, w.x),
                        sign * minor2x2(v.x, v.y, w.x, w.y));
}

// The cofactors of A times `sign`.
__device__ inline Mat3d signed_cofactors(const Mat3d& m, double sign) {
    return {signed_cross(m.row1, m.row2, sign), signed_cross(m.row2, m.row0, sign), signed_cross(m.row0, m.row1, sign)};
}

// The inverse transpose times a positive number: the cofactors times the sign of the determinant.
__device__ inline Mat3d inverse_transpose(const Mat3d& m) {
    return signed_cofactors(m, determinant_sign(m));
}

__device__ inline float3 transform_normal(const Mat3d& m, const double3& normal) {
    return transform_direction(inverse_transpose(m), normal);
}
#else
__device__ inline float3 transform_normal(const Mat3d& m, const double3& normal) {
    return transform_direction(m, normal);
}
#endif
