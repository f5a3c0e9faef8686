// Writes the transforms and coordinates of the changed domains into the device state and stamps the domains with the
// step.
//   header          number of changes, and the step                      (in)
//   changes         [changed]                                            (in)
//   new_transforms  [changed][3] float4                                  (in)
//   new_q           the coordinates of the changed domains, packed       (in)
//   following       with FOLLOWERS: per domain its transform root, and its frame, if any    (in)
//   transforms, q   of all transform roots, and of all domains           (out)
//   stale           [stale] u32: the tiles that contain a changed domain (in)
//   stamps          [domains] u32: the step that last changed a domain   (out)
//   list            [stale] u32: copy of `dirty_tiles` in device memory        (out)
// Launch: BLOCK threads per block, a warp per changed domain, any number of blocks. CPU twin: SceneState::apply.
#include "layout.cuh"

extern "C" __global__ void __launch_bounds__(BLOCK) apply(const __grid_constant__ ApplyArgs args) {
    const unsigned lane = threadIdx.x % 32, warps = gridDim.x * (BLOCK / 32);
    const unsigned changed = args.header->changed;
    for (unsigned index = blockIdx.x * (BLOCK / 32) + threadIdx.x / 32; index < changed; index += warps) {
        const Change change = args.changes[index];
#ifdef FOLLOWERS
        // A follower is in the list only for its coordinates or its stamp.
        const TransformLink own = args.transform_links[change.domain];
        const unsigned root = own.root;
        const bool moves = own.frame == NO_FRAME;
#else
        const unsigned root = change.domain;
        const bool moves = true;
#endif
        if (moves && lane < 3) {
            args.transforms[3 * (size_t)root + lane] = args.new_transforms[3 * (size_t)index + lane];
        }
        if (lane == 3) {
            args.change_steps[change.domain] = args.header->step;
        }
        for (unsigned i = lane; i < change.count; i += 32) {
            args.q[change.first_q + i] = args.new_q[change.source + i];
        }
    }
    const unsigned dirty_tiles = args.header->dirty_tiles;
    for (unsigned i = blockIdx.x * BLOCK + threadIdx.x; i < dirty_tiles; i += gridDim.x * BLOCK) {
        args.list[i] = args.dirty_tiles[i];
    }
}
