//! Settings of the backends: which implementation computes a scene, and how. They are not part of a
//! [`Scene`], because they do not define its result: they change run time and memory; they change
//! vertices and images only by rounding. Rounding can decide whether a triangle covers a sample next to its edge.

use crate::scene::{DeformationSettings, RenderSettings, Scene};

/// The rasterizer of the shadow depth pass and the visibility pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RasterPolicy {
    /// The compute rasterizer draws the shadow map where it is known to be faster ([`RasterFacts`]), and OpenGL
    /// everything else.
    #[default]
    Auto,
    /// OpenGL's rasterizer, the reference.
    OpenGl,
    /// The compute rasterizer in CUDA. It requires that CUDA and OpenGL use the same device. It draws the depth pass of
    /// variance shadow maps with one cascade, and the visibility pass of frames with one sample per pixel and no
    /// blended triangles. OpenGL draws everything else, and each frame reports which rasterizer drew it.
    ///
    /// The visible triangle of a sample may differ from OpenGL's at equal depths, within 1/256 pixel of an edge, or at
    /// the border of alpha-tested texels.
    Cuda,
    /// The faster rasterizer of each pass, measured when the scene is loaded.
    Fastest,
}

/// Facts about a device and a scene, by which [`RasterPolicy::Auto`] selects the rasterizer of the shadow map. A rule
/// instead of a measurement at load time, so that a scene has the same pixels after each start.
///
/// PNG per second of 1920x1080 with four samples per pixel and a shadow map of 1024², on an H200 with 16 cores:
///
/// | scene | triangles | cut-outs | OpenGL | CUDA |
/// |---|---|---|---|---|
/// | built-in tree | 114,853 | yes | 322 to 324 | 417 to 421 |
/// | almond tree | 37,560 | yes | 767 to 774 | 860 to 872 |
/// | bridge | 32,014 | no | 868 to 878 | 934 to 943 |
/// | fern | 6,232 | yes | 678 | not supported |
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RasterFacts {
    /// Compute capability of the CUDA device.
    pub capability: (i32, i32),
    pub triangles: usize,
}

/// The only measured architecture: H100 and H200.
const MEASURED_CAPABILITY: (i32, i32) = (9, 0);
/// Fewest triangles of scenes in which CUDA was measured to be faster.
const MIN_TRIANGLES: usize = 30_000;

impl RasterFacts {
    /// The facts about a scene on a device of this compute capability.
    pub const fn new(capability: (i32, i32), scene: &Scene) -> Self {
        Self { capability, triangles: scene.layout.triangles }
    }

    /// Whether CUDA draws the shadow map, if it supports the kind of the map.
    pub fn is_cuda_faster(&self) -> bool {
        self.capability == MEASURED_CAPABILITY && self.triangles >= MIN_TRIANGLES
    }

    /// The rule in words.
    pub fn rule() -> String {
        let (major, minor) = MEASURED_CAPABILITY;
        format!(
            "CUDA draws the variance shadow map (one cascade) on GPUs of compute capability {major}.{minor}, in scenes \
             of at least {MIN_TRIANGLES} triangles; OpenGL draws everything else"
        )
    }
}

/// Whether domains that share a shape are deformed in a batch, so that U is read once for all of them. Results with and
/// without batches are bit-identical.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BatchPolicy {
    /// Batches where they are known to be faster.
    #[default]
    Auto,
    /// No batches.
    Never,
    /// Batches of all domains whose shape has modes and is used by several domains.
    Always,
}

/// Settings of all backends for one scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BackendSettings {
    pub raster: RasterPolicy,
    /// Batching in the CUDA deformer. Ignored with compensated sums or stored displacements ([`DeformationSettings`]).
    pub batches: BatchPolicy,
}

/// The table `look` of a scene file. In addition to the scene's render settings, it contains the rasterizer.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct LookTable {
    #[serde(flatten)]
    pub settings: RenderSettings,
    pub raster: RasterPolicy,
}

/// The table `deform` of a scene file. In addition to the scene's deformation settings, it contains the batching.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct DeformTable {
    #[serde(flatten)]
    pub settings: DeformationSettings,
    pub batches: BatchPolicy,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rule_selects_the_faster_rasterizer_of_measured_scenes() {
        let facts = |triangles| RasterFacts { capability: (9, 0), triangles };
        for (scene, triangles, expected) in
            [("tree", 114_853, true), ("almond tree", 37_560, true), ("bridge", 32_014, true), ("fern", 6232, false)]
        {
            assert_eq!(facts(triangles).is_cuda_faster(), expected, "{scene}");
        }
        for capability in [(7, 5), (8, 0), (8, 6), (8, 9), (10, 0), (12, 0)] {
            assert!(!RasterFacts { capability, ..facts(1 << 24) }.is_cuda_faster(), "{capability:?}");
        }
    }

    #[test]
    fn rule_in_words_has_its_numbers() {
        let rule = RasterFacts::rule();
        assert!(["9.0", "30000"].iter().all(|number| rule.contains(number)), "{rule}");
    }
}
