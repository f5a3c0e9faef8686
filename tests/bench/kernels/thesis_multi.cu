// BASELINE: u = U q of many domains with the group concept of chapter 3.2.2 of the thesis. For comparison only.
//   entries  [lanes] float4: U'' of all domains of one group width, 32 per warp                                  (in)
//   meta     [lanes] uint4: output index in u (floats) or IDLE, input index in q (float4), n_vr, unused          (in)
//   q        float4 of coordinates of each domain                                                                (in)
//   u        [vertices with modes] float4, the fourth number is not written                                      (out)
// Launch: 256 threads per block, one thread per lane; the lanes fill whole blocks. WIDTH is w_g. CPU twin: the tests of
// tests/bench/src/kernels/thesis/thesis_multi.rs.
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
    const bool is_busy = lane_meta.x != IDLE;
    float sum = 0.0f;
    if (is_busy) {
        const float4 entry = entries[index], q_part = q[lane_meta.y];
        sum = entry.x * q_part.x + entry.y * q_part.y + entry.z * q_part.z + entry.w * q_part.w;
    }
    sub_sums[warp][lane] = sum;
    __syncwarp();
    if (is_busy && lane % WIDTH % lane_meta.z == 0) {
        float total = 0.0f;
        for (unsigned k = 0; k < lane_meta.z; ++k) {
            total += sub_sums[warp][lane + k];
        }
        u[lane_meta.x] = total;
    }
}
