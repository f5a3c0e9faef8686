//! Selects the culling method of a scene, and sizes the buffers of the culling passes.

use super::buffers::CullBuffers;
use crate::device::gl::Limits;
use crate::layout::cull::{CULL_COUNTER_BYTES, CullUniforms};
use crate::pass::Pass;
use crate::scene_data::geometry::groups;
use modalcast_model::scene::{Culling, Scene};

/// Minimum number of triangles of a scene that is culled on hardware by default. It lies between two measurements of a
/// benchmark scene (at `select_culling`): culling is slower with 262,144 triangles, and faster with 3 M.
const MIN_TRIANGLES: usize = 1 << 20;

/// Selects the culling method of a scene on a device: the method that the scene names, or for `Auto` the faster one.
/// `None` if the lists of visible triangles exceed the largest buffer of the device.
///
/// Milliseconds per frame on hardware (H200, 1080p). The field is a scene of the benchmarks. The almond tree has
/// double-sided leaves and four samples per pixel.
///
/// | scene | triangles | `None` | `Triangles` | `Occlusion` |
/// |---|---:|---:|---:|---:|
/// | field | 3 M | 6.32 | 5.78 | more than 5.78 |
/// | field | 262,144 | 2.04 | 2.08 | 2.76 |
/// | almond tree | 37,560 | 1.57 | 1.59 | 2.09 |
///
/// In software, culling is slower: on two cores, the visibility pass of the almond tree (1080p, four samples) takes 80
/// ms with `None` and 83 ms with `Triangles`, which culls 3 % of the triangles. With `Occlusion` it takes four times as
/// long.
pub(crate) fn select_culling(scene: &Scene, limits: &Limits) -> Culling {
    let software = limits.software;
    let selected = match scene.look.culling {
        Culling::Auto if software || scene.layout.triangles < MIN_TRIANGLES => Culling::None,
        Culling::Auto => Culling::Triangles,
        Culling::Occlusion if software && interpolates_at_centroid(scene) => Culling::Triangles,
        explicit => explicit,
    };
    let sizes = cull_buffer_sizes(scene, selected);
    let fits = sizes.iter().flat_map(CullBuffers::named).all(|(_, bytes)| *bytes <= limits.max_storage_bytes);
    if fits { selected } else { Culling::None }
}

/// Whether cut-outs sample a texture at the centroid of their covered samples. Mesa's rasterizer takes the centroid of
/// the samples that also pass the depth test. A hidden triangle that is drawn first makes samples fail that test, so
/// its culling moves the centroid in about one pixel of a million.
fn interpolates_at_centroid(scene: &Scene) -> bool {
    scene.look.samples_per_pixel() > 1 && scene.features.mask && scene.features.textures
}

/// The culling passes for the camera, in execution order.
pub(crate) fn cull_passes(culling: Culling) -> &'static [Pass] {
    match culling {
        Culling::Occlusion => &[Pass::Occluders, Pass::Cull],
        Culling::Triangles => &[Pass::Cull],
        Culling::None | Culling::Auto => &[],
    }
}

/// Sizes of the culling buffers of a scene in bytes; `None` without culling.
pub(crate) fn cull_buffer_sizes(scene: &Scene, culling: Culling) -> Option<CullBuffers<u64>> {
    if culling == Culling::None {
        return None;
    }
    let (groups, _) = groups(scene);
    // The subpixel step, here 0, is irrelevant to the sizes.
    let uniforms = CullUniforms::new(&groups, 0.0);
    let (triangles, bitmap_bytes) = (scene.layout.triangles as u64, uniforms.bitmap_bytes() as u64);
    Some(CullBuffers {
        uniforms: size_of::<CullUniforms>() as u64,
        draws: uniforms.draws_bytes() as u64,
        counters: CULL_COUNTER_BYTES as u64,
        visible_bits: bitmap_bytes,
        triangle_ids: 4 * triangles,
        indices: 12 * triangles,
        previously_visible: (culling == Culling::Occlusion).then_some(bitmap_bytes),
    })
}
