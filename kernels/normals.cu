// Unit normals and tangents that follow the deformed triangles, for every corner of every domain, in one launch.
//   rest_normals   [3][rest_corners] f32, one plane per axis                                            (in)
//   rest_tangents  [..] float4: unit tangent, sign of the bitangent; read only with NORMAL_MAPS         (in)
//   transforms     [roots][3] float4: the rows of world_from_domain; A is their first three columns   (in)
//   following, frames  with FOLLOWERS, as for `deform`                                                  (in)
//   members        [..] u32: the smoothing group of each corner of a shape that has groups              (in)
//   begins, rings  [groups + 1] u32 offsets into the rings: src/model/domain/smoothing_groups.rs               (in)
//   group_normals  [3][groups] f32: geometric unit normals at rest, zeros where there is none           (in)
//   positions      [vertices][3] f32, world, of this step; address in the header                        (in)
//   normals        [corners][3] f32, world; address in the header                                       (out)
//   tangents       [corners] float4, world; zeros where a shape has none; only with NORMAL_MAPS         (out)
// Launch: BLOCK threads per block, a thread per packed corner, ceil(corners / BLOCK) blocks over all domains. A block
// is skipped if none of its domains has changed since this output was written. CPU twin:
// src/compute/reference/normals.rs, which defines the result.
//
// A thread per corner, not per group: corners of one group repeat its sum from the cache. A pass over groups would
// write and read 12 bytes per group and cost a launch, which pays off only with two or more corners per group on
// average. For groups of k triangles and one corner each, DRAM traffic per corner is 4 bytes of members, 4 of begins, 4
// (k + 2) of rings, 12 of geometric normals and 12 of positions, plus 24 for the rest normal and the new one: 88 bytes
// at k = 6.
//
// Each thread gathers for itself, without atomics, in the order of the ring, so runs agree bit by bit. Sums are f64:
// differences and products of two f32 are exact or nearly exact, and neither over- nor underflow, so no scaling is
// needed for large, small or distant domains.
#include "dependent_launch.cuh"
#include "direction.cuh"

// Part of B that an area must exceed, and minimum squared length of the sum of two unit vectors; as in the twin.
constexpr double RESOLUTION = 1.0 / 262144.0;
constexpr float OPPOSITE = 1e-10f;

// The rotation of the surface around a corner, as its unit normals before and after, if it could be determined.
struct ShortestArc {
    float3 from, to;
    bool is_defined;
};

__device__ float dot(const float3& v, const float3& w) {
    return fmaf(v.x, w.x, fmaf(v.y, w.y, v.z * w.z));
}

// v + w * amount
__device__ float3 add(const float3& v, const float3& w, float amount) {
    return make_float3(fmaf(w.x, amount, v.x), fmaf(w.y, amount, v.y), fmaf(w.z, amount, v.z));
}

__device__ float3 scaled(const float3& v, float amount) {
    return make_float3(v.x * amount, v.y * amount, v.z * amount);
}

__device__ double3 position_of(const float* positions, unsigned vertex) {
    const float* x = positions + 3 * (size_t)vertex;
    return make_double3(__ldg(x), __ldg(x + 1), __ldg(x + 2));
}

__device__ double l1_norm(const double3& v) {
    return fabs(v.x) + fabs(v.y) + fabs(v.z);
}

// The sum of the area vectors around a group, and its rounding scale B as the twin defines it.
struct Area {
    double3 sum;
    double rounding;
};

// The ring must have at least two entries.
__device__ Area area_of(const unsigned* ring, const unsigned* end, const float* positions) {
    const double3 own = position_of(positions, __ldg(ring));
    const double height = l1_norm(own);
    double3 sum = make_double3(0.0, 0.0, 0.0), before = sum;
    double rounding = 0.0, reach_before = 0.0;
    for (++ring; ring < end; ++ring) {
        const unsigned entry = __ldg(ring);
        const double3 there = position_of(positions, entry & ~RING_START);
        const double3 edge = make_double3(there.x - own.x, there.y - own.y, there.z - own.z);
        const double length = l1_norm(edge);
        const double reach = length * (length + height);
        if (!(entry & RING_START)) {
            sum.x += before.y * edge.z - before.z * edge.y;
            sum.y += before.z * edge.x - before.x * edge.z;
            sum.z += before.x * edge.y - before.y * edge.x;
            rounding += reach_before + reach;
        }
        before = edge;
        reach_before = reach;
    }
    return {sum, rounding};
}

__device__ ShortestArc surface_rotation(const NormalsArgs& args, const NormalSlot& slot, const Mat3d& linear, unsigned corner) {
    ShortestArc turn = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}, false};
    if (slot.first_member == NO_GROUPS) {
        return turn;
    }
    const unsigned group = __ldg(args.members + slot.first_member + (corner - slot.first));
    const float* rest = args.group_normals + group;
    const size_t plane = args.groups;
    const double3 normal = make_double3(__ldg(rest), __ldg(rest + plane), __ldg(rest + 2 * plane));
    if (normal.x == 0.0 && normal.y == 0.0 && normal.z == 0.0) {
        return turn;
    }
    const float* positions = args.header->positions + 3 * (size_t)slot.first_vertex;
    const unsigned* rings = args.rings;
    const Area area = area_of(rings + __ldg(args.ring_offsets + group), rings + __ldg(args.ring_offsets + group + 1), positions);
    const double least = RESOLUTION * area.rounding;
    const double3 sum = area.sum;
    // Also false when a position is not finite.
    turn.is_defined = sum.x * sum.x + sum.y * sum.y + sum.z * sum.z > least * least;
    if (!turn.is_defined) {
        return turn;
    }
    // The sum transforms by the cofactors and the rest normal by the inverse transpose; they differ by the sign of the
    // determinant.
    const double hand = determinant_sign(linear);
    turn.to = unit(make_double3(hand * sum.x, hand * sum.y, hand * sum.z));
    turn.from = transform_normal(linear, normal);
    return turn;
}

// Applies the smallest rotation that takes `from` to `to`: the component along `from` is moved to `to`, the rest is
// reflected at the plane perpendicular to their bisector.
__device__ float3 rotate(const ShortestArc& turn, const float3& v) {
    const float along = dot(turn.from, v);
    const float3 across = add(v, turn.from, -along);
    const float3 middle = add(turn.from, turn.to, 1.0f);
    const float square = dot(middle, middle);
    const float part = square < OPPOSITE ? 0.0f : 2.0f * dot(middle, across) / square;
    return add(add(across, middle, -part), turn.to, along);
}

__device__ float3 unit_of(const float3& v) {
    return scaled(v, 1.0f / sqrtf(dot(v, v)));
}

// A tangent without its component along the normal; if nothing remains, any unit vector perpendicular to the normal.
__device__ float3 orthogonalize(const float3& tangent, const float3& normal) {
    const float3 flat = add(tangent, normal, -dot(normal, tangent));
    if (dot(flat, flat) > 1e-12f) {
        return unit_of(flat);
    }
    return unit_of(fabsf(normal.x) < 0.9f ? make_float3(0.0f, normal.z, -normal.y)
                                          : make_float3(-normal.z, 0.0f, normal.x));
}

extern "C" __global__ void __launch_bounds__(BLOCK) normals(const __grid_constant__ NormalsArgs args) {
    wait_on_dependent_grids();
    __shared__ float staged[3 * BLOCK];
    const unsigned corner = blockIdx.x * BLOCK + threadIdx.x;
    const unsigned domain = domain_of(args.slots, args.first_domains, min(corner, args.corners - 1));
    if (!__syncthreads_or(is_dirty(args.header, args.change_steps, domain))) {
        return;
    }
    if (corner < args.corners) {
        const NormalSlot slot = args.slots[domain];
        const Mat3d linear = linear_part(transforms_of(args), domain);
        const ShortestArc followed = surface_rotation(args, slot, linear, corner);
        const float* rest = args.rest_normals + slot.first_normal + (corner - slot.first);
        const size_t plane = args.rest_corners;
        float3 normal = transform_normal(linear, make_double3(__ldg(rest), __ldg(rest + plane), __ldg(rest + 2 * plane)));
        if (followed.is_defined) {
            normal = unit_of(rotate(followed, normal));
        }
        staged[3 * threadIdx.x] = normal.x;
        staged[3 * threadIdx.x + 1] = normal.y;
        staged[3 * threadIdx.x + 2] = normal.z;
#ifdef NORMAL_MAPS
        float4 world = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (slot.first_tangent != NO_TANGENTS) {
            const float4 tangent = __ldg(args.rest_tangents + slot.first_tangent + (corner - slot.first));
            float3 along = transform_direction(linear, make_double3(tangent.x, tangent.y, tangent.z));
            if (followed.is_defined) {
                along = orthogonalize(rotate(followed, along), normal);
            }
            world = make_float4(along.x, along.y, along.z, tangent.w * (float)determinant_sign(linear));
        }
        args.header->tangents[corner] = world;
#endif
    }
    __syncthreads();
    store_triples(args.header->normals, staged, args.corners);
}
