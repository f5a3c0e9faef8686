// PNG encoder: filters RGBA8 pixels, compresses them and writes a whole file to pinned host memory. The file equals
// that of the CPU twin (src/frame/png describes the format). Strips of rows are encoded independently, each as an IDAT
// chunk with one deflate block that has a Huffman code of its own, or with stored blocks. The file depends only on the
// pixels.
//   png_filter  a block per tile: filter Sub, counts of the symbols, sums for Adler-32; clears the memory of the file
//   png_code    a block per strip: Huffman code, header of the deflate block, sizes
//   png_pack    a block per tile: writes the bits of the symbols at offsets from prefix sums
//   png_finish  a block per strip: CRC-32; writes the chunk to the host. The first and the last block also write the
//               start and the end of the file, with the Adler-32 of all strips
// Macro: CHANNELS, 3 (RGB, the default) or 4 (RGBA). With 3, alpha is dropped, and the result states whether a pixel is
// not opaque. Such a picture must be encoded with 4.
// Launch: all kernels have the argument PngArgs. png_filter and png_pack: strips * tiles_per_strip blocks of BLOCK
// threads; png_code: strips blocks of CODE_BLOCK threads; png_finish: strips blocks of BLOCK threads.
// CPU twin: PngLayout::encode_strip.
#include "png.cuh"
#include "png_crc.cuh"
#include "png_huffman.cuh"

constexpr unsigned BLOCK = 256, WARPS = BLOCK / 32;
constexpr unsigned WORDS_PER_THREAD = TILE_WORDS / BLOCK;
// The compiler limits the registers of png_pack so that this many blocks fit on a multiprocessor. Chosen so that no
// registers spill.
#if __CUDA_ARCH__ >= 800 && __CUDA_ARCH__ < 1000
constexpr unsigned PACK_BLOCKS = 6;
#else
constexpr unsigned PACK_BLOCKS = 4;
#endif
constexpr unsigned FILTER_SUB = 1;
constexpr unsigned HEAD_BYTES = 46;                  // signature and the chunks IHDR and sRGB
constexpr unsigned CHUNK_PREFIX = 8, CHUNK_BYTES = 12; // length and type; length, type and checksum
constexpr unsigned ZLIB_HEADER_BYTES = 2;
constexpr unsigned LENGTH_SYMBOLS = 20; // the 19 symbols that encode code lengths, padded to a multiple of 4

__device__ inline const unsigned* row_pixels(const PngArgs& args, unsigned row) {
    return (const unsigned*)((const char*)args.pixels + (long long)row * args.pitch);
}

// A pixel of a row; zeros to the left of the first one.
__device__ inline unsigned load_pixel(const unsigned* row, int column) {
    return column < 0 ? 0 : __ldg(row + column);
}

// Position of a byte of a filtered strip.
struct FilteredPosition {
    unsigned byte;        // from the start of the strip
    unsigned row, column; // row of the strip, and byte of the filtered row

    __device__ void advance(const PngArgs& args, unsigned bytes) {
        byte += bytes;
        column += bytes;
        while (column >= args.row_bytes) {
            column -= args.row_bytes;
            ++row;
        }
    }
};

// Four bytes of the filtered strip from `position` on. Bytes from `end` on are zeros. Clears bits of `alphas` if a
// pixel is not opaque.
__device__ inline unsigned filter_word(const PngArgs& args, unsigned strip, FilteredPosition position, unsigned end,
                                       unsigned& alphas) {
    const unsigned first_row = strip * args.strip_rows;
    if (position.column > 0 && position.column + 3 < args.row_bytes && position.byte + 3 < end) {
        const unsigned pixel = (position.column - 1) / CHANNELS, shift = 8 * ((position.column - 1) % CHANNELS);
        const unsigned* pixels = row_pixels(args, first_row + position.row);
        const unsigned left = load_pixel(pixels, (int)pixel - 1), middle = __ldg(pixels + pixel);
        const unsigned right = __ldg(pixels + min(pixel + 1, args.width - 1));
        alphas &= middle & right;
        const unsigned difference = __vsub4(middle, left), next_difference = __vsub4(right, middle);
        if (CHANNELS == 4) {
            return __funnelshift_r(difference, next_difference, shift);
        }
        const unsigned low = (difference & 0xffffff) | next_difference << 24, high = next_difference >> 8 & 0xffff;
        return __funnelshift_r(low, high, shift);
    }
    unsigned word = 0;
    for (unsigned i = 0; i < 4 && position.byte < end; ++i, position.advance(args, 1)) {
        unsigned value = FILTER_SUB;
        if (position.column > 0) {
            const unsigned pixel = (position.column - 1) / CHANNELS, shift = 8 * ((position.column - 1) % CHANNELS);
            const unsigned* pixels = row_pixels(args, first_row + position.row);
            const unsigned middle = __ldg(pixels + pixel);
            alphas &= middle;
            value = __vsub4(middle, load_pixel(pixels, (int)pixel - 1)) >> shift & 255;
        }
        word |= value << 8 * i;
    }
    return word;
}

// Counts symbols in shared memory. Bytes that are not literals increment the counter of an unused padding symbol,
// because a branch per byte would cost more than the addition.
struct SymbolCounter {
    unsigned* counts;
    unsigned run_zeros; // zeros of runs that are literals

    __device__ void add_zeros(unsigned count) {
        run_zeros += count;
    }

    __device__ void add_match(unsigned length) {
        atomicAdd(&counts[LengthSymbol(length).symbol], 1);
    }

    __device__ void add_literals(unsigned long long bytes, unsigned begin, unsigned end) {
        const unsigned literals = (1u << end) - (1u << begin);
#pragma unroll
        for (unsigned i = 0; i < WORD_BYTES; ++i) {
            const unsigned byte = (unsigned)(bytes >> 32 * (i / 4)) >> 8 * (i % 4) & 255;
            const bool is_literal = literals >> i & 1;
            atomicAdd(&counts[is_literal ? byte : PADDED_SYMBOLS - 1], 1);
        }
    }
};

extern "C" __global__ void __launch_bounds__(BLOCK) png_filter(const __grid_constant__ PngArgs args) {
    __shared__ SharedTile tile;
    __shared__ unsigned counts[WARPS][PADDED_SYMBOLS];
    __shared__ unsigned long long partial_sums[WARPS];
    const TileRange range(args, blockIdx.x);
    for (unsigned i = threadIdx.x; i < WARPS * PADDED_SYMBOLS; i += BLOCK) {
        counts[i / PADDED_SYMBOLS][i % PADDED_SYMBOLS] = 0;
    }
    unsigned* words = (unsigned*)args.words + (size_t)blockIdx.x * args.words_per_tile;
    for (unsigned i = threadIdx.x; i < args.words_per_tile; i += BLOCK) {
        words[i] = 0;
    }
    unsigned alphas = 0xffffffffu;
    unsigned sum = 0, weighted_sum = 0;
    unsigned* filtered = (unsigned*)args.filtered + (size_t)blockIdx.x * (TILE_BYTES / 4);
    const unsigned first = range.first_byte + 4 * threadIdx.x, end = range.first_byte + range.byte_count;
    FilteredPosition position = {first, first / args.row_bytes, first % args.row_bytes};
#pragma unroll 4
    for (unsigned i = threadIdx.x; i < TILE_BYTES / 4; i += BLOCK, position.advance(args, 4 * BLOCK)) {
        const unsigned word = filter_word(args, range.strip, position, end, alphas);
        ((unsigned*)tile.words)[i] = word;
        filtered[i] = word;
        const unsigned word_sum = __dp4a(word, 0x01010101u, 0u);
        sum += word_sum;
        // The weight of a byte is the number of bytes from it to the end of the tile. Bytes after the end are zeros.
        weighted_sum += word_sum * (range.byte_count - 4 * i) - __dp4a(word, 0x03020100u, 0u);
    }
    const bool is_opaque = alphas >> 24 == 255;
    if (CHANNELS == 3 && !__all_sync(0xffffffffu, is_opaque) && threadIdx.x % 32 == 0) {
        *(unsigned*)args.is_translucent = 1;
    }
    __syncthreads();
    tile.find_zeros<BLOCK>(range.byte_count);
    SymbolCounter counter = {counts[threadIdx.x / 32], 0};
    for (unsigned word = threadIdx.x; word < TILE_WORDS; word += BLOCK) {
        add_word(tile, word, counter);
    }
    atomicAdd(&counter.counts[0], counter.run_zeros);
    // Over all threads of the block, the first sum is at most 255 * 8192, and each thread adds less than 65521 to the
    // second, so each fits in 32 bits.
    const unsigned long long sums = block_sum(
        (unsigned long long)(weighted_sum % ADLER_MODULUS) << 32 | sum, partial_sums);
    PngTile* target = (PngTile*)args.tiles + blockIdx.x;
    for (unsigned symbol = threadIdx.x; symbol < PADDED_SYMBOLS; symbol += BLOCK) {
        unsigned count = 0;
        for (unsigned warp = 0; warp < WARPS; ++warp) {
            count += symbol < SYMBOLS ? counts[warp][symbol] : 0;
        }
        target->counts[symbol] = count;
    }
    if (threadIdx.x == 0) {
        target->sum = (unsigned)sums;
        target->weighted_sum = (unsigned)(sums >> 32) % ADLER_MODULUS;
    }
}

// Shared memory of `png_code`. A field is a symbol of the run-length code in which a deflate header lists the code
// lengths of all symbols (RFC 1951, section 3.2.7). Fields have a Huffman code of their own.
struct CodeScratch {
    HuffmanScratch huffman;
    unsigned header[HEADER_WORDS];
    unsigned symbol_bits[PADDED_SYMBOLS];       // bits of a symbol: code, extra bits and distance
    unsigned char lengths[PADDED_SYMBOLS];      // code lengths of literals and lengths, then of two distances
    unsigned char field_lengths[32];            // code lengths of the fields
    unsigned field_codes[32];                   // codes of the fields: value | length << 16
    unsigned field_frequencies[32];
    unsigned run_starts[CODE_WARPS];
    unsigned warp_totals[CODE_WARPS];
    unsigned symbol_count;
    unsigned long long partial_sums[CODE_WARPS];
};

// A field and its extra bits. `count` is 0 at a position that a repetition before it covers, else 1.
struct LengthField {
    unsigned symbol, extra, extra_bits, count;
};

// The field that begins at a position of a run of `run_length` equal code lengths.
__device__ inline LengthField length_field(unsigned value, unsigned position, unsigned run_length) {
    const LengthField single = {value, 0, 0, 1}, covered = {0, 0, 0, 0};
    const unsigned max_repeats = value == 0 ? 138 : 6;
    if (value != 0) {
        // The first length of a run of nonzero lengths is written as it is.
        if (position == 0) {
            return single;
        }
        position -= 1;
        run_length -= 1;
    }
    const unsigned offset = position % max_repeats, rest = run_length - (position - offset);
    if (rest < 3) {
        return single;
    }
    if (offset != 0) {
        return covered;
    }
    const unsigned repeats = min(rest, max_repeats);
    if (value != 0) {
        return {16, repeats - 3, 2, 1};
    }
    return repeats < 11 ? LengthField{17, repeats - 3, 3, 1} : LengthField{18, repeats - 11, 7, 1};
}

// Writes bits at a bit position of shared or device memory in which these bits are zero.
__device__ inline void or_bits(unsigned* words, unsigned position, unsigned value, unsigned bit_count) {
    if (bit_count > 0) {
        atomicOr(&words[position / 32], value << position % 32);
        if (position % 32 + bit_count > 32) {
            atomicOr(&words[position / 32 + 1], value >> (32 - position % 32));
        }
    }
}

// The field that begins at this thread's code length. The lengths are in `scratch`.
__device__ inline LengthField field_of_thread(CodeScratch& scratch, unsigned length_count) {
    const unsigned index = threadIdx.x, lane = index % 32;
    const unsigned value = scratch.lengths[index];
    const bool is_start = index == 0 || index >= length_count || value != scratch.lengths[index - 1];
    const unsigned starts = __ballot_sync(0xffffffffu, is_start);
    if (lane == 0) {
        scratch.run_starts[index / 32] = starts;
    }
    __syncthreads();
    if (index >= length_count) {
        return {0, 0, 0, 0};
    }
    int warp = index / 32;
    unsigned before = starts & ((2u << lane) - 1), after = starts & ~((2u << lane) - 1);
    while (before == 0) {
        before = scratch.run_starts[--warp];
    }
    const unsigned begin = 32 * warp + 31 - __clz(before);
    warp = index / 32;
    while (after == 0 && warp + 1 < (int)CODE_WARPS) {
        after = scratch.run_starts[++warp];
    }
    const unsigned end = after == 0 ? PADDED_SYMBOLS : 32 * warp + __ffs(after) - 1;
    return length_field(value, index - begin, min(end, length_count) - begin);
}

// Sum of a value over the preceding threads of the block. All threads must call this.
__device__ inline unsigned preceding_sum(unsigned value, unsigned (&warp_totals)[CODE_WARPS]) {
    const unsigned warp = threadIdx.x / 32;
    unsigned sum = warp_prefix_sum(value);
    if (threadIdx.x % 32 == 31) {
        warp_totals[warp] = sum;
    }
    __syncthreads();
    for (unsigned other = 0; other < warp; ++other) {
        sum += warp_totals[other];
    }
    return sum - value;
}

// Writes the header of a deflate block to `scratch.header`, which contains zeros. Returns its number of bits.
__device__ inline unsigned write_header(CodeScratch& scratch, unsigned length, bool is_last) {
    constexpr unsigned char LENGTH_ORDER[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    const unsigned index = threadIdx.x;
    if (length > 0) {
        atomicMax(&scratch.symbol_count, index + 1);
    }
    __syncthreads();
    // The end of the block has a code, so at least 257 symbols remain. Two distances have a code, of one bit each.
    const unsigned symbol_count = scratch.symbol_count, length_count = symbol_count + 2;
    scratch.lengths[index] = index < symbol_count ? length : 1;
    __syncthreads();
    const LengthField field = field_of_thread(scratch, length_count);
    if (field.count > 0) {
        atomicAdd(&scratch.field_frequencies[field.symbol], 1);
    }
    __syncthreads();
    const unsigned frequency = index < 32 ? scratch.field_frequencies[index] : 0;
    const unsigned field_length = code_length<LENGTH_SYMBOLS, 7>(scratch.huffman, frequency);
    const unsigned field_code = canonical_code(scratch.huffman, field_length);
    if (index < 32) {
        scratch.field_lengths[index] = field_length;
        scratch.field_codes[index] = field_code | field_length << 16;
    }
    __syncthreads();
    unsigned order_count = 19;
    while (order_count > 4 && scratch.field_lengths[LENGTH_ORDER[order_count - 1]] == 0) {
        --order_count;
    }
    if (index == 0) {
        // Block type 2: a block with Huffman codes of its own.
        or_bits(scratch.header, 0, is_last | 2 << 1 | (symbol_count - 257) << 3 | 1 << 8 | (order_count - 4) << 13, 17);
    }
    if (index < order_count) {
        or_bits(scratch.header, 17 + 3 * index, scratch.field_lengths[LENGTH_ORDER[index]], 3);
    }
    const unsigned code = scratch.field_codes[field.symbol], code_bits = code >> 16;
    const unsigned bit_count = field.count * (code_bits + field.extra_bits);
    const unsigned position = 17 + 3 * order_count + preceding_sum(bit_count, scratch.warp_totals);
    or_bits(scratch.header, position, (code & 0xffff) | field.extra << code_bits, bit_count);
    __syncthreads();
    unsigned end = 17 + 3 * order_count;
    for (unsigned warp = 0; warp < CODE_WARPS; ++warp) {
        end += scratch.warp_totals[warp];
    }
    return end;
}

extern "C" __global__ void __launch_bounds__(CODE_BLOCK) png_code(const __grid_constant__ PngArgs args) {
    __shared__ CodeScratch scratch;
    const unsigned symbol = threadIdx.x, lane = symbol % 32, strip = blockIdx.x;
    const bool is_last = strip + 1 == args.strip_count;
    if (symbol < HEADER_WORDS) {
        scratch.header[symbol] = 0;
    }
    if (symbol < 32) {
        scratch.field_frequencies[symbol] = 0;
    }
    if (symbol == 0) {
        scratch.symbol_count = 0;
    }
    PngTile* tiles = (PngTile*)args.tiles + (size_t)strip * args.tiles_per_strip;
    unsigned frequency = symbol == END_OF_BLOCK;
#pragma unroll 8
    for (unsigned tile = 0; tile < args.tiles_per_strip; ++tile) {
        frequency += tiles[tile].counts[symbol];
    }
    const unsigned length = code_length<PADDED_SYMBOLS, MAX_CODE_BITS>(scratch.huffman, frequency);
    const unsigned code = canonical_code(scratch.huffman, length);
    const unsigned bits = length + bits_after_code(symbol);
    scratch.symbol_bits[symbol] = bits;
    const unsigned long long symbol_bits = block_sum((unsigned long long)frequency * bits, scratch.partial_sums);
    for (unsigned tile = symbol / 32; tile < args.tiles_per_strip; tile += CODE_WARPS) {
        unsigned tile_bits = 0;
        for (unsigned other = lane; other < PADDED_SYMBOLS; other += 32) {
            tile_bits += tiles[tile].counts[other] * scratch.symbol_bits[other];
        }
        for (unsigned offset = 16; offset > 0; offset /= 2) {
            tile_bits += __shfl_xor_sync(0xffffffffu, tile_bits, offset);
        }
        if (lane == 0) {
            tiles[tile].bit_count = tile_bits;
        }
    }
    const unsigned header_bits = write_header(scratch, length, is_last);
    PngStrip* target = (PngStrip*)args.strips + strip;
    target->codes[symbol] = code | length << 16;
    if (symbol < HEADER_WORDS) {
        target->header[symbol] = scratch.header[symbol];
    }
    if (symbol == 0) {
        // Every strip but the last ends with an empty stored block, so that it ends at a byte boundary: three bits,
        // padding to a byte, and four bytes.
        const unsigned end_bits = is_last ? 0 : 3, end_bytes = is_last ? 0 : 4;
        const unsigned block_bytes = (unsigned)((header_bits + symbol_bits + end_bits + 7) / 8) + end_bytes;
        const unsigned strip_bytes = TileRange::strip_bytes(args, strip);
        const unsigned stored_blocks = (strip_bytes + MAX_STORED_BYTES - 1) / MAX_STORED_BYTES;
        const unsigned stored_bytes = strip_bytes + STORED_HEADER_BYTES * stored_blocks;
        target->header_bits = header_bits;
        target->is_stored = block_bytes >= stored_bytes;
        target->content_bytes = min(block_bytes, stored_bytes) + (strip == 0 ? ZLIB_HEADER_BYTES : 0);
    }
}

// Offset in the file of the content of a strip's chunk. All threads of the block must call this.
__device__ inline unsigned content_offset(const PngArgs& args, unsigned strip,
                                          unsigned long long (&partial_sums)[WARPS]) {
    const PngStrip* strips = (const PngStrip*)args.strips;
    unsigned bytes = 0;
    for (unsigned other = threadIdx.x; other < strip; other += BLOCK) {
        bytes += CHUNK_BYTES + strips[other].content_bytes;
    }
    return HEAD_BYTES + CHUNK_PREFIX + (unsigned)block_sum(bytes, partial_sums);
}

// Collects the bits of the symbols of a word: at most 8 literals of 12 bits, or matches, which have fewer bits per
// byte.
struct SymbolPacker {
    const unsigned* codes; // as PngStrip::codes
    unsigned long long low, high;
    unsigned bit_count;

    __device__ void add_bits(unsigned long long value, unsigned count) {
        if (bit_count < 64) {
            low |= value << bit_count;
            high |= bit_count > 0 ? value >> (64 - bit_count) : 0;
        } else {
            high |= value << (bit_count - 64);
        }
        bit_count += count;
    }

    __device__ void add_zeros(unsigned count) {
        for (unsigned i = 0; i < count; ++i) {
            add_bits(codes[0] & 0xffff, codes[0] >> 16);
        }
    }

    __device__ void add_match(unsigned length) {
        const LengthSymbol match(length);
        const unsigned code = codes[match.symbol], code_bits = code >> 16;
        // The code of the distance is a 0.
        add_bits((code & 0xffff) | match.extra << code_bits, code_bits + match.extra_bits + DISTANCE_BITS);
    }

    __device__ void add_literals(unsigned long long bytes, unsigned begin, unsigned end) {
        const unsigned is_literal = (1u << end) - (1u << begin);
#pragma unroll
        for (unsigned half = 0; half < 2; ++half) {
            unsigned literals[4];
#pragma unroll
            for (unsigned i = 0; i < 4; ++i) {
                const unsigned byte = (unsigned)(bytes >> 32 * half) >> 8 * i & 255;
                literals[i] = is_literal >> (4 * half + i) & 1 ? codes[byte] : 0;
            }
            // The high halves of the sums are sums of code lengths, because sums of two 12-bit values do not carry into
            // them.
            const unsigned first_sum = literals[0] + literals[1], second_sum = literals[2] + literals[3];
            const unsigned first = (literals[0] & 0xffff) | (literals[1] & 0xffff) << (literals[0] >> 16);
            const unsigned second = (literals[2] & 0xffff) | (literals[3] & 0xffff) << (literals[2] >> 16);
            add_bits(first | (unsigned long long)second << (first_sum >> 16), (first_sum + second_sum) >> 16);
        }
    }
};

// Maximum number of words of a tile's bits: 12 bits per byte, the header of a block and the end of a strip.
constexpr unsigned PACKED_WORDS = TILE_BYTES * MAX_CODE_BITS / 32 + HEADER_WORDS + 4;

__device__ inline void pack_word(unsigned* packed, unsigned position, const SymbolPacker& packer) {
    unsigned* target = packed + position / 32;
    const unsigned shift = position % 32, end = shift + packer.bit_count;
    const unsigned parts[5] = {(unsigned)packer.low, (unsigned)(packer.low >> 32), (unsigned)packer.high,
                               (unsigned)(packer.high >> 32), 0};
#pragma unroll
    for (unsigned i = 0; i < 5; ++i) {
        if (end > 32 * i) {
            atomicOr(&target[i], __funnelshift_l(i == 0 ? 0 : parts[i - 1], parts[i], shift));
        }
    }
}

// Copies a tile to stored blocks. `content` is the offset of the first block in the file.
__device__ inline void store_tile(const PngArgs& args, const TileRange& range, unsigned content) {
    const unsigned char* source = (const unsigned char*)args.filtered + (size_t)blockIdx.x * TILE_BYTES;
    unsigned char* file = (unsigned char*)args.words;
    const unsigned strip_bytes = TileRange::strip_bytes(args, range.strip);
    for (unsigned i = threadIdx.x; i < range.byte_count; i += BLOCK) {
        const unsigned byte = range.first_byte + i, block = byte / MAX_STORED_BYTES;
        unsigned char* target = file + content + byte + STORED_HEADER_BYTES * (block + 1);
        *target = source[i];
        if (byte == block * MAX_STORED_BYTES) {
            const unsigned length = min(MAX_STORED_BYTES, strip_bytes - byte);
            const bool is_last = byte + length == strip_bytes && range.strip + 1 == args.strip_count;
            target[-5] = is_last;
            target[-4] = length;
            target[-3] = length >> 8;
            target[-2] = ~length;
            target[-1] = ~length >> 8;
        }
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK, PACK_BLOCKS) png_pack(const __grid_constant__ PngArgs args) {
    __shared__ SharedTile tile;
    __shared__ unsigned packed[PACKED_WORDS];
    __shared__ unsigned codes[PADDED_SYMBOLS];
    __shared__ unsigned row_totals[WORDS_PER_THREAD * WARPS];
    __shared__ unsigned long long partial_sums[WARPS];
    const TileRange range(args, blockIdx.x);
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    for (unsigned i = threadIdx.x; i < PACKED_WORDS; i += BLOCK) {
        packed[i] = 0;
    }
    if (range.byte_count == 0) {
        return;
    }
    const PngStrip& strip = ((const PngStrip*)args.strips)[range.strip];
    unsigned content = content_offset(args, range.strip, partial_sums);
    if (range.strip == 0) {
        if (range.first_byte == 0 && threadIdx.x == 0) {
            // The zlib header 0x78, 0x01: deflate with a window of 32 KiB, fastest compression level.
            or_bits((unsigned*)args.words, 8 * content, 0x0178, 16);
        }
        content += ZLIB_HEADER_BYTES;
    }
    if (strip.is_stored) {
        store_tile(args, range, content);
        return;
    }
    const unsigned long long* source = (const unsigned long long*)args.filtered + (size_t)blockIdx.x * TILE_WORDS;
    for (unsigned i = threadIdx.x; i < TILE_WORDS; i += BLOCK) {
        tile.words[i] = source[i];
    }
    for (unsigned i = threadIdx.x; i < PADDED_SYMBOLS; i += BLOCK) {
        codes[i] = strip.codes[i];
    }
    // Offset of the first symbol, from the start of the strip's block in bits.
    const PngTile* tiles = (const PngTile*)args.tiles + (size_t)range.strip * args.tiles_per_strip;
    const unsigned tile_index = range.first_byte / TILE_BYTES;
    unsigned preceding_bits = 0;
    for (unsigned other = threadIdx.x; other < tile_index; other += BLOCK) {
        preceding_bits += tiles[other].bit_count;
    }
    const unsigned first_bit = strip.header_bits + (unsigned)block_sum(preceding_bits, partial_sums);
    tile.find_zeros<BLOCK>(range.byte_count);
    SymbolPacker packers[WORDS_PER_THREAD];
    unsigned sums[WORDS_PER_THREAD];
#pragma unroll
    for (unsigned i = 0; i < WORDS_PER_THREAD; ++i) {
        packers[i] = {codes, 0, 0, 0};
        add_word(tile, i * BLOCK + threadIdx.x, packers[i]);
    }
#pragma unroll
    for (unsigned i = 0; i < WORDS_PER_THREAD; i += 2) {
        // A warp has at most 32 * 128 bits, so 16 bits hold each sum.
        const unsigned pair = warp_prefix_sum(packers[i].bit_count | packers[i + 1].bit_count << 16);
        sums[i] = pair & 0xffff;
        sums[i + 1] = pair >> 16;
        if (lane == 31) {
            row_totals[i * WARPS + warp] = sums[i];
            row_totals[(i + 1) * WARPS + warp] = sums[i + 1];
        }
    }
    __syncthreads();
    static_assert(WORDS_PER_THREAD * WARPS == 32, "a warp adds the totals");
    if (warp == 0) {
        row_totals[lane] = warp_prefix_sum(row_totals[lane]);
    }
    __syncthreads();
    // `packed` begins at the word of the file that contains the first bit of the tile. The first tile has the header.
    const bool is_first = tile_index == 0;
    const bool is_last = range.first_byte + range.byte_count == TileRange::strip_bytes(args, range.strip);
    const unsigned long long begin = 8ull * content + (is_first ? 0 : first_bit);
    const unsigned origin = (unsigned)(begin % 32), symbols_origin = origin + (is_first ? first_bit : 0);
#pragma unroll
    for (unsigned i = 0; i < WORDS_PER_THREAD; ++i) {
        const unsigned row = i * WARPS + warp, row_begin = row == 0 ? 0 : row_totals[row - 1];
        pack_word(packed, symbols_origin + row_begin + sums[i] - packers[i].bit_count, packers[i]);
    }
    if (is_first) {
        for (unsigned i = threadIdx.x; 32 * i < strip.header_bits; i += BLOCK) {
            or_bits(packed, origin + 32 * i, strip.header[i], min(32, strip.header_bits - 32 * i));
        }
    }
    unsigned end = symbols_origin + row_totals[31];
    if (is_last) {
        const unsigned end_code = codes[END_OF_BLOCK];
        const unsigned end_of_block = end;
        end += end_code >> 16;
        const bool has_empty_block = range.strip + 1 < args.strip_count;
        // An empty stored block ends the strip at a whole byte: 3 bits of header, padding, the length 0 as u16, and its
        // complement.
        if (has_empty_block) {
            end = (end + 3 + 7) / 8 * 8 + 32;
        }
        if (threadIdx.x == 0) {
            or_bits(packed, end_of_block, end_code & 0xffff, end_code >> 16);
            if (has_empty_block) {
                or_bits(packed, end - 32, 0xffff0000u, 32);
            }
        }
    }
    __syncthreads();
    unsigned* target = (unsigned*)args.words + begin / 32;
    const unsigned word_count = (end + 31) / 32;
    for (unsigned i = threadIdx.x; i < word_count; i += BLOCK) {
        // Other tiles write to the other bits of the first and the last word.
        if (i == 0 || i + 1 == word_count) {
            atomicOr(&target[i], packed[i]);
        } else {
            target[i] = packed[i];
        }
    }
}

// Stores the four bytes of a number, highest first.
__device__ inline void store_big_endian(unsigned char* target, unsigned value) {
    for (unsigned i = 0; i < 4; ++i) {
        target[i] = value >> (24 - 8 * i);
    }
}

// Shared memory of `png_finish`.
struct FinishScratch {
    CrcTables crc;
    unsigned warp_crcs[WARPS];
    unsigned long long partial_sums[WARPS];
    unsigned char bytes[HEAD_BYTES];
};

// Appends the checksum of a chunk's type and content to the chunk, which is in shared memory. Called by one thread.
__device__ inline void close_chunk(const FinishScratch& scratch, unsigned char* chunk, unsigned content_bytes) {
    unsigned crc = 0xffffffffu;
    for (unsigned i = 4; i < CHUNK_PREFIX + content_bytes; ++i) {
        crc = scratch.crc.add_byte(crc, chunk[i]);
    }
    store_big_endian(chunk + CHUNK_PREFIX + content_bytes, ~crc);
}

__device__ inline void copy_bytes(unsigned char* target, const unsigned char* source, unsigned count) {
    for (unsigned i = 0; i < count; ++i) {
        target[i] = source[i];
    }
}

// Writes the signature and the chunks IHDR and sRGB. Called by one thread.
__device__ inline void write_head(const PngArgs& args, FinishScratch& scratch) {
    constexpr unsigned char START[16] = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n', 0, 0, 0, 13, 'I', 'H', 'D', 'R'};
    // 8 bits per channel; deflate, all filters, not interlaced.
    constexpr unsigned char FORMAT[5] = {8, CHANNELS == 3 ? 2 : 6, 0, 0, 0};
    constexpr unsigned char SRGB[9] = {0, 0, 0, 1, 's', 'R', 'G', 'B', 0}; // perceptual intent
    constexpr unsigned IHDR = 8, IHDR_CONTENT = 13, SRGB_CHUNK = IHDR + CHUNK_BYTES + IHDR_CONTENT;
    copy_bytes(scratch.bytes, START, 16);
    store_big_endian(scratch.bytes + 16, args.width);
    store_big_endian(scratch.bytes + 20, args.height);
    copy_bytes(scratch.bytes + 24, FORMAT, 5);
    close_chunk(scratch, scratch.bytes + IHDR, IHDR_CONTENT);
    copy_bytes(scratch.bytes + SRGB_CHUNK, SRGB, 9);
    close_chunk(scratch, scratch.bytes + SRGB_CHUNK, 1);
    copy_bytes((unsigned char*)args.file, scratch.bytes, HEAD_BYTES);
}

// Adler-32 of the filtered bytes of all strips (RFC 1950). The low half is 1 + the sum of the bytes. The high half is
// the sum of the low halves after each byte, in which each byte counts once for every byte from it to the end. All
// threads of the block must call this.
__device__ inline unsigned adler_checksum(const PngArgs& args, FinishScratch& scratch) {
    const unsigned tile_count = args.strip_count * args.tiles_per_strip;
    const unsigned long long byte_count = (unsigned long long)args.row_bytes * args.height;
    unsigned long long sum = 0, weighted_sum = 0;
    for (unsigned tile = threadIdx.x; tile < tile_count; tile += BLOCK) {
        const PngTile& source = ((const PngTile*)args.tiles)[tile];
        const TileRange range(args, tile);
        const unsigned long long strip_begin = (unsigned long long)args.strip_rows * args.row_bytes * range.strip;
        const unsigned long long end = strip_begin + range.first_byte + range.byte_count;
        const unsigned long long bytes_after = byte_count - min(byte_count, end);
        sum += source.sum;
        weighted_sum += source.weighted_sum + bytes_after % ADLER_MODULUS * source.sum;
    }
    sum = block_sum(sum % ADLER_MODULUS, scratch.partial_sums);
    weighted_sum = block_sum(weighted_sum % ADLER_MODULUS, scratch.partial_sums);
    const unsigned low = (1 + sum) % ADLER_MODULUS, high = (byte_count + weighted_sum) % ADLER_MODULUS;
    return high << 16 | low;
}

// Writes the chunk with the Adler-32 checksum, the chunk IEND and the result. `end` is the end of the last strip's
// chunk. All threads of the block must call this.
__device__ inline void write_tail(const PngArgs& args, FinishScratch& scratch, unsigned end) {
    constexpr unsigned char START[CHUNK_PREFIX] = {0, 0, 0, 4, 'I', 'D', 'A', 'T'};
    constexpr unsigned char IEND[CHUNK_BYTES] = {0, 0, 0, 0, 'I', 'E', 'N', 'D', 0xae, 0x42, 0x60, 0x82};
    constexpr unsigned ADLER_BYTES = 4, TAIL_BYTES = 2 * CHUNK_BYTES + ADLER_BYTES;
    const unsigned adler = adler_checksum(args, scratch);
    if (threadIdx.x == 0) {
        copy_bytes(scratch.bytes, START, CHUNK_PREFIX);
        store_big_endian(scratch.bytes + CHUNK_PREFIX, adler);
        close_chunk(scratch, scratch.bytes, ADLER_BYTES);
        copy_bytes(scratch.bytes + CHUNK_BYTES + ADLER_BYTES, IEND, CHUNK_BYTES);
        copy_bytes((unsigned char*)args.file + end, scratch.bytes, TAIL_BYTES);
        unsigned* is_translucent = (unsigned*)args.is_translucent;
        *(PngResult*)args.result = {end + TAIL_BYTES, *is_translucent};
        *is_translucent = 0;
    }
}

// CRC-32 of the type IDAT and of the bytes `begin` to `end` - 1 of `words`. All threads of the block must call this;
// the result is valid in thread 0.
__device__ inline unsigned chunk_checksum(const unsigned* words, unsigned begin, unsigned end, FinishScratch& scratch) {
    // Each thread has the same number of words, and the words of the last thread end at the last whole word. Words
    // before the first word count as zeros, which do not change a checksum that starts from 0.
    const unsigned first_word = begin / 4, end_word = max(first_word, end / 4);
    const unsigned words_per_thread = (end_word - first_word + BLOCK - 1) / BLOCK;
    const unsigned words_after = words_per_thread * (BLOCK - 1 - threadIdx.x);
    unsigned crc = 0;
    const int last = (int)(end_word - first_word) - (int)words_after;
    for (int i = max(0, last - (int)words_per_thread); i < last; ++i) {
        unsigned word = words[first_word + i];
        if (i == 0) {
            word &= 0xffffffffu << 8 * (begin % 4);
        }
        crc = scratch.crc.add_word(crc, word);
    }
    crc = crc == 0 ? 0 : crc_shift(crc, 4 * words_after);
    for (unsigned offset = 16; offset > 0; offset /= 2) {
        crc ^= __shfl_xor_sync(0xffffffffu, crc, offset);
    }
    if (threadIdx.x % 32 == 0) {
        scratch.warp_crcs[threadIdx.x / 32] = crc;
    }
    __syncthreads();
    if (threadIdx.x != 0) {
        return 0;
    }
    crc = 0xffffffffu;
    for (const unsigned char letter : {'I', 'D', 'A', 'T'}) {
        crc = scratch.crc.add_byte(crc, letter);
    }
    const unsigned whole_end = max(begin, 4 * end_word);
    crc = crc_shift(crc, whole_end - begin);
    for (unsigned warp = 0; warp < WARPS; ++warp) {
        crc ^= scratch.warp_crcs[warp];
    }
    for (unsigned byte = whole_end; byte < end; ++byte) {
        crc = scratch.crc.add_byte(crc, words[byte / 4] >> 8 * (byte % 4) & 255);
    }
    return ~crc;
}

// Copies bytes of the content to the same offsets of the file in pinned memory.
__device__ inline void copy_to_host(const PngArgs& args, unsigned begin, unsigned end) {
    const unsigned first_vector = (begin + 15) / 16, end_vector = max(first_vector, end / 16);
    for (unsigned i = first_vector + threadIdx.x; i < end_vector; i += BLOCK) {
        ((uint4*)args.file)[i] = ((const uint4*)args.words)[i];
    }
    const unsigned char* source = (const unsigned char*)args.words;
    unsigned char* target = (unsigned char*)args.file;
    const unsigned byte = threadIdx.x % 16;
    if (threadIdx.x < 16 && begin + byte < min(end, 16 * first_vector)) {
        target[begin + byte] = source[begin + byte];
    } else if (threadIdx.x >= 16 && threadIdx.x < 32 && max(begin, 16 * end_vector) + byte < end) {
        target[16 * end_vector + byte] = source[16 * end_vector + byte];
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) png_finish(const __grid_constant__ PngArgs args) {
    __shared__ FinishScratch scratch;
    scratch.crc.fill();
    const unsigned strip = blockIdx.x;
    const unsigned begin = content_offset(args, strip, scratch.partial_sums);
    const unsigned bytes = ((const PngStrip*)args.strips)[strip].content_bytes, end = begin + bytes;
    copy_to_host(args, begin, end);
    const unsigned crc = chunk_checksum((const unsigned*)args.words, begin, end, scratch);
    if (threadIdx.x == 0) {
        unsigned char* file = (unsigned char*)args.file;
        store_big_endian(file + begin - CHUNK_PREFIX, bytes);
        store_big_endian(file + begin - CHUNK_PREFIX / 2, 'I' << 24 | 'D' << 16 | 'A' << 8 | 'T');
        store_big_endian(file + end, crc);
        if (strip == 0) {
            write_head(args, scratch);
        }
    }
    if (strip + 1 == args.strip_count) {
        write_tail(args, scratch, end + CHUNK_BYTES - CHUNK_PREFIX);
    }
}
