//! What every deformer does: x = T (x0 + U q) for all vertices of a scene, and the normals that go with it.
//!
//! Vertices are asked for: by [`Deformer::surface`], which waits for them, or by [`Deformer::fetch`], after which the
//! next step can be deformed while they are on their way.
//!
//! Three deformers implement it: `reference` (f64, the definition), `cpu` (f32, rayon and SIMD) and `gpu` (CUDA).

use std::sync::Arc;

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

/// Vertices on their way to host memory, or there already. Each is of one step, whatever is deformed later; it can be
/// waited for late, more than once, or not at all. Its memory is kept while this or what [`Deformer::fetched`] returned
/// is held.
#[derive(Debug, Clone)]
pub struct Fetch {
    surface: Arc<Surface>,
    there: bool,
}

impl Fetch {
    /// Of vertices that [`Deformer::fetched`] waits for.
    pub const fn under_way(surface: Arc<Surface>) -> Self {
        Self { surface, there: false }
    }

    /// Of vertices that are there.
    pub const fn there(surface: Arc<Surface>) -> Self {
        Self { surface, there: true }
    }

    /// Whether they were there from the beginning, so that [`Deformer::fetched`] has nothing to wait for.
    pub const fn is_there(&self) -> bool {
        self.there
    }

    /// Where they go; not to be looked into before they are there.
    pub(crate) const fn surface(&self) -> &Arc<Surface> {
        &self.surface
    }
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

    /// Begins to bring the positions and normals of the last [`Self::deform`] to the host. Tangents are for the renderer
    /// alone and stay.
    ///
    /// # Errors
    /// `Fault` when nothing was deformed or copying from the device failed.
    fn fetch(&mut self) -> Result<Fetch> {
        let surface = self.surface()?;
        let (positions, normals) = (surface.positions.clone(), surface.normals.clone());
        Ok(Fetch::there(Arc::new(Surface { positions, normals, ..Surface::default() })))
    }

    /// Waits until they are there.
    ///
    /// # Errors
    /// `Fault` when copying from the device failed, or when they are another deformer's.
    fn fetched(&mut self, fetch: &Fetch) -> Result<Arc<Surface>> {
        Ok(Arc::clone(&fetch.surface))
    }
}
