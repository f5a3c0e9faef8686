// Writes the transforms and coordinates of the changed domains into the device state and records the step in which they
// changed.
//   header           number of changes, number of dirty tiles, and the step                             (in)
//   changes          [change_count]                                                                     (in)
//   new_transforms   [change_count][3] float4                                                           (in)
//   new_q            the coordinates of the changed domains, packed                                     (in)
//   dirty_tiles      [dirty_tile_count] u32: the tiles that contain a changed domain                    (in)
//   transform_links  with FOLLOWERS: per domain its transform root (the domain whose transform it uses), and the
//                    index of its frame, or NO_FRAME for a root                                         (in)
//   transforms       [transform roots][3] float4                                                        (out)
//   q                packed coordinates of all domains                                                  (out)
//   change_steps     [domains] u32: the step that last changed a domain                                 (out)
//   tile_list        [dirty_tile_count] u32: copy of `dirty_tiles` in device memory                     (out)
// Launch: BLOCK threads per block, a warp per changed domain, any number of blocks. CPU twin: SceneState::apply.
#include "layout.cuh"

extern "C" __global__ void __launch_bounds__(BLOCK) apply(const __grid_constant__ ApplyArgs args) {
    const unsigned lane = threadIdx.x % 32, warp_count = gridDim.x * (BLOCK / 32);
    const unsigned change_count = args.header->change_count;
    for (unsigned index = blockIdx.x * (BLOCK / 32) + threadIdx.x / 32; index < change_count; index += warp_count) {
        const Change change = args.changes[index];
#ifdef FOLLOWERS
        // A follower has a frame but no transform of its own. Its entry updates only its coordinates and its change step.
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
