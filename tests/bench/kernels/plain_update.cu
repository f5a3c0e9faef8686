// x = T (x0 + u) of every vertex of every domain, for a u that cuBLAS computed.
//   domains         [domains] PlainDomain                                                                        (in)
//   vertex_domains  [vertices] u32: the domain of each vertex; not read with SINGLE (scenes of one domain)       (in)
//   rest            x0, [vertices][3] f32 in the domain's frame                                                  (in)
//   transforms      [domains][3] float4: rows of T                                                               (in)
//   u               f32, three per vertex of a domain with modes                                                 (in)
//   positions       x, [vertices][3] f32                                                                         (out)
// Launch: BLOCK threads per block, one thread per vertex.
// CPU twin: the tests of tests/bench/src/kernels/plain_update.rs.
constexpr unsigned BLOCK = 256;
constexpr unsigned long long RIGID = 0xffffffffffffffffull; // `first_u` of a domain without modes

// Where the data of one domain begins.
struct PlainDomain {
    unsigned long long first_u; // index into `u` in floats, or RIGID
    unsigned first_vertex;      // index among the vertices of all domains
    unsigned reserved;
};
static_assert(sizeof(PlainDomain) == 16, "PlainDomain differs from tests/bench/src/kernels/plain_update.rs");

struct PlainArgs {
    const PlainDomain* domains;
    const unsigned* vertex_domains;
    const float* rest;
    const float4* transforms;
    const float* u;
    float* positions;
    unsigned vertices;
    unsigned reserved;
};
static_assert(sizeof(PlainArgs) == 56, "PlainArgs differs from tests/bench/src/kernels/plain_update.rs");

extern "C" __global__ void __launch_bounds__(BLOCK) plain_update(const PlainArgs args) {
    const unsigned vertex = blockIdx.x * BLOCK + threadIdx.x;
    if (vertex >= args.vertices) {
        return;
    }
#ifdef SINGLE
    const unsigned domain = 0;
#else
    const unsigned domain = args.vertex_domains[vertex];
#endif
    const PlainDomain plain_domain = args.domains[domain];
    const float* rest = args.rest + 3 * (size_t)vertex;
    float x = rest[0], y = rest[1], z = rest[2];
    if (plain_domain.first_u != RIGID) {
        const float* u = args.u + plain_domain.first_u + 3 * (size_t)(vertex - plain_domain.first_vertex);
        x += u[0];
        y += u[1];
        z += u[2];
    }
    const float4* rows = args.transforms + 3 * (size_t)domain;
    float* position = args.positions + 3 * (size_t)vertex;
#pragma unroll
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float4 row = rows[axis];
        position[axis] = fmaf(row.x, x, fmaf(row.y, y, fmaf(row.z, z, row.w)));
    }
}
