//! What drawing a mesh costs when there is nothing else: the same scene stripped to one opaque two-sided white material, so
//! that the depth of the map is one draw without a fragment shader, and ids and depth of the frame are one draw more. No
//! culling, no images, no holes, no moments, no ground: what a minimal program would issue, by the renderer's own commands.

use std::sync::Arc;

use serde::Serialize;

use crate::timing::Timing;
use modalcast_model::domain::Material;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, Look, Parts, Scene, Shadow, ShadowMethod};
use modalcast_render::Ran;

/// Both passes on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Bare {
    pub load: String,
    pub triangles: usize,
    /// Side of the map that depth is drawn into, and samples a pixel of ids and depth: those of the frames beside it.
    pub map: u32,
    pub samples: u32,
    pub depth: Timing,
    pub visibility: Timing,
    /// The frame that is as little culled as both passes: what it takes beyond them is what the renderer adds.
    pub unculled: Beside,
    /// The frame as the load's own look culls it.
    pub usual: Beside,
}

/// A frame of the renderer with the same map that both passes are held against.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Beside {
    /// What is drawn, in words.
    pub name: String,
    /// Microseconds: its frame, and what that takes beyond both passes.
    pub frame_us: f64,
    pub beyond_us: f64,
}

impl Bare {
    /// The same with what each frame takes beyond both passes.
    pub(super) fn compared(mut self) -> Self {
        let both = self.depth.median_us + self.visibility.median_us;
        for frame in [&mut self.unculled, &mut self.usual] {
            frame.beyond_us = frame.frame_us - both;
        }
        self
    }
}

/// Microseconds beyond both passes that a frame without culling of three million triangles may take on an H200.
pub(super) const BEYOND_US: f64 = 600.0;

/// The scene with one material and a plain depth map of this size.
///
/// # Errors
/// None that the scene itself would not have caused.
pub(super) fn stripped(scene: &Scene, map: u32) -> Result<Arc<Scene>> {
    let shadow = Shadow { method: ShadowMethod::Standard, size: map, ..Shadow::default() };
    let look = Look { shadow: Some(shadow), ground: None, bloom: None, culling: Culling::None, ..scene.look };
    let materials = vec![Material { double_sided: true, ..Material::default() }];
    let mut parts = Parts { look, materials, textures: Vec::new(), ..scene.parts() };
    for domain in &mut parts.domains {
        domain.material = 0;
        domain.runs.clear();
    }
    Scene::new(parts)
}

/// Whether a frame was one draw into ids, and one into a depth that nothing was made of.
pub(super) fn is_bare(ran: &Ran) -> bool {
    ran.draws == 1 && ran.passes.starts_with(&["shadow", "visibility"])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::loads::Kind;
    use crate::render::studio::{Size, Studio};

    #[test]
    fn a_stripped_scene_has_all_triangles_in_one_draw_and_the_tree_itself_has_more() {
        let mut studio = Studio::open().expect("OpenGL");
        let stage = Kind::Tree.stage().expect("built");
        let bare = stripped(&stage.scene, 64).expect("stripped");
        assert_eq!(bare.layout.triangles, stage.scene.layout.triangles);
        assert!(!bare.needs.textures && !bare.needs.mask && !bare.needs.normal_maps);
        let size = Size { width: 32, height: 24 };
        let mut ran = |scene: &Arc<Scene>| {
            let mut set = studio.set(scene).expect("loaded");
            studio.pose(&mut set, &stage.state(0)).expect("posed");
            studio.draw(&set, stage.camera(size), size).expect("drawn");
            studio.strike(set);
            studio.renderer.ran().clone()
        };
        assert!(is_bare(&ran(&bare)));
        assert!(!is_bare(&ran(&stage.scene)), "control: leaves and bark are drawn apart");
    }
}
