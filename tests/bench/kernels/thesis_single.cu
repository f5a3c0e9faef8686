// BASELINE: u = U q of one domain as in chapter 3.2.1 of the thesis. For comparison only.
//   lines   [line][pass][lane] float4: rows of U, four modes per float4. A line is the work of a warp: as many
//           whole rows as fit into 32 lanes. If a row has more than 32 float4, a line is one row, in several passes
//           of 32 float4                                                                                         (in)
//   q       [rank] f32                                                                                           (in)
//   u       [vertices] float4; the fourth number is not written                                                  (out)
//   rows    number of rows of U, three per vertex
// Launch: 256 threads per block, one warp per line, ceil(lines / 8) blocks. The thesis does not cover rows of more than
// 32 float4 (rank above 128). This kernel sums them in several passes and applies equation 3.3 to each pass.
//
// CPU twin: the tests of tests/bench/src/kernels/thesis/thesis_single.rs.
constexpr unsigned LANES = 32;
constexpr unsigned WARPS = 8;
constexpr unsigned MAX_RANK = 512;

extern "C" __global__ void __launch_bounds__(WARPS * LANES)
    thesis_single(const float4* lines, const float* q, float* u, unsigned rank, unsigned rows) {
    __shared__ float shared_q[MAX_RANK];
    __shared__ float sub_sums[WARPS][LANES];
    const unsigned n_vr = (rank + 3) / 4;                       // float4 per row
    const unsigned width = min(n_vr, LANES);                    // lanes per row
    const unsigned rows_per_line = LANES / width;               // n_g in the thesis
    const unsigned passes = (n_vr + LANES - 1) / LANES;
    // Loads q[4 j + i] to index i * 32 + j (equation 3.3), separately for each pass of 128 modes.
    for (unsigned index = threadIdx.x; index < passes * 4 * LANES; index += WARPS * LANES) {
        const unsigned mode = index / 128 * 128 + 4 * (index % LANES) + index / LANES % 4;
        shared_q[index] = mode < rank ? q[mode] : 0.0f;
    }
    __syncthreads();
    const unsigned warp = threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const unsigned line = blockIdx.x * WARPS + warp;
    const unsigned row = line * rows_per_line + lane / width;
    const bool is_busy = lane < rows_per_line * width && row < rows;
    float sum = 0.0f;
    if (is_busy) {
        for (unsigned pass = 0; pass < passes; ++pass) {
            const unsigned k = lane % width;
            if (pass * LANES + k < n_vr) {
                const float4 entry = lines[((size_t)line * passes + pass) * LANES + lane];
                const float* q_part = shared_q + pass * 4 * LANES + k;
                sum += entry.x * q_part[0] + entry.y * q_part[LANES] + entry.z * q_part[2 * LANES] +
                       entry.w * q_part[3 * LANES];
            }
        }
    }
    sub_sums[warp][lane] = sum; // equation 3.4
    __syncwarp();
    // The first lane of a row adds the sums of all lanes of the row.
    if (is_busy && lane % width == 0) {
        float total = 0.0f;
        for (unsigned k = 0; k < width; ++k) {
            total += sub_sums[warp][lane + k];
        }
        u[4 * (size_t)(row / 3) + row % 3] = total;
    }
}
