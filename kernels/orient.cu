// Unit normals by the inverse transpose of A, unit tangents by A, for every corner of every domain, in one launch.
//   rest_normals   [3][rest_corners] f32, one plane per axis                                            (in)
//   rest_tangents  [..] float4: unit tangent, sign of the bitangent; read only with NORMAL_MAPS         (in)
//   transforms     [domains][3] float4: the rows of world_from_domain; A is their first three columns  (in)
//   normals        [corners][3] f32, world; in the header                                               (out)
//   tangents       [corners] float4, world; zeros where a shape has none; only with NORMAL_MAPS         (out)
// Without SHEAR every A is a rotation or reflection times one scale, which turns normals as it turns tangents.
// Launch: BLOCK threads a block, a thread a packed corner, ceil(corners / BLOCK) blocks, whichever domains they meet.
// A block whose domains have not changed since this output was written is passed over.
// CPU twin: src/reference/orient.rs.
#include "turn.cuh"

extern "C" __global__ void __launch_bounds__(BLOCK) orient(const __grid_constant__ OrientArgs args) {
    __shared__ float staged[3 * BLOCK];
    const unsigned corner = blockIdx.x * BLOCK + threadIdx.x;
    const unsigned domain = domain_of(args.slots, args.first_domains, min(corner, args.corners - 1));
    if (!__syncthreads_or(is_stale(args.header, args.stamps, domain))) {
        return;
    }
    if (corner < args.corners) {
        const CornerSlot slot = args.slots[domain];
        const Rows linear = linear_of(args.transforms, domain);
        const float* rest = args.rest_normals + slot.first_normal + (corner - slot.first);
        const size_t plane = args.rest_corners;
        const float3 normal =
            turn_normal(linear, make_double3(__ldg(rest), __ldg(rest + plane), __ldg(rest + 2 * plane)));
        staged[3 * threadIdx.x] = normal.x;
        staged[3 * threadIdx.x + 1] = normal.y;
        staged[3 * threadIdx.x + 2] = normal.z;
#ifdef NORMAL_MAPS
        float4 world = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (slot.first_tangent != NO_TANGENTS) {
            const float4 tangent = __ldg(args.rest_tangents + slot.first_tangent + (corner - slot.first));
            const float3 along = turn(linear, make_double3(tangent.x, tangent.y, tangent.z));
            world = make_float4(along.x, along.y, along.z, tangent.w * (float)hand_of(linear));
        }
        args.header->tangents[corner] = world;
#endif
    }
    __syncthreads();
    store_triples(args.header->normals, staged, args.corners);
}
