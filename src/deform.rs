//! What every deformer does: x = T (x0 + U q) for all vertices of a scene, and the normals that go with it.
//!
//! Three deformers implement it: `reference` (f64, the definition), `cpu` (f32, rayon and SIMD) and `gpu` (CUDA).

use crate::error::Result;
use crate::scene::{Bounds, State};

/// Deformed vertices of a whole scene, packed as the scene's layout says.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// World positions, three numbers per vertex, relative to their domain's cell ([`State::cell_of`]): the scene's origin
    /// unless steps took the domain far from it.
    pub positions: Vec<f32>,
    /// World unit normals, three numbers per corner.
    pub normals: Vec<f32>,
    /// World unit tangents and bitangent signs, four numbers per corner; empty when the scene has no normal map.
    pub tangents: Vec<f32>,
}

/// The backends by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    Reference,
    Cpu,
    Cuda,
}

impl Backend {
    /// The name used on the command line, on the wire and in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
        }
    }
}

/// What a deformation tells besides the vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deformed {
    /// Bounds of all deformed positions as they are in [`Surface`]. Not finite when f32 overflowed somewhere.
    pub bounds: Bounds,
    /// Milliseconds from the call until the vertices were there.
    pub ms: f64,
}

/// A deformer that was built for one scene and holds all it needs of it.
pub trait Deformer {
    /// Which one this is.
    fn backend(&self) -> Backend;

    /// Computes the vertices of `state` into the deformer's output.
    ///
    /// # Errors
    /// `Fault` when the device failed.
    fn deform(&mut self, state: &State) -> Result<Deformed>;

    /// Whether the output lies in the renderer's own buffers already, so that nothing need be uploaded.
    fn shares_buffers(&self) -> bool {
        false
    }

    /// The vertices of the last [`Self::deform`], in host memory.
    ///
    /// # Errors
    /// `Fault` when copying from the device failed.
    fn surface(&mut self) -> Result<&Surface>;
}
