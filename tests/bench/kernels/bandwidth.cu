// Bandwidth kernels and helpers for timing.
//   fill          writes pseudo-random words; one thread per word
//   copy          copies `src` to `dst`; its memory traffic is twice the size of a buffer
//   read          reads all of `src`. A store whose condition is never true keeps the compiler from removing the loads.
//   delay         occupies the stream for a number of nanoseconds; one thread
//   empty_kernel  does nothing; one thread
// Launch of copy and read: BLOCK threads per block, LOADS vectors (uint4) per thread. The number of vectors of a buffer
// is a multiple of BLOCK * LOADS. With STREAMING, loads and stores have evict-first cache hints. Without STREAMING,
// loads use the read-only cache.
//
// CPU twins: the tests of tests/bench/src/kernels/bandwidth.rs.
#ifndef LOADS
#define LOADS 1
#endif

constexpr unsigned BLOCK = 256;

__device__ uint4 load(const uint4* src) {
#ifdef STREAMING
    return __ldcs(src);
#else
    return __ldg(src);
#endif
}

__device__ void store(uint4* dst, uint4 vector) {
#ifdef STREAMING
    __stcs(dst, vector);
#else
    *dst = vector;
#endif
}

// Index of a thread's first vector. The vectors of a thread are BLOCK apart, so that each load of a warp is coalesced.
__device__ size_t first_vector() {
    return (size_t)blockIdx.x * (BLOCK * LOADS) + threadIdx.x;
}

extern "C" __global__ void __launch_bounds__(BLOCK) copy(const uint4* src, uint4* dst) {
    const size_t first = first_vector();
    uint4 vectors[LOADS];
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        vectors[i] = load(src + first + i * BLOCK);
    }
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        store(dst + first + i * BLOCK, vectors[i]);
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) read(const uint4* src, uint4* dst) {
    const size_t first = first_vector();
    uint4 vectors[LOADS];
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        vectors[i] = load(src + first + i * BLOCK);
    }
    unsigned and_of_words = 0xffffffffu;
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        and_of_words &= vectors[i].x & vectors[i].y & vectors[i].z & vectors[i].w;
    }
    if (and_of_words == 0xffffffffu) {
        dst[first] = vectors[0];
    }
}

// The value of a word is a hash of its index: the finalizer of MurmurHash3. The top bit is cleared. No word is then all
// ones, so the store in `read` never executes.
extern "C" __global__ void __launch_bounds__(BLOCK) fill(unsigned* dst, unsigned long long words) {
    const size_t index = (size_t)blockIdx.x * BLOCK + threadIdx.x;
    if (index < words) {
        unsigned key = (unsigned)index;
        key ^= key >> 16;
        key *= 0x85ebca6bu;
        key ^= key >> 13;
        key *= 0xc2b2ae35u;
        key ^= key >> 16;
        dst[index] = key & 0x7fffffffu;
    }
}

__device__ unsigned long long globaltimer_ns() {
    unsigned long long nanoseconds;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(nanoseconds));
    return nanoseconds;
}

extern "C" __global__ void delay(unsigned long long nanoseconds) {
    const unsigned long long begin = globaltimer_ns();
    while (globaltimer_ns() - begin < nanoseconds) {
    }
}

extern "C" __global__ void empty_kernel() {}
