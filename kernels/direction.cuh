// Transformation of directions by the linear part A of a transform: normals by the inverse transpose, tangents by A.
// Without SHEAR every A is a rotation or reflection times a uniform scale, which transforms normals like tangents.
//
// A is computed in f64: cofactors and determinant of a nearly singular A cancel, and the sign of the determinant
// decides which side a surface faces. Products of two f32 are exact in f64, and every other step is rounded as in the
// CPU twin (no fused multiply-add), so both give zero for the same inputs. No intermediate over- or underflows. The A of a
// follower is a product of two matrices, also in f64.
#pragma once
#include "transform.cuh"

struct Mat3d {
    double3 a, b, c;
};

__device__ inline double minor2x2(double a, double b, double c, double d) {
    return __dsub_rn(__dmul_rn(a, d), __dmul_rn(b, c));
}

__device__ inline double dot(const double3& row, const double3& v) {
    return __dadd_rn(__dadd_rn(__dmul_rn(row.x, v.x), __dmul_rn(row.y, v.y)), __dmul_rn(row.z, v.z));
}

__device__ inline double3 linear_row(const float4& row) {
    return make_double3(row.x, row.y, row.z);
}

#ifdef FOLLOWERS
__device__ inline double3 linear_row(const float4& row, const Affine& f) {
    const double3 t = linear_row(row);
    return make_double3(dot(t, make_double3(f.a.x, f.b.x, f.c.x)), dot(t, make_double3(f.a.y, f.b.y, f.c.y)),
                        dot(t, make_double3(f.a.z, f.b.z, f.c.z)));
}
#endif

__device__ inline Mat3d linear_part(const Transforms& transforms, unsigned domain) {
#ifdef FOLLOWERS
    const TransformLink link = load_transform_link(transforms, domain);
    const Affine t = load_affine(transforms.rows, link.root);
    if (link.frame != NO_FRAME) {
        const Affine f = load_affine(transforms.frames, link.frame);
        return {linear_row(t.a, f), linear_row(t.b, f), linear_row(t.c, f)};
    }
#else
    const Affine t = load_affine(transforms.rows, domain);
#endif
    return {linear_row(t.a), linear_row(t.b), linear_row(t.c)};
}

// Sign of the determinant, +1 or -1. A zero determinant gives its sign bit, as in the CPU twin.
__device__ inline double determinant_sign(const Mat3d& m) {
    const double first = __dmul_rn(m.a.x, minor2x2(m.b.y, m.b.z, m.c.y, m.c.z));
    const double second = __dmul_rn(m.a.y, minor2x2(m.b.x, m.b.z, m.c.x, m.c.z));
    const double third = __dmul_rn(m.a.z, minor2x2(m.b.x, m.b.y, m.c.x, m.c.y));
    return copysign(1.0, __dadd_rn(__dsub_rn(first, second), third));
}

// v / |v|, or +Z if v is zero. v is first scaled by a power of two, without rounding, so that its largest component is in
// [1, 2).
__device__ inline float3 normalize(const double3& v) {
    const double largest = fmax(fmax(fabs(v.x), fabs(v.y)), fabs(v.z));
    if (!(largest > 0.0)) {
        return make_float3(0.0f, 0.0f, 1.0f);
    }
    const int exponent = (__double2hiint(largest) >> 20) & 0x7ff;
    const double scale = __hiloint2double((2046 - exponent) << 20, 0);
    const float x = (float)(v.x * scale), y = (float)(v.y * scale), z = (float)(v.z * scale);
    const float inverse = 1.0f / sqrtf(fmaf(x, x, fmaf(y, y, z * z)));
    return make_float3(x * inverse, y * inverse, z * inverse);
}

__device__ inline float3 transform_direction(const Mat3d& m, const double3& v) {
    return normalize(make_double3(dot(m.a, v), dot(m.b, v), dot(m.c, v)));
}

#ifdef SHEAR
// The cross product times `sign`.
__device__ inline double3 cross(const double3& v, const double3& w, double sign) {
    return make_double3(sign * minor2x2(v.y, v.z, w.y, w.z), sign * minor2x2(v.z, v.x, w.z, w.x),
                        sign * minor2x2(v.x, v.y, w.x, w.y));
}

// The inverse transpose is the cofactor matrix over the determinant; only the determinant's sign survives
// normalization.
__device__ inline float3 transform_normal(const Mat3d& m, const double3& normal) {
    const double sign = determinant_sign(m);
    return transform_direction({cross(m.b, m.c, sign), cross(m.c, m.a, sign), cross(m.a, m.b, sign)}, normal);
}
#else
__device__ inline float3 transform_normal(const Mat3d& m, const double3& normal) {
    return transform_direction(m, normal);
}
#endif
