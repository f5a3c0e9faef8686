// Unit normals and tangents that follow the deformed triangles, for every corner of every domain, in one launch.
//   rest_normals   [3][rest_corners] f32, one plane per axis                                            (in)
//   rest_tangents  [..] float4: unit tangent, sign of the bitangent; read only with NORMAL_MAPS         (in)
//   transforms     [roots][3] float4: the rows of world_from_domain; A is their first three columns   (in)
//   transform_links, frames  with FOLLOWERS, as for `deform`                                            (in)
//   members        [..] u32: the smoothing group of each corner of a shape that has groups              (in)
//   ring_offsets, rings  [groups + 1] u32 offsets into the rings: src/model/domain/smoothing_groups.rs  (in)
//   group_normals  [3][groups] f32: geometric unit normals at rest, zeros if undefined                  (in)
//   positions      [vertices][3] f32, world, of this step; address in the header                        (in)
//   normals        [corners][3] f32, world; address in the header                                       (out)
//   tangents       [corners] float4, world; zeros for shapes without tangents; only with NORMAL_MAPS (out)
// Launch: BLOCK threads per block, a thread per packed corner, ceil(corners / BLOCK) blocks over all domains. A block
// is skipped if none of its domains has changed since this output was written. CPU twin:
// src/compute/reference/normals.rs, which defines the result.
//
// There is a thread per corner, not per group: corners of one group repeat its sum from the cache. A separate pass over
// groups would write and read 12 bytes per group and cost a launch, which pays off only with two or more corners per
// group on average. With groups of k triangles and one corner each, the DRAM traffic per corner is 4 bytes of `members`,
// 4 of `ring_offsets`, 4 (k + 2) of `rings`, 12 of `group_normals`, 12 of positions, and 24 of the rest normal and the
// result: 88 bytes at k = 6.
//
// Each thread sums in the order of the ring, without atomics, so runs agree bit by bit. Sums are f64:
// differences and products of two f32 are exact or nearly exact, and neither over- nor underflow, so no scaling is
// needed for large, small or distant domains.
#include "dependent_launch.cuh"
#include "direction.cuh"

// An area vector is defined if it is longer than this fraction of its rounding scale B; as in the twin.
constexpr double RESOLUTION = 1.0 / 262144.0;
// Two unit vectors are opposite if the squared length of their sum is below this; as in the twin.
constexpr float MIN_BISECTOR_SQUARED_LENGTH = 1e-10f;

// The smallest rotation of the surface at a corner: from the rigid to the deformed unit normal.
struct ShortestArc {
    float3 rigid_normal, deformed_normal;
    bool is_defined;
};

__device__ float dot(const float3& v, const float3& w) {
    return fmaf(v.x, w.x, fmaf(v.y, w.y, v.z * w.z));
}

// v + w * factor
__device__ float3 add_scaled(const float3& v, const float3& w, float factor) {
    return make_float3(fmaf(w.x, factor, v.x), fmaf(w.y, factor, v.y), fmaf(w.z, factor, v.z));
}

__device__ float3 multiply(const float3& v, float factor) {
    return make_float3(v.x * factor, v.y * factor, v.z * factor);
}

__device__ double3 load_position(const float* positions, unsigned vertex) {
    const float* x = positions + 3 * (size_t)vertex;
    return make_double3(__ldg(x), __ldg(x + 1), __ldg(x + 2));
}

__device__ double l1_norm(const double3& v) {
    return fabs(v.x) + fabs(v.y) + fabs(v.z);
}

// The sum of the area vectors of a group's triangles, and its rounding scale B as the twin defines it.
struct Area {
    double3 sum;
    double rounding;
};

// The first entry of a ring is the center; the others are the vertices of the fans around it. There must be at least two.
__device__ Area sum_areas(const unsigned* ring, const unsigned* end, const float* positions) {
    const double3 center = load_position(positions, __ldg(ring));
    const double center_norm = l1_norm(center);
    double3 sum = make_double3(0.0, 0.0, 0.0), previous_edge = sum;
    double rounding = 0.0, previous_rounding = 0.0;
    for (++ring; ring < end; ++ring) {
        const unsigned entry = __ldg(ring);
        const double3 neighbor = load_position(positions, entry & ~RING_START);
        const double3 edge = make_double3(neighbor.x - center.x, neighbor.y - center.y, neighbor.z - center.z);
        const double length = l1_norm(edge);
        const double edge_rounding = length * (length + center_norm);
        if (!(entry & RING_START)) {
            sum.x += previous_edge.y * edge.z - previous_edge.z * edge.y;
            sum.y += previous_edge.z * edge.x - previous_edge.x * edge.z;
            sum.z += previous_edge.x * edge.y - previous_edge.y * edge.x;
            rounding += previous_rounding + edge_rounding;
        }
        previous_edge = edge;
        previous_rounding = edge_rounding;
    }
    return {sum, rounding};
}

__device__ ShortestArc surface_rotation(const NormalsArgs& args, const NormalSlot& slot, const Mat3d& linear, unsigned corner) {
    ShortestArc arc = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}, false};
    if (slot.first_member == NO_GROUPS) {
        return arc;
    }
    const unsigned group = __ldg(args.members + slot.first_member + (corner - slot.first));
    const float* rest = args.group_normals + group;
    const size_t plane = args.groups;
    const double3 normal = make_double3(__ldg(rest), __ldg(rest + plane), __ldg(rest + 2 * plane));
    if (normal.x == 0.0 && normal.y == 0.0 && normal.z == 0.0) {
        return arc;
    }
    const float* positions = args.header->positions + 3 * (size_t)slot.first_vertex;
    const unsigned* rings = args.rings;
    const Area area = sum_areas(rings + __ldg(args.ring_offsets + group), rings + __ldg(args.ring_offsets + group + 1), positions);
    const double min_length = RESOLUTION * area.rounding;
    const double3 sum = area.sum;
    // Also false if a position is not finite.
    arc.is_defined = sum.x * sum.x + sum.y * sum.y + sum.z * sum.z > min_length * min_length;
    if (!arc.is_defined) {
        return arc;
    }
    // The sum transforms by the cofactors and the rest normal by the inverse transpose; they differ by the sign of the
    // determinant.
    const double sign = determinant_sign(linear);
    arc.deformed_normal = normalize(make_double3(sign * sum.x, sign * sum.y, sign * sum.z));
    arc.rigid_normal = transform_normal(linear, normal);
    return arc;
}

// Applies the smallest rotation that takes the rigid to the deformed normal: the component along the rigid normal becomes
// a component along the deformed normal, and the perpendicular component is reflected at the plane perpendicular to their
// bisector.
__device__ float3 rotate(const ShortestArc& arc, const float3& v) {
    const float normal_component = dot(arc.rigid_normal, v);
    const float3 perpendicular = add_scaled(v, arc.rigid_normal, -normal_component);
    const float3 bisector = add_scaled(arc.rigid_normal, arc.deformed_normal, 1.0f);
    const float squared_length = dot(bisector, bisector);
    const float reflection = squared_length < MIN_BISECTOR_SQUARED_LENGTH ? 0.0f : 2.0f * dot(bisector, perpendicular) / squared_length;
    return add_scaled(add_scaled(perpendicular, bisector, -reflection), arc.deformed_normal, normal_component);
}

__device__ float3 normalize(const float3& v) {
    return multiply(v, 1.0f / sqrtf(dot(v, v)));
}

// The normalized tangent without its component along the normal; if that is zero, any unit vector perpendicular to the
// normal.
__device__ float3 orthogonalize(const float3& tangent, const float3& normal) {
    const float3 perpendicular = add_scaled(tangent, normal, -dot(normal, tangent));
    if (dot(perpendicular, perpendicular) > 1e-12f) {
        return normalize(perpendicular);
    }
    return normalize(fabsf(normal.x) < 0.9f ? make_float3(0.0f, normal.z, -normal.y)
                                          : make_float3(-normal.z, 0.0f, normal.x));
}

extern "C" __global__ void __launch_bounds__(BLOCK) normals(const __grid_constant__ NormalsArgs args) {
    wait_for_prerequisite_grids();
    __shared__ float staged_normals[3 * BLOCK];
    const unsigned corner = blockIdx.x * BLOCK + threadIdx.x;
    const unsigned domain = domain_of(args.slots, args.first_domains, min(corner, args.corners - 1));
    if (!__syncthreads_or(is_dirty(args.header, args.change_steps, domain))) {
        return;
    }
    if (corner < args.corners) {
        const NormalSlot slot = args.slots[domain];
        const Mat3d linear = linear_part(transforms_of(args), domain);
        const ShortestArc surface_arc = surface_rotation(args, slot, linear, corner);
        const float* rest = args.rest_normals + slot.first_normal + (corner - slot.first);
        const size_t plane = args.rest_corners;
        float3 normal = transform_normal(linear, make_double3(__ldg(rest), __ldg(rest + plane), __ldg(rest + 2 * plane)));
        if (surface_arc.is_defined) {
            normal = normalize(rotate(surface_arc, normal));
        }
        staged_normals[3 * threadIdx.x] = normal.x;
        staged_normals[3 * threadIdx.x + 1] = normal.y;
        staged_normals[3 * threadIdx.x + 2] = normal.z;
#ifdef NORMAL_MAPS
        float4 tangent_output = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (slot.first_tangent != NO_TANGENTS) {
            const float4 tangent = __ldg(args.rest_tangents + slot.first_tangent + (corner - slot.first));
            float3 world_tangent = transform_direction(linear, make_double3(tangent.x, tangent.y, tangent.z));
            if (surface_arc.is_defined) {
                world_tangent = orthogonalize(rotate(surface_arc, world_tangent), normal);
            }
            tangent_output = make_float4(world_tangent.x, world_tangent.y, world_tangent.z, tangent.w * (float)determinant_sign(linear));
        }
        args.header->tangents[corner] = tangent_output;
#endif
    }
    __syncthreads();
    store_triples(args.header->normals, staged_normals, args.corners);
}
