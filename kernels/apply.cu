// First kernel of a partial step, which changes only some domains. Copies their new transforms T and coordinates q from
// pinned host memory to the tables of all domains in device memory, and records the step in which each domain changed.
// Also copies the list of tiles that `deform` then computes (layout.cuh defines tiles).
//   header           number of changes, number of dirty tiles, and number of the step                   (in)
//   changes          [change_count] `Change`, one per changed domain                                    (in)
//   new_transforms   [change_count][3] float4: the rows of each new T                                   (in)
//   new_q            the new coordinates, one changed domain after the other                            (in)
//   dirty_tiles      [dirty_tile_count] u32: indices of the tiles that this step computes               (in)
//   transform_links  with FOLLOWERS, [domains]: the domain's transform root (the domain whose T it uses), and the index
//                    of its frame (its constant transform relative to the root), or NO_FRAME for a root (in)
//   transforms       [transform roots][3] float4: the rows of T                                         (out)
//   q                the coordinates of all domains                                                     (out)
//   change_steps     [domains] u32: the step that last changed the domain                               (out)
//   tile_list        [dirty_tile_count] u32: copy of `dirty_tiles` in device memory                     (out)
// Launch: BLOCK threads per block, a warp per changed domain, any number of blocks. CPU twin: SceneState::apply.
// SceneState is in src/model/scene/state.rs.
#include "layout.cuh"

extern "C" __global__ void __launch_bounds__(BLOCK) apply(const __grid_constant__ ApplyArgs args) {
    const unsigned lane = threadIdx.x % 32, warp_count = gridDim.x * (BLOCK / 32);
    const unsigned change_count = args.header->change_count;
    for (unsigned index = blockIdx.x * (BLOCK / 32) + threadIdx.x / 32; index < change_count; index += warp_count) {
        const Change change = args.changes[index];
#ifdef FOLLOWERS
        // A follower (a domain that uses the T of another domain) has no T of its own. The kernel ignores the transform
        // of its entry, and updates only its coordinates and its change step.
        const TransformLink link = args.transform_links[change.domain];
        const unsigned root = link.root;
        const bool has_transform = link.frame == NO_FRAME;
#else
        const unsigned root = change.domain;
        const bool has_transform = true;
#endif
        if (has_transform && lane < 3) {
            args.transforms[3 * (size_t)root + lane] = args.new_transforms[3 * (size_t)index + lane];
        }
        if (lane == 3) {
            args.change_steps[change.domain] = args.header->step;
        }
        for (unsigned i = lane; i < change.q_count; i += 32) {
            args.q[change.first_q + i] = args.new_q[change.first_new_q + i];
        }
    }
    const unsigned dirty_tile_count = args.header->dirty_tile_count;
    for (unsigned i = blockIdx.x * BLOCK + threadIdx.x; i < dirty_tile_count; i += gridDim.x * BLOCK) {
        args.tile_list[i] = args.dirty_tiles[i];
    }
}
