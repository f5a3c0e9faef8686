//! Shader sources of the culling passes.

use std::fmt::Write as _;

use super::super::gl;
use super::super::shaders::{FRAME, IDS, Options, Source};
use super::layout::{GROUPS, LANES, SUPER};
use super::pyramid::TOP;

const CULL: &str = include_str!("../../../shaders/shared/cull.glsl");

/// First word of each view's counts.
pub(super) const CAMERA_COUNTS: usize = 0;
pub(super) const SUN_COUNTS: usize = 5;

impl Options {
    /// Tests which triangles the camera may see; with occlusion culling also against the depth pyramid.
    pub(super) fn sift(&self, samples: u32) -> Source {
        let more: &[&str] = if self.hides() { &["HIDDEN"] } else { &[] };
        let head = self.cull_head(more) + &format!("#define FIRST_COUNT {CAMERA_COUNTS}\n") + &self.sampling(samples);
        let body = include_str!("../../../shaders/sift.comp");
        compute(format!("sift, {samples} samples"), [&head, FRAME, CULL, body].concat())
    }

    /// Tests which triangles may cast a shadow.
    pub(super) fn sift_sun(&self) -> Source {
        let head = self.cull_head(&["SUN"]) + &format!("#define FIRST_COUNT {SUN_COUNTS}\n") + &self.sampling(1);
        let body = include_str!("../../../shaders/sift.comp");
        compute("sift, sun".into(), [&head, FRAME, self.splits(), CULL, body].concat())
    }

    /// Selects the triangles that the last frame saw.
    pub(super) fn sift_remembered(&self) -> Source {
        let head = self.cull_head(&["REMEMBERED"]);
        compute("sift, remembered".into(), [&head, CULL, include_str!("../../../shaders/sift.comp")].concat())
    }

    /// Compacts the selected triangles to index lists.
    pub(super) fn list(&self) -> Source {
        let head = self.cull_head(&[]);
        compute("list".into(), [&head, CULL, include_str!("../../../shaders/list.comp")].concat())
    }

    /// Records which triangles the ids of a frame name.
    pub(super) fn remember(&self, samples: u32) -> Source {
        let head = self.cull_head(&[]) + &self.sampling(samples);
        let body = include_str!("../../../shaders/remember.comp");
        compute(format!("remember, {samples} samples"), [&head, IDS, CULL, body].concat())
    }

    /// Builds the first levels of the depth pyramid, or the remaining ones from them.
    pub(super) fn pyramid(&self, samples: u32, first: bool) -> Source {
        let head = self.cull_head(if first { &["FIRST"] } else { &[] }) + &self.sampling(samples);
        let label = format!("pyramid, {samples} samples, {}", if first { "fine" } else { "coarse" });
        compute(label, head + include_str!("../../../shaders/pyramid.comp"))
    }

    /// Whether triangles are culled at all.
    pub(crate) fn culls(&self) -> bool {
        self.defines.contains(&"CULLED")
    }

    /// Whether occlusion culling is on.
    pub(crate) fn hides(&self) -> bool {
        self.defines.contains(&"REMEMBERS")
    }

    fn cull_head(&self, more: &[&str]) -> String {
        let mut head = String::from("#version 430 core\n");
        let splits = self.defines.iter().filter(|define| define.starts_with("SPLITS"));
        for define in splits.chain(more) {
            writeln!(head, "#define {define}").ok();
        }
        writeln!(head, "#define LANES {LANES}\n#define SUPER {SUPER}u\n#define GROUPS {GROUPS}").ok();
        writeln!(head, "#define TOP {TOP}u").ok();
        head
    }
}

fn compute(label: String, text: String) -> Source {
    Source { label, stages: vec![(gl::COMPUTE_SHADER, text)] }
}
