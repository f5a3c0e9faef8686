//! Settings of the backends: which implementation computes a scene, and how. A scene does not contain them because they
//! change run time and memory, but its vertices and images at most by rounding.

use crate::scene::{DeformationSettings, RenderSettings};

/// Which rasterizer draws the shadow map's depth pass and the camera's pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RasterPolicy {
    /// OpenGL's rasterizer, the reference.
    #[default]
    OpenGl,
    /// The compute rasterizer in CUDA, where it is supported: on a CUDA device that also draws, for variance shadow
    /// maps without splits, and for frames with one sample per pixel and no blended triangles. OpenGL draws everything
    /// else, and each frame reports which rasterizer drew it. The visible triangle of a sample may differ only where
    /// depths tie, within 1/256 pixel of an edge, and at the border of textured cut-outs.
    Cuda,
    /// For each pass the faster of both, measured when the scene is loaded.
    Fastest,
}

/// Whether domains that share a shape are deformed in a batch, so that U is read once for all of them. The results are
/// bit-identical.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BatchPolicy {
    /// Batches where they are known to be faster.
    #[default]
    Auto,
    /// No batches.
    Never,
    /// Batches of all domains that share a shape with modes.
    Always,
}

/// Settings of all backends for one scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BackendSettings {
    /// Selects between the renderer's OpenGL passes and the compute rasterizer.
    pub raster: RasterPolicy,
    /// Batching in the CUDA deformer. Not available with truncation, compensated sums or stored displacements.
    pub batches: BatchPolicy,
}

/// The table `look` of a scene file, which contains the choice of the rasterizer in addition to the scene's settings.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct LookTable {
    #[serde(flatten)]
    pub settings: RenderSettings,
    pub raster: RasterPolicy,
}

/// The table `deform` of a scene file, which contains the batching in addition to the scene's settings.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct DeformTable {
    #[serde(flatten)]
    pub settings: DeformationSettings,
    pub batches: BatchPolicy,
}
