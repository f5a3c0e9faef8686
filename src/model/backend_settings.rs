//! Settings of the backends: which implementation computes a scene, and how. They are not part of a
//! [`Scene`](crate::scene::Scene), because they do not define its result: they change run time and memory; they change
//! vertices and images only by rounding. Rounding can decide whether a triangle covers a sample next to its edge.

use crate::scene::{DeformationSettings, RenderSettings};

/// The rasterizer of the shadow depth pass and the visibility pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RasterPolicy {
    /// OpenGL's rasterizer, the reference.
    #[default]
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
