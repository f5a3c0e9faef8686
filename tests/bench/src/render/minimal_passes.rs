//! Lower limit of the cost of drawing a mesh: the scene stripped to one opaque two-sided white material, so that the
//! depth of the map is one draw without a fragment shader, and ids and depth of the frame are one more draw. No
//! culling, images, holes, moments or ground: the commands of a minimal program, issued by the renderer.

use std::sync::Arc;

use serde::Serialize;

use crate::timing::Timing;
use modalcast_model::domain::Material;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, RenderSettings, Scene, SceneParts, ShadowMethod, ShadowSettings};
use modalcast_render::{FrameStats, Pass};

/// Times of both passes on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MinimalPasses {
    pub load: String,
    pub triangles: usize,
    /// Side of the depth map, texels.
    pub map: u32,
    /// Samples per pixel of ids and depth, as in the compared frames.
    pub samples: u32,
    pub depth: Timing,
    pub visibility: Timing,
    /// A frame without culling, like both passes. Its excess over both passes is the overhead of the renderer.
    pub unculled: FrameBaseline,
    /// A frame with the culling of the load's own look.
    pub usual: FrameBaseline,
}

/// A frame of the renderer with the same map, for comparison with both passes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameBaseline {
    /// Description of the variant.
    pub name: String,
    /// Time of the frame, microseconds.
    pub frame_us: f64,
    /// Time in excess of both bare passes, microseconds.
    pub beyond_us: f64,
}

impl MinimalPasses {
    /// Fills in each frame's excess over both passes.
    pub(super) fn compared(mut self) -> Self {
        let both = self.depth.median_us + self.visibility.median_us;
        for frame in [&mut self.unculled, &mut self.usual] {
            frame.beyond_us = frame.frame_us - both;
        }
        self
    }
}

/// Limit of the excess over both passes, microseconds, for a frame of three million triangles without culling on an
/// H200.
pub(super) const BEYOND_US: f64 = 600.0;

/// The scene with one material and a standard shadow map of this size.
///
/// # Errors
/// Only those that the scene itself would cause.
pub(super) fn stripped(scene: &Scene, map: u32) -> Result<Arc<Scene>> {
    let shadow = ShadowSettings { method: ShadowMethod::Standard, size: map, ..ShadowSettings::default() };
    let look = RenderSettings { shadow: Some(shadow), ground: None, bloom: None, culling: Culling::None, ..scene.look };
    let materials = vec![Material { double_sided: true, ..Material::default() }];
    let mut parts = SceneParts { look, materials, textures: Vec::new(), ..scene.parts() };
    for domain in &mut parts.domains {
        domain.material = 0;
        domain.material_ranges.clear();
    }
    Scene::new(parts)
}

/// Whether a frame consisted of one draw of ids and one of depth, without a pass that uses the depth.
pub(super) fn is_bare(stats: &FrameStats) -> bool {
    stats.draw_calls == 1 && stats.passes.starts_with(&[Pass::Shadow, Pass::Visibility])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::harness::{RenderHarness, Size};
    use crate::render::workloads::RenderWorkload;

    #[test]
    fn stripped_scene_is_one_draw_and_the_tree_is_not() {
        let mut studio = RenderHarness::open().expect("OpenGL");
        let stage = RenderWorkload::Tree.stage().expect("built");
        let bare = stripped(&stage.scene, 64).expect("stripped");
        assert_eq!(bare.layout.triangles, stage.scene.layout.triangles);
        assert!(!bare.needs.textures && !bare.needs.mask && !bare.needs.normal_maps);
        let size = Size { width: 32, height: 24 };
        let mut stats = |scene: &Arc<Scene>| {
            let mut set = studio.set(scene).expect("loaded");
            studio.pose(&mut set, &stage.state(0)).expect("posed");
            studio.draw(&set, stage.camera(size), size).expect("drawn");
            studio.unload(set);
            studio.renderer.stats().clone()
        };
        assert!(is_bare(&stats(&bare)));
        assert!(!is_bare(&stats(&stage.scene)), "control: leaves and bark are drawn apart");
    }
}
