// Maxima of floats as maxima of integers. Twin: src/gpu/bounds.rs.
#pragma once

// An integer that grows with x and is never 0; of a NaN it is the largest, so that a NaN wins every maximum.
__device__ inline unsigned ordered(float x) {
    const unsigned bits = __float_as_uint(x);
    if (x != x) {
        return 0xffffffffu;
    }
    return bits & 0x80000000u ? ~bits : bits | 0x80000000u;
}

__device__ inline unsigned warp_max(unsigned key) {
#if __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, key);
#else
    for (int lanes = 16; lanes > 0; lanes /= 2) {
        key = max(key, __shfl_xor_sync(0xffffffffu, key, lanes));
    }
    return key;
#endif
}
