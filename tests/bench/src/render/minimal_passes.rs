//! Times the minimal passes of a scene. They are a lower limit of the cost to draw its mesh: one draw of the shadow
//! map's depth without a fragment shader, and one draw of the frame's ids and depth.
//!
//! The scene is stripped to one opaque, two-sided, white material. Culling, images, cut-outs, shadow moments and the
//! ground are off.

use std::sync::Arc;

use serde::Serialize;

use crate::timing::Timing;
use modalcast_model::domain::Material;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, RenderSettings, Scene, SceneParts, ShadowMethod, ShadowSettings};
use modalcast_render::{FrameStats, Pass};

/// Times of both passes on one workload.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MinimalPasses {
    pub load: String,
    pub triangles: usize,
    /// Side of the depth map, texels.
    #[serde(rename = "map")]
    pub map_size: u32,
    /// Samples per pixel of ids and depth, as in the compared frames.
    pub samples: u32,
    pub depth: Timing,
    pub visibility: Timing,
    /// A frame without culling. Its excess over both passes is the overhead of the renderer.
    #[serde(rename = "unculled")]
    pub without_culling: FrameBaseline,
    /// A frame with the scene's own culling setting.
    #[serde(rename = "usual")]
    pub with_scene_culling: FrameBaseline,
}

/// A frame of the renderer with the same map, for comparison with both passes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameBaseline {
    /// The variant and its culling.
    pub name: String,
    /// Time of the frame, microseconds.
    pub frame_us: f64,
    /// Time in excess of both minimal passes, microseconds.
    #[serde(rename = "beyond_us")]
    pub excess_us: f64,
}

impl MinimalPasses {
    /// Fills in each frame's excess over both passes.
    pub(super) fn with_frame_excess(mut self) -> Self {
        let sum_us = self.depth.median_us + self.visibility.median_us;
        for frame in [&mut self.without_culling, &mut self.with_scene_culling] {
            frame.excess_us = frame.frame_us - sum_us;
        }
        self
    }
}

/// Target for a frame's excess over both passes, microseconds: three million triangles without culling on an H200. The
/// report prints the target and does not check it.
pub(super) const MAX_EXCESS_US: f64 = 600.0;

/// The scene with one material and a standard shadow map of `map_size` texels per side.
///
/// # Errors
/// Only those that the scene itself would cause.
pub(super) fn strip_to_mesh(scene: &Scene, map_size: u32) -> Result<Arc<Scene>> {
    let shadow = ShadowSettings { method: ShadowMethod::Standard, size: map_size, ..ShadowSettings::default() };
    let look = RenderSettings { shadow: Some(shadow), ground: None, bloom: None, culling: Culling::None, ..scene.look };
    let materials = vec![Material { double_sided: true, ..Material::default() }];
    let mut parts = SceneParts { look, materials, textures: Vec::new(), ..scene.parts() };
    for domain in &mut parts.domains {
        domain.material = 0;
        domain.material_ranges.clear();
    }
    Scene::new(parts)
}

/// Whether a frame began with the shadow pass and one draw of ids, without a blur between them. `draw_calls` does
/// not count the draws of the shadow pass.
pub(super) fn is_minimal(stats: &FrameStats) -> bool {
    stats.draw_calls == 1 && stats.passes.starts_with(&[Pass::Shadow, Pass::Visibility])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::harness::{RenderHarness, Size};
    use crate::render::workloads::RenderWorkload;

    #[test]
    fn stripped_scene_needs_one_draw_and_the_tree_several() {
        let mut harness = RenderHarness::open().expect("OpenGL");
        let animation = RenderWorkload::Tree.build().expect("a workload");
        let stripped_scene = strip_to_mesh(&animation.scene, 64).expect("a stripped scene");
        assert_eq!(stripped_scene.layout.triangles, animation.scene.layout.triangles);
        assert!(
            !stripped_scene.features.textures && !stripped_scene.features.mask && !stripped_scene.features.normal_maps
        );
        let size = Size { width: 32, height: 24 };
        let mut frame_stats = |scene: &Arc<Scene>| {
            let mut loaded_scene = harness.load(scene).expect("a loaded scene");
            harness.deform(&mut loaded_scene, &animation.state(0)).expect("deformed vertices");
            harness.draw(&loaded_scene, animation.camera(size), size).expect("a frame");
            harness.unload(loaded_scene);
            harness.renderer.stats().clone()
        };
        assert!(is_minimal(&frame_stats(&stripped_scene)));
        assert!(!is_minimal(&frame_stats(&animation.scene)), "control: leaves and bark need separate draws");
    }
}
