// Unit normals and tangents that follow the deformed triangles, for every corner of every domain, in one launch.
//
// A shape is a mesh with its modes. A smoothing group is the corners of one vertex that share a normal. Its ring lists
// the vertex (the center), and then fans: runs of neighboring vertices, in which two consecutive ones form a triangle
// with the center (src/model/domain/smoothing_groups.rs). An area vector has the direction of a triangle's normal, and
// its length is twice the area of the triangle. The direction of the sum of a group's area vectors is the geometric
// normal of the group.
//   slots          [domains] offsets of the domain (layout.cuh)                                         (in)
//   first_domains  per block of this launch the domain of its first corner, then the last domain        (in)
//   rest_normals   [3 axes][corners of all shapes] f32                                                  (in)
//   rest_tangents  with NORMAL_MAPS: per corner of a shape with tangents a float4, unit tangent and sign of the
//                  bitangent                                                                            (in)
//   transforms     [roots][3] float4: the rows of T of each transform root                              (in)
//   transform_links, follower_frames  with FOLLOWERS, as described in deform.cu                                   (in)
//   change_steps   [domains] u32: number of the step that last changed the domain                       (in)
//   corner_groups  per corner of a shape that has groups, the index of its smoothing group              (in)
//   ring_offsets   [group_count + 1] u32: index of the first entry of each ring, then the end of the last one (in)
//   rings          u32: the rings of all groups. The first vertex of each fan has the flag RING_START   (in)
//   group_normals  [3 axes][group_count] f32: unit normals of the groups at rest, zeros if undefined    (in)
//   positions      [vertices][3] f32, world, of this step; address in the header                        (in)
//   normals        [corners][3] f32, world; address in the header                                       (out)
//   tangents       with NORMAL_MAPS: [corners] float4, world, zeros for shapes without tangents; address in the
//                  header                                                                               (out)
// Launch: BLOCK threads per block, a thread per packed corner, ceil(corners / BLOCK) blocks over all domains. A block
// returns early if none of its domains has changed since its part of `normals` was last written. CPU twin:
// src/compute/reference/normals.rs, which defines the result.
//
// Each corner has a thread, so the corners of one group repeat its sum, with data from the cache. A separate pass over
// the groups would write and read 12 bytes per group and cost a launch. This pays off only with two or more corners per
// group on average. DRAM traffic per corner, for groups of one corner and k triangles: 4 bytes of `corner_groups`, 4 of
// `ring_offsets`, 4 (k + 2) of `rings`, 12 of `group_normals`, 12 of positions, 12 of the rest normal and 12 of the
// result. The sum is 88 bytes at k = 6.
//
// Each thread sums in the order of the ring, without atomics, so runs agree bit by bit. Sums are f64. Differences and
// products of two f32 are then exact or nearly exact and cannot overflow or underflow, so large, small and distant
// domains need no scaling.
#include "dependent_launch.cuh"
#include "direction.cuh"

// 2^-18: the area sum of a group has a defined direction if it is longer than this fraction of B (`rounding_scale`
// below), which is proportional to the bound of its rounding error. The twin has the derivation.
constexpr double RESOLUTION = 1.0 / 262144.0;
// 2^-20: a unit normal is lost if the cofactors of A map it to a vector of at most this fraction of their norm, as in
// the twin, which also says how exact normals are then defined.
constexpr double FLATTENED = 1.0 / 1048576.0;
// Two unit vectors are opposite if the length of their sum is below 1e-5 (1e-10 is its square), as in the twin.
constexpr float MIN_BISECTOR_SQUARED_LENGTH = 1e-10f;

// The smallest rotation that takes the rigid unit normal of a group to its deformed unit normal. The rigid normal is
// the normal at rest, transformed by T. Without a defined rotation, the surface keeps its rigid normals.
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

// The sum of the area vectors of a group. For a triangle with the edges e and f from the center c, the area vector is
// the cross product of e and f.
struct Area {
    double3 sum;
    // B: the sum of l (l + |c|) over the edges e and f of each triangle, where l is the length of the edge. Lengths are
    // L1 norms.
    double rounding_scale;
};

// Sums the area vectors of the triangles of the ring from `ring` to `end`.
__device__ Area sum_areas(const unsigned* ring, const unsigned* end, const float* positions) {
    const double3 center = load_position(positions, __ldg(ring));
    const double center_norm = l1_norm(center);
    double3 sum = make_double3(0.0, 0.0, 0.0), previous_edge = sum;
    double rounding_scale = 0.0, previous_edge_rounding = 0.0;
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
            rounding_scale += previous_edge_rounding + edge_rounding;
        }
        previous_edge = edge;
        previous_edge_rounding = edge_rounding;
    }
    return {sum, rounding_scale};
}

// Whether the cofactors of A lose this unit normal. Without SHEAR, A keeps all angles.
__device__ bool is_flattened(const Mat3d& linear, const double3& normal) {
#ifdef SHEAR
    const Mat3d cofactors = signed_cofactors(linear, 1.0);
    const double3 transformed = multiply(cofactors, normal);
    const double squared_norm =
        dot(cofactors.row0, cofactors.row0) + dot(cofactors.row1, cofactors.row1) + dot(cofactors.row2, cofactors.row2);
    return dot(transformed, transformed) <= FLATTENED * FLATTENED * squared_norm;
#else
    return false;
#endif
}

// The rotation of the surface at a packed corner with this normal at rest, which T transforms to `rigid_normal`.
__device__ ShortestArc compute_surface_rotation(const NormalsArgs& args, const NormalSlot& slot, const Mat3d& linear,
                                                unsigned corner, const double3& rest_normal,
                                                const float3& rigid_normal) {
    ShortestArc rotation = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}, false};
    if (slot.first_corner_group == NO_GROUPS) {
        return rotation;
    }
    const unsigned group = __ldg(args.corner_groups + slot.first_corner_group + (corner - slot.first_corner));
    const float* group_normal = args.group_normals + group;
    const size_t axis_stride = args.group_count;
    const double3 normal = make_double3(__ldg(group_normal), __ldg(group_normal + axis_stride),
                                        __ldg(group_normal + 2 * axis_stride));
    if (normal.x == 0.0 && normal.y == 0.0 && normal.z == 0.0) {
        return rotation;
    }
    const float* positions = args.header->positions + 3 * (size_t)slot.first_vertex;
    const unsigned* rings = args.rings;
    const Area area = sum_areas(rings + __ldg(args.ring_offsets + group), rings + __ldg(args.ring_offsets + group + 1),
                                positions);
    const double min_length = RESOLUTION * area.rounding_scale;
    const double3 sum = area.sum;
    // Also false if a position is not finite.
    rotation.is_defined = sum.x * sum.x + sum.y * sum.y + sum.z * sum.z > min_length * min_length;
    if (!rotation.is_defined) {
        return rotation;
    }
    // The cofactor matrix transforms area sums, the inverse transpose transforms rest normals. The two matrices differ
    // by the factor of the determinant, so the directions differ by its sign.
    const double sign = determinant_sign(linear);
    rotation.deformed_normal = normalize(make_double3(sign * sum.x, sign * sum.y, sign * sum.z));
    if (is_flattened(linear, normal)) {
        rotation.rigid_normal = multiply(rigid_normal, dot(rest_normal, normal) < 0.0 ? -1.0f : 1.0f);
    } else {
        rotation.rigid_normal = transform_normal(linear, normal);
    }
    return rotation;
}

// Applies a rotation to v. The component of v along the rigid normal becomes a component along the deformed normal. The
// perpendicular component is reflected at the plane perpendicular to the bisector of the two normals.
__device__ float3 rotate(const ShortestArc& rotation, const float3& v) {
    const float normal_component = dot(rotation.rigid_normal, v);
    const float3 perpendicular = add_scaled(v, rotation.rigid_normal, -normal_component);
    const float3 bisector = add_scaled(rotation.rigid_normal, rotation.deformed_normal, 1.0f);
    const float squared_length = dot(bisector, bisector);
    const float reflection =
        squared_length < MIN_BISECTOR_SQUARED_LENGTH ? 0.0f : 2.0f * dot(bisector, perpendicular) / squared_length;
    return add_scaled(add_scaled(perpendicular, bisector, -reflection), rotation.deformed_normal, normal_component);
}

__device__ float3 normalize(const float3& v) {
    return multiply(v, 1.0f / sqrtf(dot(v, v)));
}

// The normalized tangent without its component along the normal. If the tangent is parallel to the normal within 1e-6
// rad (1e-12 is its square), returns any unit vector perpendicular to the normal.
__device__ float3 orthogonalize(const float3& tangent, const float3& normal) {
    const float3 perpendicular = add_scaled(tangent, normal, -dot(normal, tangent));
    if (dot(perpendicular, perpendicular) > 1e-12f) {
        return normalize(perpendicular);
    }
    // The cross product of the normal with the x axis, or with the y axis if the normal is close to the x axis.
    return normalize(fabsf(normal.x) < 0.9f ? make_float3(0.0f, normal.z, -normal.y)
                                          : make_float3(-normal.z, 0.0f, normal.x));
}

extern "C" __global__ void __launch_bounds__(BLOCK) normals(const __grid_constant__ NormalsArgs args) {
    wait_for_prerequisite_grids();
    __shared__ float staged_normals[3 * BLOCK];
    const unsigned corner = blockIdx.x * BLOCK + threadIdx.x;
    const unsigned domain = find_domain(args.slots, args.first_domains, min(corner, args.corner_count - 1));
    if (!__syncthreads_or(is_dirty(args.header, args.change_steps, domain))) {
        return;
    }
    if (corner < args.corner_count) {
        const NormalSlot slot = args.slots[domain];
        const Mat3d linear = load_linear_part(transforms_of(args), domain);
        const float* rest_components = args.rest_normals + slot.first_normal + (corner - slot.first_corner);
        const size_t axis_stride = args.rest_corner_count;
        const double3 rest_normal = make_double3(__ldg(rest_components), __ldg(rest_components + axis_stride),
                                                 __ldg(rest_components + 2 * axis_stride));
        float3 normal = transform_normal(linear, rest_normal);
        const ShortestArc rotation = compute_surface_rotation(args, slot, linear, corner, rest_normal, normal);
        if (rotation.is_defined) {
            normal = normalize(rotate(rotation, normal));
        }
        staged_normals[3 * threadIdx.x] = normal.x;
        staged_normals[3 * threadIdx.x + 1] = normal.y;
        staged_normals[3 * threadIdx.x + 2] = normal.z;
#ifdef NORMAL_MAPS
        float4 packed_tangent = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (slot.first_tangent != NO_TANGENTS) {
            const float4 tangent = __ldg(args.rest_tangents + slot.first_tangent + (corner - slot.first_corner));
            float3 world_tangent = transform_direction(linear, make_double3(tangent.x, tangent.y, tangent.z));
            if (rotation.is_defined) {
                world_tangent = orthogonalize(rotate(rotation, world_tangent), normal);
            }
            packed_tangent = make_float4(world_tangent.x, world_tangent.y, world_tangent.z,
                                         tangent.w * (float)determinant_sign(linear));
        }
        args.header->tangents[corner] = packed_tangent;
#endif
    }
    __syncthreads();
    store_triples(args.header->normals, staged_normals, args.corner_count);
}
