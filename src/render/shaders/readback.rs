//! Shader sources of readbacks on request: picks, AOVs and visibility ids.

use super::{
    BAND, BARYCENTRICS, CLIP, FRAME, GROUND_PLANE, ProgramSource, ShaderOptions, TRIANGLE_FETCH, VERSION,
    VISIBILITY_IDS,
};
use crate::layout::WORKGROUP_SIZE;

impl ShaderOptions {
    /// Computes an AOV field from the ids. `field`: `DEPTH`, `DEPTH_WITH_GROUND` or `NORMALS` (one sample per pixel),
    /// or `VALUES` (all samples).
    pub(crate) fn aov(&self, field: &'static str, samples: u32) -> ProgramSource {
        let mut text = format!("{VERSION}#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n#define {field}\n");
        let has_ground = field == "DEPTH_WITH_GROUND" && self.features.ground;
        text += if has_ground { "#define HAS_GROUND\n" } else { "" };
        text += &self.sample_defines(samples);
        let body = include_str!("../../../shaders/aov.comp");
        text += &[BAND, FRAME, CLIP, VISIBILITY_IDS, GROUND_PLANE, BARYCENTRICS, TRIANGLE_FETCH, body].concat();
        ProgramSource::compute(format!("aov {field}, {samples} samples"), text)
    }
}

/// Copies id, corners, positions and normals of the triangles that are visible in a rectangle of pixels.
pub(crate) fn pick() -> ProgramSource {
    let head = format!("{VERSION}#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n#define SAMPLES 1\n");
    let body = [&head, VISIBILITY_IDS, BARYCENTRICS, include_str!("../../../shaders/pick.comp")].concat();
    ProgramSource::compute("pick", body)
}

/// Packs the ids of each pixel's first sample.
pub(crate) fn visibility_readback(samples: u32) -> ProgramSource {
    let head = format!("{VERSION}#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n#define SAMPLES {samples}\n");
    let body = [&head, BAND, VISIBILITY_IDS, include_str!("../../../shaders/visibility_readback.comp")].concat();
    ProgramSource::compute(format!("visibility readback, {samples} samples"), body)
}
