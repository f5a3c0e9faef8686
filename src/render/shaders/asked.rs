//! Shader sources of outputs that are drawn only on request: picks and AOV readbacks.

use super::{CLIP, FRAME, IDS, LANES, Options, SHARES, Source};
use crate::gl;

impl Options {
    /// Reads an AOV field from the ids: `DEPTH` and `NORMALS` of one sample per pixel, `VALUES` of all samples.
    pub(crate) fn survey(&self, field: &'static str, samples: u32) -> Source {
        let mut text = format!("#version 430 core\n#define LANES {LANES}\n#define {field}\n");
        // Only the depth field draws the ground, and only if the look has one.
        let has_ground = field == "DEPTH" && self.defines.contains(&"GROUND_SEEN");
        text += if has_ground { "#define GROUND_SEEN\n" } else { "" };
        text += &self.sampling(samples);
        text += &[FRAME, CLIP, IDS, SHARES, include_str!("../../../shaders/survey.comp")].concat();
        Source { label: format!("survey of {field}, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }
}

/// Reads back the triangles of a few pixels.
pub(crate) fn pick() -> Source {
    let head = format!("#version 430 core\n#define LANES {LANES}\n#define SAMPLES 1\n");
    let body = [&head, IDS, SHARES, include_str!("../../../shaders/pick.comp")].concat();
    Source { label: "pick".into(), stages: vec![(gl::COMPUTE_SHADER, body)] }
}
