// The transform T of a domain. With FOLLOWERS, a domain can be a follower of another domain, its transform root. T of a
// follower is the transform of the root times the follower's frame F, a constant transform relative to the root.
// CPU twin: src/model/domain/composed_transform.rs, which defines the order of operations; results are bit-identical.
#pragma once
#include "layout.cuh"

// The three rows of a transform.
struct Affine {
    float4 row0, row1, row2;
};

// Tables from which T is composed.
struct Transforms {
    const float4* rows; // [roots][3]: the three rows of T of each transform root
#ifdef FOLLOWERS
    const TransformLink* transform_links;
    const float4* follower_frames; // [followers][3]: the three rows of F of each follower
#endif
};

template <typename Args>
__device__ __forceinline__ Transforms transforms_of(const Args& args) {
#ifdef FOLLOWERS
    return {args.transforms, args.transform_links, args.follower_frames};
#else
    return {args.transforms};
#endif
}

// The transform with index `index` in a table of three rows per transform.
__device__ __forceinline__ Affine load_affine(const float4* table, unsigned index) {
    const float4* rows = table + 3 * (size_t)index;
    return {__ldg(rows), __ldg(rows + 1), __ldg(rows + 2)};
}

#ifdef FOLLOWERS
__device__ __forceinline__ TransformLink load_transform_link(const Transforms& transforms, unsigned domain) {
    const uint2 link = __ldg((const uint2*)(transforms.transform_links + domain));
    return {link.x, link.y};
}

// A row of T times a column (x, y, z) of the linear part of F.
__device__ __forceinline__ float dot_row_column(const float4& t, float x, float y, float z) {
    return fmaf(t.x, x, fmaf(t.y, y, __fmul_rn(t.z, z)));
}

// A row of T times F.
__device__ __forceinline__ float4 compose_row(const float4& t, const Affine& f) {
    return make_float4(dot_row_column(t, f.row0.x, f.row1.x, f.row2.x), dot_row_column(t, f.row0.y, f.row1.y, f.row2.y),
                       dot_row_column(t, f.row0.z, f.row1.z, f.row2.z), fmaf(t.x, f.row0.w,
                                                                             fmaf(t.y, f.row1.w, fmaf(t.z, f.row2.w, t.w))));
}
#endif

// T of a domain.
__device__ __forceinline__ Affine load_transform(const Transforms& transforms, unsigned domain) {
#ifdef FOLLOWERS
    const TransformLink link = load_transform_link(transforms, domain);
    const Affine t = load_affine(transforms.rows, link.root);
    if (link.frame == NO_FRAME) {
        return t;
    }
    const Affine f = load_affine(transforms.follower_frames, link.frame);
    return {compose_row(t.row0, f), compose_row(t.row1, f), compose_row(t.row2, f)};
#else
    return load_affine(transforms.rows, domain);
#endif
}

// A row of T times the point (x, y, z): one coordinate of the transformed point.
__device__ __forceinline__ float transform_row(const float4& row, float x, float y, float z) {
    return fmaf(row.x, x, fmaf(row.y, y, fmaf(row.z, z, row.w)));
}

// Multiplies the three rows of a transform by a point.
__device__ __forceinline__ void transform_point_f64(const float4* rows, const double (&point)[3], double (&world)[3]) {
    for (unsigned axis = 0; axis < 3; ++axis) {
        const float4 row = rows[axis];
        world[axis] = row.x * point[0] + row.y * point[1] + row.z * point[2] + row.w;
    }
}

// Transforms a point by T of a domain in f64 and rounds the result once. May overwrite `point`.
__device__ __forceinline__ float3 transform_domain_point_f64(const Transforms& transforms, unsigned domain,
                                                             double (&point)[3]) {
    double world[3];
#ifdef FOLLOWERS
    // Apply both transforms in sequence: their product may overflow f32.
    const TransformLink link = load_transform_link(transforms, domain);
    if (link.frame != NO_FRAME) {
        transform_point_f64(transforms.follower_frames + 3 * (size_t)link.frame, point, world);
        point[0] = world[0];
        point[1] = world[1];
        point[2] = world[2];
    }
    transform_point_f64(transforms.rows + 3 * (size_t)link.root, point, world);
#else
    transform_point_f64(transforms.rows + 3 * (size_t)domain, point, world);
#endif
    return make_float3((float)world[0], (float)world[1], (float)world[2]);
}
