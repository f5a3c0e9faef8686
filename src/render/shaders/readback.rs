//! Shader sources of outputs that are drawn only on request: picks and AOV readbacks.

use super::{BARYCENTRICS, CLIP, FRAME, ProgramSource, ShaderOptions, VISIBILITY_IDS, WORKGROUP_SIZE};
use crate::device::gl;

impl ShaderOptions {
    /// Reads an AOV field from the ids: `DEPTH` and `NORMALS` of one sample per pixel, `VALUES` of all samples.
    pub(crate) fn aov(&self, field: &'static str, samples: u32) -> ProgramSource {
        let mut text = format!("#version 430 core\n#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n#define {field}\n");
        // Only the depth field draws the ground, and only if the look has one.
        let has_ground = field == "DEPTH" && self.defines.contains(&"HAS_GROUND");
        text += if has_ground { "#define HAS_GROUND\n" } else { "" };
        text += &self.sample_defines(samples);
        text += &[FRAME, CLIP, VISIBILITY_IDS, BARYCENTRICS, include_str!("../../../shaders/aov.comp")].concat();
        ProgramSource { label: format!("aov {field}, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }
}

/// Reads back the triangles of a few pixels.
pub(crate) fn pick() -> ProgramSource {
    let head = format!("#version 430 core\n#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n#define SAMPLES 1\n");
    let body = [&head, VISIBILITY_IDS, BARYCENTRICS, include_str!("../../../shaders/pick.comp")].concat();
    ProgramSource { label: "pick".into(), stages: vec![(gl::COMPUTE_SHADER, body)] }
}
