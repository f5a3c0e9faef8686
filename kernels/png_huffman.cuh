// Length-limited Huffman codes, built by one block with CODE_BLOCK threads, one per symbol. All threads of the block
// must call each of these functions. Twin: src/frame/png/huffman.rs, which gives the same codes.
#pragma once
#include "png.cuh"

constexpr unsigned CODE_BLOCK = PADDED_SYMBOLS, CODE_WARPS = CODE_BLOCK / 32;
constexpr unsigned NO_WEIGHT = 0xffffffffu; // larger than the sum of all frequencies

// Shared memory of the construction. Leaves (symbols in ascending order of frequency) and inner nodes (in the order of
// their creation, which is ascending too) are two queues, so the two rarest nodes are at their fronts.
struct HuffmanScratch {
    alignas(16) unsigned frequencies[PADDED_SYMBOLS];
    unsigned leaf_weights[PADDED_SYMBOLS + 32];  // then 32 times NO_WEIGHT, because a warp reads 32 at a time
    unsigned inner_weights[PADDED_SYMBOLS + 32]; // the same
    unsigned merged_weights[PADDED_SYMBOLS];     // weights of the nodes that a round combines, in ascending order
    unsigned short leaf_parents[PADDED_SYMBOLS], inner_parents[PADDED_SYMBOLS]; // indices of inner nodes
    unsigned counts[MAX_CODE_BITS + 1];          // number of codes of each length
    unsigned warp_counts[CODE_WARPS][MAX_CODE_BITS + 1];
};

// Number of leading weights of an ascending list that are below `weight`.
__device__ inline unsigned count_lighter(const unsigned* weights, unsigned count, unsigned weight) {
    unsigned begin = 0;
    while (count > 0) {
        const unsigned half = count / 2;
        const bool is_lighter = weights[begin + half] < weight;
        begin += is_lighter ? half + 1 : 0;
        count = is_lighter ? count - half - 1 : half;
    }
    return begin;
}

// Number of weights at the front of a queue that are at most `weight`. All lanes of a warp must call this.
__device__ inline unsigned count_candidates(const unsigned* weights, unsigned weight) {
    unsigned total = 0, count;
    do {
        count = __popc(__ballot_sync(0xffffffffu, weights[total + threadIdx.x % 32] <= weight));
        total += count;
    } while (count == 32);
    return total;
}

// Combines the two nodes with the smallest weights until one node is left. Of equal weights, leaves come first. All
// nodes whose weight is at most that of the next new node come before all new nodes, so a round combines them in pairs
// at once. If their number is odd, the last one waits for the next round. The smallest weight at least doubles in one
// or two rounds, so few rounds are needed.
__device__ inline void combine_nodes(HuffmanScratch& scratch, unsigned leaf_count) {
    unsigned leaf = 0, inner = 0, node = 0;
    while (node + 1 < leaf_count) {
        const unsigned* leaves = scratch.leaf_weights + leaf;
        const unsigned* inners = scratch.inner_weights + inner;
        const bool first_is_leaf = leaves[0] <= inners[0];
        const unsigned second = first_is_leaf ? min(leaves[1], inners[0]) : min(leaves[0], inners[1]);
        const unsigned weight = (first_is_leaf ? leaves[0] : inners[0]) + second;
        const unsigned leaf_candidates = count_candidates(leaves, weight);
        const unsigned inner_candidates = count_candidates(inners, weight);
        const unsigned pair_count = (leaf_candidates + inner_candidates) / 2;
        // The rank of a node among all candidates is its index, plus the number of nodes of the other queue before it.
        for (unsigned i = threadIdx.x; i < leaf_candidates + inner_candidates; i += CODE_BLOCK) {
            const bool is_leaf = i < leaf_candidates;
            const unsigned index = is_leaf ? i : i - leaf_candidates;
            const unsigned node_weight = is_leaf ? leaves[index] : inners[index];
            const unsigned other_count = is_leaf ? inner_candidates : leaf_candidates;
            const unsigned rank = index + count_lighter(is_leaf ? inners : leaves, other_count, node_weight + !is_leaf);
            scratch.merged_weights[rank] = node_weight;
            if (rank < 2 * pair_count) {
                unsigned short* parents = is_leaf ? scratch.leaf_parents + leaf : scratch.inner_parents + inner;
                parents[index] = node + rank / 2;
            }
        }
        const bool has_rest = (leaf_candidates + inner_candidates) % 2 == 1;
        const bool rest_is_leaf = leaf_candidates > 0 && (inner_candidates == 0 ||
                                                          leaves[leaf_candidates - 1] > inners[inner_candidates - 1]);
        leaf += leaf_candidates - (has_rest && rest_is_leaf);
        inner += inner_candidates - (has_rest && !rest_is_leaf);
        __syncthreads();
        for (unsigned i = threadIdx.x; i < pair_count; i += CODE_BLOCK) {
            scratch.inner_weights[node + i] = scratch.merged_weights[2 * i] + scratch.merged_weights[2 * i + 1];
        }
        node += pair_count;
        __syncthreads();
    }
}

// Lengthens codes until the sum of 2^-length is 1 (Kraft's equality). `counts` has the number of codes of each length.
// All lanes of a warp must call this.
template <unsigned MAX_BITS>
__device__ inline void complete_code(unsigned (&counts)[MAX_CODE_BITS + 1]) {
    const unsigned length = threadIdx.x % 32;
    unsigned count = length >= 1 && length <= MAX_BITS ? counts[length] : 0;
    unsigned used = length <= MAX_BITS ? count << (MAX_BITS - length) : 0;
    for (unsigned offset = 16; offset > 0; offset /= 2) {
        used += __shfl_xor_sync(0xffffffffu, used, offset);
    }
    for (; used > 1u << MAX_BITS; --used) {
        // One code of the maximum length and a shorter code are replaced by two codes that are one bit longer than the
        // shorter one.
        const unsigned shorter = 31 - __clz(__ballot_sync(0xffffffffu, length < MAX_BITS && count > 0));
        count += 2 * (length == shorter + 1) - (length == shorter) - (length == MAX_BITS);
    }
    if (length >= 1 && length <= MAX_BITS) {
        counts[length] = count;
    }
}

// Whether a symbol has a frequency and is before another one in the order of the leaves.
__device__ inline unsigned precedes(unsigned frequency, unsigned symbol, unsigned other_frequency,
                                    unsigned other_symbol) {
    // For frequency 0, the subtraction wraps around to a number above all frequencies.
    return frequency - 1 < other_frequency - (other_symbol <= symbol);
}

// The length of the code of this thread's symbol, at most MAX_BITS; 0 if its frequency is 0. Only the first
// SYMBOL_COUNT symbols, a multiple of 4, can have a frequency. At least two symbols have one, and the sum of all
// frequencies is below 2^32 - 1.
template <unsigned SYMBOL_COUNT, unsigned MAX_BITS>
__device__ inline unsigned code_length(HuffmanScratch& scratch, unsigned frequency) {
    const unsigned symbol = threadIdx.x;
    const bool is_used = frequency > 0;
    __syncthreads();
    scratch.frequencies[symbol] = frequency;
    scratch.inner_weights[symbol] = NO_WEIGHT;
    if (symbol <= MAX_CODE_BITS) {
        scratch.counts[symbol] = 0;
    }
    const unsigned leaf_count = __syncthreads_count(is_used);
    // Equal frequencies are in the order of their symbols.
    unsigned rank = 0;
    for (unsigned other = 0; other < SYMBOL_COUNT; other += 4) {
        const uint4 others = *(const uint4*)&scratch.frequencies[other];
        rank += precedes(others.x, other, frequency, symbol) + precedes(others.y, other + 1, frequency, symbol) +
                precedes(others.z, other + 2, frequency, symbol) + precedes(others.w, other + 3, frequency, symbol);
    }
    if (is_used) {
        scratch.leaf_weights[rank] = frequency;
    }
    if (symbol < 32) {
        scratch.leaf_weights[leaf_count + symbol] = NO_WEIGHT;
        scratch.inner_weights[PADDED_SYMBOLS + symbol] = NO_WEIGHT;
    }
    __syncthreads();
    combine_nodes(scratch, leaf_count);
    if (is_used) {
        unsigned depth = 1;
        // The last inner node is the root.
        for (unsigned node = scratch.leaf_parents[rank]; node + 2 < leaf_count; node = scratch.inner_parents[node]) {
            ++depth;
        }
        atomicAdd(&scratch.counts[min(depth, MAX_BITS)], 1);
    }
    __syncthreads();
    if (symbol < 32) {
        complete_code<MAX_BITS>(scratch.counts);
    }
    __syncthreads();
    // The rarest symbols have the longest codes.
    unsigned length = MAX_BITS;
    for (unsigned end = scratch.counts[length]; length > 1 && rank >= end; end += scratch.counts[length]) {
        --length;
    }
    return is_used ? length : 0;
}

// The canonical code of this thread's symbol (RFC 1951, section 3.2.2), first bit lowest, after `code_length`.
__device__ inline unsigned canonical_code(HuffmanScratch& scratch, unsigned length) {
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    if (lane <= MAX_CODE_BITS) {
        scratch.warp_counts[warp][lane] = 0;
    }
    __syncwarp();
    const unsigned same = __match_any_sync(0xffffffffu, length), preceding = __popc(same & ((1u << lane) - 1));
    if (preceding == 0) {
        scratch.warp_counts[warp][length] = __popc(same);
    }
    __syncthreads();
    unsigned code = 0;
    for (unsigned shorter = 1; shorter < length; ++shorter) {
        code = (code + scratch.counts[shorter]) << 1;
    }
    for (unsigned other = 0; other < warp; ++other) {
        code += scratch.warp_counts[other][length];
    }
    return length == 0 ? 0 : __brev(code + preceding) >> (32 - length);
}
