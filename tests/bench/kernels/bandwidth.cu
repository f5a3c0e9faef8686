// Kernels that measure the memory rates of the device, and helpers for timing. None of them deforms anything.
//   fill     writes pseudo-random numbers                                                    `to`: [words] u32   (out)
//   copy     copies `from` to `to`; one copy reads and writes the bytes of the buffer
//   read     reads all of `from`; writes to `to` only if the AND of all words that a thread read is all ones, which
//            never happens with these buffers, but the compiler cannot know
//   hold     blocks the stream for a time
//   nothing  does nothing
// Launch of copy and read: BLOCK threads per block, LOADS words of 16 bytes per thread, one block per tile of BLOCK *
// LOADS words; buffers are whole tiles.
//
// CPU twins: the tests of tests/bench/src/kernels/bandwidth.rs.
#ifndef LOADS
#define LOADS 1
#endif

constexpr unsigned BLOCK = 256;

__device__ uint4 load(const uint4* from) {
#ifdef STREAMING
    return __ldcs(from);
#else
    return __ldg(from);
#endif
}

__device__ void store(uint4* to, uint4 word) {
#ifdef STREAMING
    __stcs(to, word);
#else
    *to = word;
#endif
}

// The first word of a thread; its other words follow at a distance of one block.
__device__ size_t first_word() {
    return (size_t)blockIdx.x * (BLOCK * LOADS) + threadIdx.x;
}

extern "C" __global__ void __launch_bounds__(BLOCK) copy(const uint4* from, uint4* to) {
    const size_t first = first_word();
    uint4 words[LOADS];
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        words[i] = load(from + first + i * BLOCK);
    }
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        store(to + first + i * BLOCK, words[i]);
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) read(const uint4* from, uint4* to) {
    const size_t first = first_word();
    uint4 words[LOADS];
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        words[i] = load(from + first + i * BLOCK);
    }
    unsigned all = 0xffffffffu;
#pragma unroll
    for (unsigned i = 0; i < LOADS; ++i) {
        all &= words[i].x & words[i].y & words[i].z & words[i].w;
    }
    if (all == 0xffffffffu) {
        to[first] = words[0];
    }
}

// The finalizer of MurmurHash3 with the top bit cleared, so that no word is all ones.
extern "C" __global__ void __launch_bounds__(BLOCK) fill(unsigned* to, unsigned long long words) {
    const size_t index = (size_t)blockIdx.x * BLOCK + threadIdx.x;
    if (index < words) {
        unsigned key = (unsigned)index;
        key ^= key >> 16;
        key *= 0x85ebca6bu;
        key ^= key >> 13;
        key *= 0xc2b2ae35u;
        key ^= key >> 16;
        to[index] = key & 0x7fffffffu;
    }
}

__device__ unsigned long long now() {
    unsigned long long nanoseconds;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(nanoseconds));
    return nanoseconds;
}

extern "C" __global__ void hold(unsigned long long nanoseconds) {
    const unsigned long long begin = now();
    while (now() - begin < nanoseconds) {
    }
}

extern "C" __global__ void nothing() {}
