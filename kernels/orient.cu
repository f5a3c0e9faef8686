// Unit normals by the inverse transpose of A, unit tangents by A, for every corner of every domain, in one launch.
//   rest_normals   [3][rest_corners] f32, one plane per axis                                            (in)
//   rest_tangents  [..] float4: unit tangent, sign of the bitangent; read only with NORMAL_MAPS         (in)
//   transforms     [domains][3] float4: the rows of world_from_domain; A is their first three columns  (in)
//   normals        [corners][3] f32, world; in the header                                               (out)
//   tangents       [corners] float4, world; zeros where a shape has none; only with NORMAL_MAPS         (out)
// Without SHEAR every A is a rotation or reflection times one scale, which turns normals as it turns tangents.
// Launch: BLOCK threads a block, a thread a packed corner, ceil(corners / BLOCK) blocks, whichever domains they meet.
// A block whose domains have not changed since this output was written is passed over.
// CPU twin: src/reference/orient.rs.
//
// A is handled in f64: cofactors and determinant of a nearly singular A cancel, and the sign of the determinant decides
// which way a surface faces. Products of two f32 are exact in f64, and every other step is rounded as the twin rounds
// it (no fused multiply-add), so that what vanishes there vanishes here. Nothing over- or underflows.
#include "layout.cuh"

struct Rows {
    double3 a, b, c;
};

__device__ Rows linear_of(const float4* transforms, unsigned domain) {
    const float4* rows = transforms + 3 * (size_t)domain;
    const float4 a = __ldg(rows), b = __ldg(rows + 1), c = __ldg(rows + 2);
    return {make_double3(a.x, a.y, a.z), make_double3(b.x, b.y, b.z), make_double3(c.x, c.y, c.z)};
}

__device__ double minor_of(double a, double b, double c, double d) {
    return __dsub_rn(__dmul_rn(a, d), __dmul_rn(b, c));
}

__device__ double dot(const double3& row, const double3& v) {
    return __dadd_rn(__dadd_rn(__dmul_rn(row.x, v.x), __dmul_rn(row.y, v.y)), __dmul_rn(row.z, v.z));
}

// +1 or -1; of a zero determinant its sign bit decides, as in the twin.
__device__ double hand_of(const Rows& m) {
    const double first = __dmul_rn(m.a.x, minor_of(m.b.y, m.b.z, m.c.y, m.c.z));
    const double second = __dmul_rn(m.a.y, minor_of(m.b.x, m.b.z, m.c.x, m.c.z));
    const double third = __dmul_rn(m.a.z, minor_of(m.b.x, m.b.y, m.c.x, m.c.y));
    return copysign(1.0, __dadd_rn(__dsub_rn(first, second), third));
}

// v over its length, +Z when v is zero. A power of two brings the largest component to [1, 2) first, without rounding.
__device__ float3 unit(const double3& v) {
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

__device__ float3 turn(const Rows& m, const double3& v) {
    return unit(make_double3(dot(m.a, v), dot(m.b, v), dot(m.c, v)));
}

#ifdef SHEAR
__device__ double3 cross(const double3& v, const double3& w, double hand) {
    return make_double3(hand * minor_of(v.y, v.z, w.y, w.z), hand * minor_of(v.z, v.x, w.z, w.x),
                        hand * minor_of(v.x, v.y, w.x, w.y));
}

// The inverse transpose is the cofactor matrix over the determinant; only its sign survives normalising.
__device__ float3 turn_normal(const Rows& m, const double3& normal) {
    const double hand = hand_of(m);
    return turn({cross(m.b, m.c, hand), cross(m.c, m.a, hand), cross(m.a, m.b, hand)}, normal);
}
#else
__device__ float3 turn_normal(const Rows& m, const double3& normal) {
    return turn(m, normal);
}
#endif

extern "C" __global__ void __launch_bounds__(BLOCK) orient(const __grid_constant__ OrientArgs args) {
    __shared__ float staged[3 * BLOCK];
    const unsigned corner = blockIdx.x * BLOCK + threadIdx.x;
    const unsigned domain = domain_of(args.slots, args.first_domains, min(corner, args.corners - 1));
    if (!__syncthreads_or(is_stale(args.header, args.stamps, domain))) {
        return;
    }
    if (corner < args.corners) {
        const CornerSlot slot = args.slots[domain];
        const Rows linear = linear_of(args.transforms, domain);
        const float* rest = args.rest_normals + slot.first_normal + (corner - slot.first);
        const size_t plane = args.rest_corners;
        const float3 normal =
            turn_normal(linear, make_double3(__ldg(rest), __ldg(rest + plane), __ldg(rest + 2 * plane)));
        staged[3 * threadIdx.x] = normal.x;
        staged[3 * threadIdx.x + 1] = normal.y;
        staged[3 * threadIdx.x + 2] = normal.z;
#ifdef NORMAL_MAPS
        float4 world = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (slot.first_tangent != NO_TANGENTS) {
            const float4 tangent = __ldg(args.rest_tangents + slot.first_tangent + (corner - slot.first));
            const float3 along = turn(linear, make_double3(tangent.x, tangent.y, tangent.z));
            world = make_float4(along.x, along.y, along.z, tangent.w * (float)hand_of(linear));
        }
        args.header->tangents[corner] = world;
#endif
    }
    __syncthreads();
    store_triples(args.header->normals, staged, args.corners);
}
