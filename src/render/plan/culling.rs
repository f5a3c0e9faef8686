//! Selects the culling method of a scene, and sizes the buffers of the culling passes.

use super::buffers::CullBuffers;
use crate::device::gl::Limits;
use crate::layout::cull::{COUNTER_BYTES, CullUniforms};
use crate::pass::Pass;
use crate::scene_data::geometry::groups;
use modalcast_model::scene::{Culling, Scene};

/// Number of triangles from which a scene is culled on hardware by default; lies between the measurements given at
/// `select_culling`.
const MIN_TRIANGLES: usize = 1 << 20;

/// Culling method of a scene on a device: the look's choice, or the one that suits both. None if the lists exceed the
/// largest buffer of the device.
///
/// On hardware (H200, 1080p), a field of 3 M triangles takes 6.32 ms per frame without culling, 5.78 ms with the test
/// for samples, and more with occlusion culling. A field of 262,144 triangles takes 2.04 ms without culling, 2.08 ms
/// and 2.76 ms with the two methods; the almond tree (37,560 triangles, double-sided leaves, four samples) takes 1.57
/// ms without, 1.59 ms and 2.09 ms with them. Culling does not pay for the two smaller scenes.
///
/// In software it does not pay either: on two cores, the visibility pass of the almond tree (37,560 triangles, 1080p,
/// four samples) takes 83 ms instead of 80 ms when the 3 % of triangles without a sample are culled, and four times as
/// long with occlusion culling.
pub(crate) fn select_culling(scene: &Scene, limits: &Limits) -> Culling {
    let software = limits.software;
    let wanted = match scene.look.culling {
        Culling::Auto if software || scene.layout.triangles < MIN_TRIANGLES => Culling::None,
        Culling::Auto => Culling::Triangles,
        Culling::Occlusion if software && interpolates_at_centroid(scene) => Culling::Triangles,
        named => named,
    };
    let sizes = cull_buffer_sizes(scene, wanted);
    let fits = sizes.iter().flat_map(CullBuffers::named).all(|(_, bytes)| *bytes <= limits.max_storage_bytes);
    if fits { wanted } else { Culling::None }
}

/// Whether cut-outs sample a texture at the centroid of their covered samples. Mesa's rasterizer takes the centroid of
/// the samples that also pass the depth test. Hidden triangles drawn earlier thus move the centroid, and about one
/// pixel in a million differs when they are culled.
fn interpolates_at_centroid(scene: &Scene) -> bool {
    scene.look.samples_per_pixel() > 1 && scene.features.mask && scene.features.textures
}

/// The passes of the camera's lists, in execution order.
pub(crate) fn cull_passes(culling: Culling) -> &'static [Pass] {
    match culling {
        Culling::Occlusion => &[Pass::Occluders, Pass::Cull],
        Culling::Triangles => &[Pass::Cull],
        Culling::None | Culling::Auto => &[],
    }
}

/// Sizes of the buffers of a culled scene; none without culling.
pub(crate) fn cull_buffer_sizes(scene: &Scene, culling: Culling) -> Option<CullBuffers<u64>> {
    if culling == Culling::None {
        return None;
    }
    let (uniforms, triangles) = (CullUniforms::new(&groups(scene).0, 0.0), scene.layout.triangles as u64);
    let bits = uniforms.mask_bytes() as u64;
    Some(CullBuffers {
        uniforms: size_of::<CullUniforms>() as u64,
        draws: uniforms.draws_bytes() as u64,
        counters: COUNTER_BYTES as u64,
        visible_bits: bits,
        triangle_ids: 4 * triangles,
        indices: 12 * triangles,
        previously_visible: (culling == Culling::Occlusion).then_some(bits),
    })
}
