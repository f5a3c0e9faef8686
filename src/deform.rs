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
    /// u = U q, three numbers per vertex in the frame of its domain, scene units; empty unless the scene keeps them
    /// (`deform.displacements`).
    pub displacements: Vec<f32>,
    /// Per domain the smallest box that holds its `positions`, relative to the same cell; empty unless the scene keeps
    /// them (`deform.boxes`).
    pub boxes: Vec<Bounds>,
}

/// What of a [`Surface`] a reader wants; nothing by default.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wanted {
    pub positions: bool,
    /// And tangents.
    pub normals: bool,
    pub displacements: bool,
    pub boxes: bool,
}

impl Wanted {
    /// What there is to draw.
    pub const VERTICES: Self = Self { positions: true, normals: true, displacements: false, boxes: false };
    /// Everything.
    pub const ALL: Self = Self { positions: true, normals: true, displacements: true, boxes: true };

    /// What either of two wants.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        Self {
            positions: self.positions || other.positions,
            normals: self.normals || other.normals,
            displacements: self.displacements || other.displacements,
            boxes: self.boxes || other.boxes,
        }
    }

    /// Whether all that `other` wants is wanted.
    pub fn covers(self, other: Self) -> bool {
        self.or(other) == self
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
    /// Bounds of all deformed positions as they are in [`Surface`]. Not finite when f32 overflowed somewhere, in a
    /// displacement that is kept too.
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

    /// The same, of which only what is wanted need be there: the rest may be missing or that of an earlier step. Output
    /// that lies in host memory is there anyway.
    ///
    /// # Errors
    /// As [`Self::surface`].
    fn read(&mut self, _wanted: Wanted) -> Result<&Surface> {
        self.surface()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_is_served_by_what_holds_all_that_it_wants() {
        let boxes = Wanted { boxes: true, ..Wanted::default() };
        assert!(Wanted::ALL.covers(Wanted::VERTICES.or(boxes)) && Wanted::VERTICES.or(boxes).covers(boxes));
        assert!(!Wanted::VERTICES.covers(boxes) && !boxes.covers(Wanted::VERTICES));
        assert!(boxes.covers(Wanted::default()) && !Wanted::default().covers(boxes));
    }
}
