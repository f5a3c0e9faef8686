// x = T (x0 + U q) for every vertex of every domain of a scene, and the bounds of all x, in one launch.
//   columns     per shape [1 + r][3][stride] f32: x0, then the columns of U, one plane per axis         (in)
//   transforms  [domains][3] float4: the rows of world_from_domain, relative to the scene's origin      (in)
//   q           [coordinates] f32, packed; read only with MODES                                         (in)
//   positions   [vertices][3] f32: world, scene units, relative to the scene's origin                   (out)
//   bounds      [6] u32: `ordered` maxima of -x, -y, -z, x, y, z; zero before the launch                (in, out)
// Launch: BLOCK threads a block, a thread a packed vertex, ceil(vertices / BLOCK) blocks, whichever domains they meet.
// CPU twin: src/reference/deform.rs.
#include "layout.cuh"

// An integer that grows with x and is never 0; of a NaN it is the largest, so that a NaN wins every maximum.
__device__ unsigned ordered(float x) {
    const unsigned bits = __float_as_uint(x);
    if (x != x) {
        return 0xffffffffu;
    }
    return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

__device__ unsigned warp_max(unsigned key) {
#if __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, key);
#else
    for (int lanes = 16; lanes > 0; lanes /= 2) {
        key = max(key, __shfl_xor_sync(0xffffffffu, key, lanes));
    }
    return key;
#endif
}

// The modes of a vertex are summed in the order of the columns, whatever the block: runs agree bit by bit. The sum
// begins at +0 and so stays +0 where the rows of U are zero.
__device__ float3 position_of(const DeformArgs& args, unsigned vertex) {
    const unsigned domain = domain_of(args.slots, args.first_domains, vertex);
    const VertexSlot slot = args.slots[domain];
    const float* entry = args.columns + slot.first_entry + (vertex - slot.first);
    float3 bent = make_float3(__ldg(entry), __ldg(entry + slot.stride), __ldg(entry + 2 * (size_t)slot.stride));
#ifdef MODES
    if (slot.rank > 0) {
        const size_t stride = slot.stride;
        const float* q = args.q + slot.first_q;
        float3 u = make_float3(0.0f, 0.0f, 0.0f);
#pragma unroll 4
        for (unsigned mode = 0; mode < slot.rank; ++mode) {
            entry += 3 * stride;
            const float amount = __ldg(q + mode);
            u.x = fmaf(__ldg(entry), amount, u.x);
            u.y = fmaf(__ldg(entry + stride), amount, u.y);
            u.z = fmaf(__ldg(entry + 2 * stride), amount, u.z);
        }
        bent.x += u.x;
        bent.y += u.y;
        bent.z += u.z;
    }
#endif
    const float4* rows = args.transforms + 3 * (size_t)domain;
    const float4 a = __ldg(rows), b = __ldg(rows + 1), c = __ldg(rows + 2);
    return make_float3(fmaf(a.x, bent.x, fmaf(a.y, bent.y, fmaf(a.z, bent.z, a.w))),
                       fmaf(b.x, bent.x, fmaf(b.y, bent.y, fmaf(b.z, bent.z, b.w))),
                       fmaf(c.x, bent.x, fmaf(c.y, bent.y, fmaf(c.z, bent.z, c.w))));
}

extern "C" __global__ void __launch_bounds__(BLOCK) deform(const DeformArgs args) {
    __shared__ float staged[3 * BLOCK];
    __shared__ unsigned reach[6];
    const unsigned vertex = blockIdx.x * BLOCK + threadIdx.x;
    if (threadIdx.x < 6) {
        reach[threadIdx.x] = 0;
    }
    __syncthreads();
    unsigned keys[6] = {0, 0, 0, 0, 0, 0};
    if (vertex < args.vertices) {
        const float3 x = position_of(args, vertex);
        const float coordinates[3] = {x.x, x.y, x.z};
        for (unsigned axis = 0; axis < 3; ++axis) {
            staged[3 * threadIdx.x + axis] = coordinates[axis];
            keys[axis] = ordered(-coordinates[axis]);
            keys[3 + axis] = ordered(coordinates[axis]);
        }
    }
    for (unsigned side = 0; side < 6; ++side) {
        const unsigned key = warp_max(keys[side]);
        if (threadIdx.x % 32 == 0) {
            atomicMax(&reach[side], key);
        }
    }
    __syncthreads();
    store_triples(args.positions, staged, args.vertices);
    // Most blocks lie inside what others have reported: looking first keeps them from queueing at six addresses. The
    // value read may be old, but it only grows, so no maximum is lost.
    if (threadIdx.x < 6) {
        const unsigned key = reach[threadIdx.x];
        if (key > *(volatile unsigned*)(args.bounds + threadIdx.x)) {
            atomicMax(args.bounds + threadIdx.x, key);
        }
    }
}
