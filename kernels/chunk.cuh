// Storage format of U: a chunk of 48 bytes, three words of 16 bytes, holds the entries of one quad (4 vertices) for as
// many modes as fit. Entry e = (mode * 3 + axis) * 4 + vertex. Twin: src/compute/storage.
#pragma once

#if defined(STORE_F16) || defined(STORE_BF16)
constexpr unsigned CHUNK_MODES = 2;
#elif defined(STORE_INT8)
constexpr unsigned CHUNK_MODES = 4;
#else
constexpr unsigned CHUNK_MODES = 1;
#endif
constexpr unsigned ENTRY_BYTES = 4 / CHUNK_MODES;

// Decodes the entry in the lowest bits of `bits`, without the factor or scale of its mode.
__device__ __forceinline__ float decode_bits(unsigned bits) {
#if defined(STORE_F16)
    float number;
    asm("{ .reg .b16 low, high; mov.b32 {low, high}, %1; cvt.f32.f16 %0, low; }" : "=f"(number) : "r"(bits));
    return number;
#elif defined(STORE_BF16)
    return __uint_as_float(bits << 16);
#elif defined(STORE_INT8)
    // The byte is placed in the mantissa of 2^23, which gives 2^23 + byte; the entry is byte - 128. Both steps are exact.
    return __uint_as_float(__byte_perm(bits, 0x4b000000u, 0x7650u)) - 8388736.0f;
#else
    return __uint_as_float(bits);
#endif
}

// Entry `entry` of a chunk whose twelve words are in registers; `entry` is a compile-time constant.
__device__ __forceinline__ float decode_entry(const unsigned (&words)[12], unsigned entry) {
    const unsigned word = words[entry / CHUNK_MODES];
#if defined(STORE_INT8)
    return __uint_as_float(__byte_perm(word, 0x4b000000u, 0x7650u | entry % 4)) - 8388736.0f;
#else
    return decode_bits(entry % CHUNK_MODES == 0 ? word : word >> 16);
#endif
}

// Loads the single entry (mode, axis) of vertex `vertex` of a chunk. `words` is the quad's first word of 16 bytes, and
// `stride` leads from one word of the quad to the next.
__device__ __forceinline__ float load_entry(const uint4* words, unsigned stride, unsigned mode, unsigned axis,
                                          unsigned vertex) {
    const unsigned byte = ((mode * 3 + axis) * 4) * ENTRY_BYTES;
    const char* word = (const char*)(words + (size_t)(byte / 16) * stride) + byte % 16 + vertex * ENTRY_BYTES;
#if defined(STORE_F16) || defined(STORE_BF16)
    return decode_bits(__ldcs((const unsigned short*)word));
#elif defined(STORE_INT8)
    return decode_bits(__ldcs((const unsigned char*)word));
#else
    return __ldcs((const float*)word);
#endif
}
