// Storage format of U. A chunk is CHUNK_MODES consecutive modes. Its entries for one quad (four vertices) take 48
// bytes: three words of 16 bytes. Entry (mode, axis, vertex) has the index (mode * 3 + axis) * 4 + vertex in the 48
// bytes. Twin: src/compute/storage.
#pragma once

#if defined(STORE_F16) || defined(STORE_BF16)
constexpr unsigned CHUNK_MODES = 2;
#elif defined(STORE_INT8)
constexpr unsigned CHUNK_MODES = 4;
#else
constexpr unsigned CHUNK_MODES = 1;
#endif
constexpr unsigned ENTRY_BYTES = 4 / CHUNK_MODES;

// Decodes the entry in the lowest bits of `bits`. Decoded entries are U divided by a power of two per mode (16-bit
// entries) or by a scale per mode and tile (STORE_INT8). The host has multiplied q by the power of two; the kernel
// multiplies q by the scale.
__device__ __forceinline__ float decode_bits(unsigned bits) {
#if defined(STORE_F16)
    float number;
    asm("{ .reg .b16 low, high; mov.b32 {low, high}, %1; cvt.f32.f16 %0, low; }" : "=f"(number) : "r"(bits));
    return number;
#elif defined(STORE_BF16)
    return __uint_as_float(bits << 16);
#elif defined(STORE_INT8)
    // 0x4b000000 is the float 2^23. The selector 0x7650 replaces its lowest byte by byte 0 of `bits`, which gives
    // 2^23 + byte. The entry is byte - 128, so 2^23 + 128 = 8388736 is subtracted. Both steps are exact.
    return __uint_as_float(__byte_perm(bits, 0x4b000000u, 0x7650u)) - 8388736.0f;
#else
    return __uint_as_float(bits);
#endif
}

// Decodes the entry with index `entry` of a chunk in registers. `entry` must be a compile-time constant, because an
// array with a variable index would be in local memory.
__device__ __forceinline__ float decode_entry(const unsigned (&registers)[12], unsigned entry) {
    const unsigned bits = registers[entry / CHUNK_MODES];
#if defined(STORE_INT8)
    // As in `decode_bits`, with byte `entry % 4` instead of byte 0.
    return __uint_as_float(__byte_perm(bits, 0x4b000000u, 0x7650u | entry % 4)) - 8388736.0f;
#else
    return decode_bits(entry % CHUNK_MODES == 0 ? bits : bits >> 16);
#endif
}

// Loads the entry (mode, axis, vertex) of a chunk. `words` points to the first of the quad's three words. They are
// `word_stride` words apart.
__device__ __forceinline__ float load_entry(const uint4* words, unsigned word_stride, unsigned mode, unsigned axis,
                                            unsigned vertex) {
    const unsigned byte_offset = ((mode * 3 + axis) * 4) * ENTRY_BYTES;
    const char* entry = (const char*)(words + (size_t)(byte_offset / 16) * word_stride) + byte_offset % 16 + vertex * ENTRY_BYTES;
#if defined(STORE_F16) || defined(STORE_BF16)
    return decode_bits(__ldcs((const unsigned short*)entry));
#elif defined(STORE_INT8)
    return decode_bits(__ldcs((const unsigned char*)entry));
#else
    return __ldcs((const float*)entry);
#endif
}
