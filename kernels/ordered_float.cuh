// Order-preserving integer keys of floats, so that integer maxima give float maxima. Twin:
// src/compute/gpu/tables/box_keys.rs.
#pragma once

// The key of x, which must not be NaN: the bits of x with the sign bit inverted, or with all bits inverted if x is
// negative. Keys increase with x and are never 0.
__device__ inline unsigned non_nan_to_ordered(float x) {
    const unsigned bits = __float_as_uint(x);
    return bits ^ (unsigned)((int)bits >> 31 | (int)0x80000000u);
}

// The key of any x. A NaN has the largest key, so a maximum with a NaN is NaN.
__device__ inline unsigned float_to_ordered(float x) {
    return x != x ? 0xffffffffu : non_nan_to_ordered(x);
}

// The inverse of `float_to_ordered`. Key 0, which no number has, gives NaN.
__device__ inline float ordered_to_float(unsigned key) {
    return __uint_as_float(key >> 31 ? key & 0x7fffffffu : ~key);
}

// The maximum of two numbers, where 0 exceeds -0; NaN if one of them is NaN.
__device__ inline float max_or_nan(float a, float b) {
#if __CUDA_ARCH__ >= 800
    float maximum;
    asm("max.NaN.f32 %0, %1, %2;" : "=f"(maximum) : "f"(a), "f"(b));
    return maximum;
#else
    return a != a ? a : b != b ? b : fmaxf(a, b);
#endif
}

// The maximum of `key` over the lanes of the warp. All lanes must call this function.
__device__ inline unsigned warp_max(unsigned key) {
#if __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, key);
#else
    for (int offset = 16; offset > 0; offset /= 2) {
        key = max(key, __shfl_xor_sync(0xffffffffu, key, offset));
    }
    return key;
#endif
}

// Reduces the six keys of a box (the maxima of -x, -y, -z, x, y, z) to their maxima over the warp. Lane i returns the
// maximum of keys[i % 6].
__device__ inline unsigned reduce_box_keys(const unsigned (&keys)[6]) {
    const unsigned side = threadIdx.x % 32 % 6;
    unsigned lane_key = 0;
#pragma unroll
    for (unsigned i = 0; i < 6; ++i) {
        const unsigned key = warp_max(keys[i]);
        lane_key = side == i ? key : lane_key;
    }
    return lane_key;
}
