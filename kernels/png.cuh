// Layout of the PNG encoder, and the symbols of its deflate blocks. png.cu describes the kernels and the macro
// CHANNELS.
//
// A picture is divided into strips of rows. The filtered bytes of a strip are divided into tiles of TILE_BYTES, and a
// tile into words of eight bytes. Runs of zeros do not cross the border of a tile, so a tile can be split into symbols
// without its neighbors. Twin: src/frame/png.
#pragma once

#ifndef CHANNELS
#define CHANNELS 3
#endif

constexpr unsigned TILE_BYTES = 8192, WORD_BYTES = 8, TILE_WORDS = TILE_BYTES / WORD_BYTES;
constexpr unsigned SYMBOLS = 286, END_OF_BLOCK = 256;  // literals, the end of a block, and lengths of matches
constexpr unsigned PADDED_SYMBOLS = 288;               // a multiple of a warp's threads
constexpr unsigned MIN_MATCH = 3, MAX_MATCH = 258;     // bytes
constexpr unsigned MAX_CODE_BITS = 12;
constexpr unsigned DISTANCE_BITS = 1;                  // the code of distance 1 is a single 0
constexpr unsigned MAX_STORED_BYTES = 65535, STORED_HEADER_BYTES = 5;
constexpr unsigned ADLER_MODULUS = 65521;
// A header has at most 74 bits of fields, and 288 code lengths of at most 7 bits.
constexpr unsigned HEADER_WORDS = 68;

// Device addresses and parameters of an encoding. Twin: src/compute/gpu/executor/png.rs.
struct PngArgs {
    unsigned long long pixels;        // RGBA8 of the first pixel of the top row, aligned to 4 bytes
    unsigned long long filtered;      // [strips][tiles_per_strip][TILE_BYTES] u8
    unsigned long long tiles;         // [strips][tiles_per_strip] PngTile
    unsigned long long strips;        // [strips] PngStrip
    unsigned long long words;         // [words_per_tile * tiles] u32: the file; only the content of its chunks is used
    unsigned long long is_translucent; // u32: 1 if a pixel is not opaque; 0 at first, and reset by png_finish
    unsigned long long file;          // pinned host memory: the file, aligned to 16 bytes
    unsigned long long result;        // PngResult in pinned host memory
    long long pitch;                  // bytes from a row to the one below it, a multiple of 4; negative if rows ascend
    unsigned width, height;           // pixels
    unsigned row_bytes;               // bytes of a filtered row: 1 + CHANNELS * width
    unsigned strip_rows;              // rows of each strip but the last one, which may have fewer
    unsigned strip_count;
    unsigned tiles_per_strip;         // tiles of a full strip
    unsigned words_per_tile;          // words of the file that each block of png_filter clears
    unsigned reserved;
};
static_assert(sizeof(PngArgs) == 104, "PngArgs differs from the host");

// Symbols and checksum of a tile.
struct PngTile {
    unsigned short counts[PADDED_SYMBOLS]; // number of each symbol
    unsigned sum;                          // sum of the bytes
    unsigned weighted_sum;                 // sum of byte * (number of bytes from it to the end), modulo 65521
    unsigned bit_count;                    // bits of all symbols
    unsigned reserved;
};
static_assert(sizeof(PngTile) == 592, "PngTile differs from the host");

// Code and size of a strip.
struct PngStrip {
    unsigned codes[PADDED_SYMBOLS]; // value of a symbol's code (first bit lowest) | length << 16
    unsigned header[HEADER_WORDS];  // header of the deflate block
    unsigned header_bits;
    unsigned is_stored;             // 1: stored blocks without a code
    unsigned content_bytes;         // content of the IDAT chunk
    unsigned reserved;
};
static_assert(sizeof(PngStrip) == 1440, "PngStrip differs from the host");

struct PngResult {
    unsigned file_bytes;
    unsigned is_translucent; // 1: a pixel is not opaque
};

// The bytes of a tile: a range of bytes of its strip.
struct TileRange {
    unsigned strip, first_byte, byte_count;

    __device__ TileRange(const PngArgs& args, unsigned tile) {
        strip = tile / args.tiles_per_strip;
        first_byte = TILE_BYTES * (tile - strip * args.tiles_per_strip);
        const unsigned bytes = strip_bytes(args, strip);
        byte_count = first_byte < bytes ? min(TILE_BYTES, bytes - first_byte) : 0;
    }

    __device__ static unsigned strip_bytes(const PngArgs& args, unsigned strip) {
        return args.row_bytes * min(args.strip_rows, args.height - strip * args.strip_rows);
    }
};

// Sum of a value over this lane and the preceding ones.
__device__ inline unsigned warp_prefix_sum(unsigned value) {
    const unsigned lane = threadIdx.x % 32;
    for (unsigned offset = 1; offset < 32; offset *= 2) {
        const unsigned lower = __shfl_up_sync(0xffffffffu, value, offset);
        value += lane >= offset ? lower : 0;
    }
    return value;
}

// Sum over all threads of the block, for every thread. `partial_sums` has a value per warp.
template <unsigned WARP_COUNT>
__device__ inline unsigned long long block_sum(unsigned long long value,
                                               unsigned long long (&partial_sums)[WARP_COUNT]) {
    for (unsigned offset = 16; offset > 0; offset /= 2) {
        value += __shfl_xor_sync(0xffffffffu, value, offset);
    }
    __syncthreads();
    if (threadIdx.x % 32 == 0) {
        partial_sums[threadIdx.x / 32] = value;
    }
    __syncthreads();
    value = 0;
    for (unsigned warp = 0; warp < WARP_COUNT; ++warp) {
        value += partial_sums[warp];
    }
    return value;
}

// Number of bits after the code of a symbol: the extra bits of a match length, and the match distance (RFC 1951,
// section 3.2.5).
__device__ inline unsigned bits_after_code(unsigned symbol) {
    if (symbol <= END_OF_BLOCK) {
        return 0;
    }
    const unsigned index = symbol - END_OF_BLOCK - 1;
    return DISTANCE_BITS + (index < 8 || symbol == SYMBOLS - 1 ? 0 : index / 4 - 1);
}

// The symbol of a match of `length` bytes, and its extra bits.
struct LengthSymbol {
    unsigned symbol, extra, extra_bits;

    __device__ explicit LengthSymbol(unsigned length) : symbol(SYMBOLS - 1), extra(0), extra_bits(0) {
        if (length < MAX_MATCH) {
            const unsigned offset = length - MIN_MATCH;
            // From offset 8 on, groups of four symbols have the same number of extra bits.
            extra_bits = offset < 8 ? 0 : 29 - __clz(offset);
            extra = offset & ((1u << extra_bits) - 1);
            symbol = END_OF_BLOCK + 1 + 4 * extra_bits + (offset >> extra_bits);
        }
    }
};

// Bytes of a tile that are zeros: `begin` to `end` - 1.
struct ZeroRun {
    unsigned begin, end;
};

// The filtered bytes of a tile in shared memory, and its runs of zeros. A run is a maximal sequence of zeros that
// contains an aligned word of zeros.
struct SharedTile {
    unsigned long long words[TILE_WORDS]; // bytes after the end are zeros
    unsigned byte_count;
    unsigned zero_words[TILE_WORDS / 32]; // a bit per word: whether all its bytes exist and are zeros
    int last_other[TILE_WORDS / 32];      // per 32 words: the last word before them whose bit is not set, or -1
    int first_other[TILE_WORDS / 32];     // per 32 words: the first word after them whose bit is not set, or TILE_WORDS

    // Finds the words of zeros. The caller has synchronized the block after its writes to `words`, and `bytes` is the
    // same in all threads. BLOCK_THREADS is the size of the block.
    template <unsigned BLOCK_THREADS>
    __device__ void find_zeros(unsigned bytes) {
        const unsigned lane = threadIdx.x % 32;
        for (unsigned word = threadIdx.x; word < TILE_WORDS; word += BLOCK_THREADS) {
            const unsigned zeros = __ballot_sync(0xffffffffu, WORD_BYTES * (word + 1) <= bytes && words[word] == 0);
            if (lane == 0) {
                zero_words[word / 32] = zeros;
            }
        }
        if (threadIdx.x == 0) {
            byte_count = bytes;
        }
        __syncthreads();
        if (threadIdx.x < TILE_WORDS / 32) {
            const unsigned others = ~zero_words[lane];
            int last = others == 0 ? -1 : (int)(32 * lane + 31) - __clz(others);
            int first = others == 0 ? (int)TILE_WORDS : (int)(32 * lane) + __ffs(others) - 1;
            for (unsigned offset = 1; offset < 32; offset *= 2) {
                const int lower = __shfl_up_sync(0xffffffffu, last, offset);
                const int higher = __shfl_down_sync(0xffffffffu, first, offset);
                last = lane >= offset ? max(last, lower) : last;
                first = lane + offset < 32 ? min(first, higher) : first;
            }
            const int lower = __shfl_up_sync(0xffffffffu, last, 1), higher = __shfl_down_sync(0xffffffffu, first, 1);
            last_other[lane] = lane == 0 ? -1 : lower;
            first_other[lane] = lane == 31 ? (int)TILE_WORDS : higher;
        }
        __syncthreads();
    }

    __device__ bool is_zero(unsigned word) const {
        return zero_words[word / 32] >> word % 32 & 1;
    }

    // The run that contains a word of zeros.
    __device__ ZeroRun run_at(unsigned word) const {
        const unsigned bit = word % 32, others = ~zero_words[word / 32];
        const unsigned lower = others & ((1u << bit) - 1), higher = others & ~((2u << bit) - 1);
        const int before = lower == 0 ? last_other[word / 32] : (int)(word - bit + 31) - __clz(lower);
        const int after = higher == 0 ? first_other[word / 32] : (int)(word - bit) + __ffs(higher) - 1;
        ZeroRun run;
        run.begin = before < 0 ? 0 : WORD_BYTES * (before + 1) - __clzll(words[before]) / 8;
        run.end = min(byte_count, WORD_BYTES * after + (after == (int)TILE_WORDS ? 0 : leading_zeros(words[after])));
        return run;
    }

    // Number of zeros at the start of a word, in the order of the file.
    __device__ static unsigned leading_zeros(unsigned long long word) {
        return word == 0 ? WORD_BYTES : (__ffsll(word) - 1) / 8;
    }
};

// Passes to `sink` those symbols of a run that begin at the bytes `first` to `end` - 1. The first zero of a run is a
// literal. Matches of distance 1 follow, each of the maximum length but the last one. One or two remaining zeros are
// literals.
template <typename Sink>
__device__ inline void add_run(const ZeroRun& run, unsigned first, unsigned end, Sink& sink) {
    if (first == run.begin) {
        sink.add_zeros(1);
        ++first;
    }
    if (first >= end) {
        return;
    }
    const unsigned offset = (first - run.begin - 1) % MAX_MATCH;
    const bool is_covered = offset != 0 && run.end - (first - offset) >= MIN_MATCH;
    const unsigned next = is_covered ? first - offset + MAX_MATCH : first;
    if (next >= end) {
        return;
    }
    const unsigned length = min(MAX_MATCH, run.end - next);
    if (length >= MIN_MATCH) {
        sink.add_match(length);
    } else {
        sink.add_zeros(end - next);
    }
}

// Passes the symbols that begin in a word to `sink`: first those of a run that ends in the word or covers it, then
// literals, then those of a run that begins in the word.
template <typename Sink>
__device__ inline void add_word(const SharedTile& tile, unsigned word, Sink& sink) {
    const unsigned first = WORD_BYTES * word;
    if (first >= tile.byte_count) {
        return;
    }
    const unsigned long long bytes = tile.words[word];
    const bool is_zero = tile.is_zero(word), is_after_zeros = word > 0 && tile.is_zero(word - 1);
    const bool is_before_zeros = word + 1 < TILE_WORDS && tile.is_zero(word + 1);
    const unsigned byte_count = min(WORD_BYTES, tile.byte_count - first);
    const unsigned literals_begin = is_zero || is_after_zeros ? min(SharedTile::leading_zeros(bytes), byte_count) : 0;
    if (literals_begin > 0) {
        add_run(tile.run_at(is_zero ? word : word - 1), first, first + literals_begin, sink);
    }
    if (is_zero) {
        return;
    }
    const unsigned literals_end = byte_count - (is_before_zeros ? __clzll(bytes) / 8 : 0);
    sink.add_literals(bytes, literals_begin, literals_end);
    if (literals_end < byte_count) {
        // The run includes the next word, so a match follows its first byte.
        sink.add_zeros(1);
        if (literals_end + 1 < byte_count) {
            sink.add_match(min(MAX_MATCH, tile.run_at(word + 1).end - (first + literals_end + 1)));
        }
    }
}
