//! Shader sources of the culling passes.

use std::fmt::Write as _;

use super::{FRAME, ProgramSource, ShaderOptions, VERSION, VISIBILITY_IDS};
use crate::layout::cull::{CAMERA_COUNTERS, MAX_GROUPS, MAX_LEVEL, SHADOW_COUNTERS, SUPERBLOCK, TRIANGLES_PER_BLOCK};

const CULL: &str = include_str!("../../../shaders/shared/cull.glsl");

impl ShaderOptions {
    /// Tests which triangles the camera may see. With occlusion culling, also tests them against the depth pyramid.
    pub(crate) fn cull_triangles(&self, samples: u32) -> ProgramSource {
        let defines: &[&str] = if self.features.has_occlusion_culling() { &["CULL_OCCLUDED"] } else { &[] };
        let head = self.cull_head(defines)
            + &format!("#define FIRST_COUNTER {CAMERA_COUNTERS}\n")
            + &self.sample_defines(samples);
        let body = include_str!("../../../shaders/cull_triangles.comp");
        ProgramSource::compute(format!("cull triangles, {samples} samples"), [&head, FRAME, CULL, body].concat())
    }

    /// Tests which triangles may cast a shadow.
    pub(crate) fn cull_casters(&self) -> ProgramSource {
        let head = self.cull_head(&["CULL_SHADOW"])
            + &format!("#define FIRST_COUNTER {SHADOW_COUNTERS}\n")
            + &self.sample_defines(1);
        let body = include_str!("../../../shaders/cull_triangles.comp");
        ProgramSource::compute("cull triangles, shadow", [&head, FRAME, self.cascade_source(), CULL, body].concat())
    }

    /// Selects the triangles that were visible in the last frame.
    pub(crate) fn cull_previously_visible(&self) -> ProgramSource {
        let head = self.cull_head(&["CULL_PREVIOUS"]);
        ProgramSource::compute(
            "cull triangles, previous",
            [&head, CULL, include_str!("../../../shaders/cull_triangles.comp")].concat(),
        )
    }

    /// Compacts the selected triangles to index lists.
    pub(crate) fn cull_compact(&self) -> ProgramSource {
        let head = self.cull_head(&[]);
        ProgramSource::compute(
            "cull compact",
            [&head, CULL, include_str!("../../../shaders/cull_compact.comp")].concat(),
        )
    }

    /// Records the triangles that are visible in a frame.
    pub(crate) fn record_visible(&self, samples: u32) -> ProgramSource {
        let head = self.cull_head(&[]) + &self.sample_defines(samples);
        let body = include_str!("../../../shaders/cull_record_visible.comp");
        ProgramSource::compute(
            format!("cull record visible, {samples} samples"),
            [&head, VISIBILITY_IDS, CULL, body].concat(),
        )
    }

    /// Builds the first levels of the depth pyramid from the depth; or, unless `is_first_dispatch`, the remaining
    /// levels.
    pub(crate) fn depth_pyramid(&self, samples: u32, is_first_dispatch: bool) -> ProgramSource {
        let head =
            self.cull_head(if is_first_dispatch { &["FROM_DEPTH"] } else { &[] }) + &self.sample_defines(samples);
        let label =
            format!("cull depth pyramid, {samples} samples, {}", if is_first_dispatch { "fine" } else { "coarse" });
        ProgramSource::compute(label, head + include_str!("../../../shaders/cull_depth_pyramid.comp"))
    }

    /// Version and defines of a culling shader.
    fn cull_head(&self, defines: &[&str]) -> String {
        let mut head = String::from(VERSION);
        for define in self.features.cascade_define().iter().chain(defines) {
            writeln!(head, "#define {define}").ok();
        }
        writeln!(
            head,
            "#define WORKGROUP_SIZE {TRIANGLES_PER_BLOCK}\n#define SUPERBLOCK {SUPERBLOCK}u\n#define MAX_GROUPS {MAX_GROUPS}"
        )
        .ok();
        writeln!(head, "#define MAX_LEVEL {MAX_LEVEL}u").ok();
        head
    }
}
