// CRC-32 of PNG chunks (reflected, polynomial 0xedb88320), computed by one block. A checksum is the remainder of a
// polynomial over GF(2). The checksum of a concatenation is therefore crc(first) * x^(8 * bytes of second) +
// crc(second), where each crc starts from 0.
#pragma once

constexpr unsigned CRC_POLYNOMIAL = 0xedb88320u;
constexpr unsigned CRC_ONE = 0x80000000u; // the polynomial 1: bit 31 is the coefficient of x^0

// The product of two polynomials modulo the polynomial of CRC-32.
__device__ constexpr unsigned crc_multiply(unsigned a, unsigned b) {
    unsigned product = 0;
    for (int bit = 31; bit >= 0; --bit) {
        product ^= b & (0u - (a >> bit & 1));
        b = b >> 1 ^ (CRC_POLYNOMIAL & (0u - (b & 1)));
    }
    return product;
}

// x^(8 * digit * 16^position).
__device__ constexpr unsigned crc_power(unsigned position, unsigned digit) {
    unsigned base = CRC_ONE >> 8;
    for (unsigned i = 0; i < 4 * position; ++i) {
        base = crc_multiply(base, base);
    }
    unsigned power = CRC_ONE;
    for (unsigned i = 0; i < digit; ++i) {
        power = crc_multiply(power, base);
    }
    return power;
}

#define CRC_POWERS(p)                                                                                                  \
    {crc_power(p, 0), crc_power(p, 1), crc_power(p, 2), crc_power(p, 3), crc_power(p, 4), crc_power(p, 5),             \
     crc_power(p, 6), crc_power(p, 7), crc_power(p, 8), crc_power(p, 9), crc_power(p, 10), crc_power(p, 11),           \
     crc_power(p, 12), crc_power(p, 13), crc_power(p, 14), crc_power(p, 15)}
// Powers for byte counts below 16^6, by hexadecimal digit. The content of a chunk has fewer bytes.
constexpr unsigned CRC_DIGITS = 6;
__device__ const unsigned CRC_POWER_TABLE[CRC_DIGITS][16] = {CRC_POWERS(0), CRC_POWERS(1), CRC_POWERS(2),
                                                             CRC_POWERS(3), CRC_POWERS(4), CRC_POWERS(5)};
#undef CRC_POWERS

// The checksum of the bytes of `crc` followed by `byte_count` zero bytes.
__device__ inline unsigned crc_shift(unsigned crc, unsigned byte_count) {
    for (unsigned digit = 0; digit < CRC_DIGITS && byte_count > 0; ++digit, byte_count /= 16) {
        if (byte_count % 16 != 0) {
            crc = crc_multiply(crc, CRC_POWER_TABLE[digit][byte_count % 16]);
        }
    }
    return crc;
}

// Tables for four bytes at once, in shared memory.
struct CrcTables {
    unsigned table[4][256]; // table[i][byte]: the checksum of the byte and i zero bytes

    // Fills the tables. All threads of a block of at least 256 threads must call this.
    __device__ void fill() {
        if (threadIdx.x < 256) {
            unsigned crc = threadIdx.x;
            for (unsigned bit = 0; bit < 8; ++bit) {
                crc = crc >> 1 ^ (CRC_POLYNOMIAL & (0u - (crc & 1)));
            }
            table[0][threadIdx.x] = crc;
        }
        __syncthreads();
        if (threadIdx.x < 256) {
            for (unsigned i = 1; i < 4; ++i) {
                const unsigned crc = table[i - 1][threadIdx.x];
                table[i][threadIdx.x] = crc >> 8 ^ table[0][crc & 255];
            }
        }
        __syncthreads();
    }

    __device__ unsigned add_byte(unsigned crc, unsigned byte) const {
        return crc >> 8 ^ table[0][(crc ^ byte) & 255];
    }

    // Adds four bytes, the first one lowest.
    __device__ unsigned add_word(unsigned crc, unsigned word) const {
        crc ^= word;
        return table[3][crc & 255] ^ table[2][crc >> 8 & 255] ^ table[1][crc >> 16 & 255] ^ table[0][crc >> 24];
    }
};
