//! Shader sources of the culling passes.

use std::fmt::Write as _;

use super::super::shaders::{FRAME, ProgramSource, ShaderOptions, VISIBILITY_IDS};
use super::blocks::{MAX_GROUPS, SUPERBLOCK, WORKGROUP_SIZE};
use super::pyramid::MAX_LEVEL;
use crate::device::gl;

const CULL: &str = include_str!("../../../shaders/shared/cull.glsl");

/// First word of each view's counts.
pub(crate) const CAMERA_COUNTERS: usize = 0;
pub(crate) const SHADOW_COUNTERS: usize = 5;

impl ShaderOptions {
    /// Tests which triangles the camera may see; with occlusion culling also against the depth pyramid.
    pub(crate) fn cull_triangles(&self, samples: u32) -> ProgramSource {
        let more: &[&str] = if self.has_occlusion_culling() { &["CULL_OCCLUDED"] } else { &[] };
        let head = self.cull_head(more)
            + &format!("#define FIRST_COUNTER {CAMERA_COUNTERS}\n")
            + &self.sample_defines(samples);
        let body = include_str!("../../../shaders/cull_triangles.comp");
        compute(format!("cull triangles, {samples} samples"), [&head, FRAME, CULL, body].concat())
    }

    /// Tests which triangles may cast a shadow.
    pub(crate) fn cull_casters(&self) -> ProgramSource {
        let head = self.cull_head(&["CULL_SHADOW"])
            + &format!("#define FIRST_COUNTER {SHADOW_COUNTERS}\n")
            + &self.sample_defines(1);
        let body = include_str!("../../../shaders/cull_triangles.comp");
        compute("cull triangles, shadow".into(), [&head, FRAME, self.splits(), CULL, body].concat())
    }

    /// Selects the triangles that the last frame saw.
    pub(crate) fn cull_previously_visible(&self) -> ProgramSource {
        let head = self.cull_head(&["CULL_PREVIOUS"]);
        compute(
            "cull triangles, previous".into(),
            [&head, CULL, include_str!("../../../shaders/cull_triangles.comp")].concat(),
        )
    }

    /// Compacts the selected triangles to index lists.
    pub(crate) fn compact(&self) -> ProgramSource {
        let head = self.cull_head(&[]);
        compute("cull compact".into(), [&head, CULL, include_str!("../../../shaders/cull_compact.comp")].concat())
    }

    /// Records which triangles the ids of a frame name.
    pub(crate) fn record_visible(&self, samples: u32) -> ProgramSource {
        let head = self.cull_head(&[]) + &self.sample_defines(samples);
        let body = include_str!("../../../shaders/cull_record_visible.comp");
        compute(format!("cull record visible, {samples} samples"), [&head, VISIBILITY_IDS, CULL, body].concat())
    }

    /// Builds the first levels of the depth cull depth pyramid, or the remaining ones from them.
    pub(crate) fn pyramid(&self, samples: u32, first: bool) -> ProgramSource {
        let head = self.cull_head(if first { &["FROM_DEPTH"] } else { &[] }) + &self.sample_defines(samples);
        let label = format!("cull depth pyramid, {samples} samples, {}", if first { "fine" } else { "coarse" });
        compute(label, head + include_str!("../../../shaders/cull_depth_pyramid.comp"))
    }

    /// Whether triangles are culled at all.
    pub(crate) fn has_culling(&self) -> bool {
        self.defines.contains(&"CULLED")
    }

    /// Whether occlusion culling is on.
    pub(crate) fn has_occlusion_culling(&self) -> bool {
        self.defines.contains(&"OCCLUSION_CULLING")
    }

    fn cull_head(&self, more: &[&str]) -> String {
        let mut head = String::from("#version 430 core\n");
        let splits = self.defines.iter().filter(|define| define.starts_with("CASCADES"));
        for define in splits.chain(more) {
            writeln!(head, "#define {define}").ok();
        }
        writeln!(
            head,
            "#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n#define SUPERBLOCK {SUPERBLOCK}u\n#define MAX_GROUPS {MAX_GROUPS}"
        )
        .ok();
        writeln!(head, "#define MAX_LEVEL {MAX_LEVEL}u").ok();
        head
    }
}

fn compute(label: String, text: String) -> ProgramSource {
    ProgramSource { label, stages: vec![(gl::COMPUTE_SHADER, text)] }
}
