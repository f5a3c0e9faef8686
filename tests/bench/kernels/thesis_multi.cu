// BASELINE: u = U q of many domains with the groups of chapter 3.2.2 of the thesis. For comparison only. A group is
// WIDTH (w_g in the thesis) consecutive lanes of a warp, which compute one or several rows of U q. A lane multiplies
// four modes.
//   entries  [lanes of all warps] float4: U'' of all domains of one group width, four modes of a row of U per
//            lane. U'' has the rows of U, padded to whole float4, in the order in which groups compute them      (in)
//   meta     [lanes of all warps] uint4: index of the row's result in u, counted in floats, or IDLE; index of the
//            lane's four coordinates in q, counted in float4; n_vr, the number of lanes per row of U; an unused
//            number                                                                                              (in)
//   q        coordinates of each domain, padded to whole float4                                                  (in)
//   u        float4 per vertex of the domains with modes; the fourth number is not written                       (out)
// Launch: 256 threads per block, one thread per lane; the lanes fill whole blocks.
// tests/bench/src/kernels/thesis/group.rs packs the inputs.
//
// CPU twin: the tests of tests/bench/src/kernels/thesis/thesis_multi.rs.
#ifndef WIDTH
#define WIDTH 8
#endif

constexpr unsigned LANES = 32;
constexpr unsigned WARPS = 8;
constexpr unsigned IDLE = 0xffffffffu;

extern "C" __global__ void __launch_bounds__(WARPS * LANES)
    thesis_multi(const float4* entries, const uint4* meta, const float4* q, float* u) {
    __shared__ float sub_sums[WARPS][LANES];
    const unsigned warp = threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const size_t index = (size_t)blockIdx.x * (WARPS * LANES) + threadIdx.x;
    const uint4 lane_meta = meta[index];
    const unsigned output = lane_meta.x, input = lane_meta.y, n_vr = lane_meta.z;
    const bool is_busy = output != IDLE;
    float sum = 0.0f;
    if (is_busy) {
        const float4 entry = entries[index], q_part = q[input];
        sum = entry.x * q_part.x + entry.y * q_part.y + entry.z * q_part.z + entry.w * q_part.w;
    }
    sub_sums[warp][lane] = sum;
    __syncwarp();
    // The first lane of a row adds the sums of all lanes of the row.
    if (is_busy && lane % WIDTH % n_vr == 0) {
        float total = 0.0f;
        for (unsigned k = 0; k < n_vr; ++k) {
            total += sub_sums[warp][lane + k];
        }
        u[output] = total;
    }
}
