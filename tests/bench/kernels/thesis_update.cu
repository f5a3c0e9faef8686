// BASELINE: the vertex update of chapter 3.2.3 of the thesis: x = T (x0 + u), and T applied to normals and tangents.
// The triangles are unfolded: they share no vertices. For comparison only. A warp computes eight vertices, of one or
// two domains.
//   warps       [warps] uint4: the warp's first and second domain, the first of its eight vertices (0 to 7) that
//               belongs to the second domain (8 if none does), and an unused number                              (in)
//   sources     [vertices] u32: index of the vertex's float4 in u, or RIGID for a vertex without modes           (in)
//   rest_positions, rest_normals, and with TANGENTS rest_tangents
//               [vertices] float4; the fourth number of a position is 1, of a direction 0                        (in)
//   transforms  [domains][4] float4: rows of T                                                                   (in)
//   u           float4 per vertex of the domains with modes; the fourth number is 0                              (in)
//   positions, normals, tangents  [vertices] float4                                                              (out)
// Launch: 256 threads (8 warps) per block, four threads per vertex; ceil(vertices / 64) blocks. Each of the four
// threads computes one element of the vertex's float4.
// CPU twin: the tests of tests/bench/src/kernels/thesis/thesis_update.rs.
constexpr unsigned LANES = 32;
constexpr unsigned WARPS = 8;
constexpr unsigned VERTICES = WARPS * LANES / 4; // per block; n_vb in the thesis
constexpr unsigned RIGID = 0xffffffffu;

struct UpdateArgs {
    const uint4* warps;
    const unsigned* sources;
    const float* rest_positions;
    const float* rest_normals;
    const float* rest_tangents;
    const float* transforms;
    const float* u;
    float* positions;
    float* normals;
    float* tangents;
    unsigned vertices;
    unsigned reserved;
};
static_assert(sizeof(UpdateArgs) == 88, "UpdateArgs differs from tests/bench/src/kernels/thesis/thesis_update.rs");

__device__ float dot4(const float* row, const float* vector) {
    return row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2] + row[3] * vector[3];
}

extern "C" __global__ void __launch_bounds__(WARPS * LANES) thesis_update(const UpdateArgs args) {
    // T of the first and second domain of each warp, row by row.
    __shared__ float matrices[WARPS][2][16];
    __shared__ float rest_positions[VERTICES][4];
    __shared__ float rest_normals[VERTICES][4];
#ifdef TANGENTS
    __shared__ float rest_tangents[VERTICES][4];
#endif
    const unsigned warp = threadIdx.x / LANES, lane = threadIdx.x % LANES;
    const unsigned local_vertex = threadIdx.x / 4, element = lane % 4;
    const unsigned vertex = blockIdx.x * VERTICES + local_vertex;
    const size_t index = 4 * (size_t)vertex + element;
    const uint4 warp_domains = args.warps[blockIdx.x * WARPS + warp];
    // Index in the warp of the first vertex of the second domain.
    const unsigned first_of_second = warp_domains.z;
    // 16 lanes load the matrix of the first domain, and 16 lanes that of the second domain.
    const unsigned domain = lane < 16 ? warp_domains.x : warp_domains.y;
    matrices[warp][lane / 16][lane % 16] = args.transforms[16 * (size_t)domain + lane % 16];
    if (vertex < args.vertices) {
        float position = args.rest_positions[index];
        const unsigned source = args.sources[vertex];
        if (source != RIGID) {
            position += args.u[4 * (size_t)source + element];
        }
        rest_positions[local_vertex][element] = position;
        rest_normals[local_vertex][element] = args.rest_normals[index];
#ifdef TANGENTS
        rest_tangents[local_vertex][element] = args.rest_tangents[index];
#endif
    }
    __syncthreads();
    if (vertex < args.vertices) {
        const float* row = matrices[warp][lane / 4 < first_of_second ? 0 : 1] + 4 * element;
        args.positions[index] = dot4(row, rest_positions[local_vertex]);
        args.normals[index] = dot4(row, rest_normals[local_vertex]);
#ifdef TANGENTS
        args.tangents[index] = dot4(row, rest_tangents[local_vertex]);
#endif
    }
}
