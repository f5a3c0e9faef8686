//! What every deformer does: x = T (x0 + U q) for all vertices of a scene, and the normals that go with it.
//!
//! Vertices are asked for: by [`Deformer::surface`], which waits for them, or by [`Deformer::fetch`], after which the
//! next step can be deformed while they are on their way.
//!
//! Three deformers implement it: `reference` (f64, the definition), `cpu` (f32, rayon and SIMD) and `gpu` (CUDA).

use std::sync::Arc;

use crate::error::{Result, during};
use crate::scene::{Bounds, LightBounds, State};

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

impl Surface {
    /// A copy of what is wanted, without tangents, which are for the renderer alone.
    fn only(&self, wanted: Wanted) -> Self {
        let list = |wanted: bool, list: &Vec<f32>| if wanted { list.clone() } else { Vec::new() };
        Self {
            positions: list(wanted.positions, &self.positions),
            normals: list(wanted.normals, &self.normals),
            tangents: Vec::new(),
            displacements: list(wanted.displacements, &self.displacements),
            boxes: if wanted.boxes { self.boxes.clone() } else { Vec::new() },
        }
    }
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

/// Vertices on their way to host memory, or there already. Each is of one step, whatever is deformed later; it can be
/// waited for late, more than once, or not at all. Its memory is kept while this or what [`Deformer::fetched`] returned
/// is held.
///
/// The vertices of a pending fetch cannot be reached through this type: a device may still be writing them. Only the deformer
/// that began it can resolve it.
#[derive(Debug, Clone)]
pub struct Fetch {
    surface: Arc<Surface>,
    is_ready: bool,
}

impl Fetch {
    /// Vertices that are still being written; the deformer finds them again by [`Self::is_of`].
    pub const fn pending(surface: Arc<Surface>) -> Self {
        Self { surface, is_ready: false }
    }

    /// Vertices that are complete.
    pub const fn ready(surface: Arc<Surface>) -> Self {
        Self { surface, is_ready: true }
    }

    /// Whether the vertices were complete from the beginning, so that [`Deformer::fetched`] does not wait.
    pub const fn is_ready(&self) -> bool {
        self.is_ready
    }

    /// Whether this is a fetch into `surface`.
    pub fn is_of(&self, surface: &Arc<Surface>) -> bool {
        Arc::ptr_eq(&self.surface, surface)
    }

    /// The vertices, unless they are still being written.
    fn complete(&self) -> Option<&Arc<Surface>> {
        self.is_ready.then_some(&self.surface)
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
    /// What the same positions take up along the axes of light space ([`Scene::light_axes`](crate::scene::Scene)), relative
    /// to the same origin; none where the look has no shadow that is fitted to them. It holds every vertex. `reference` is
    /// as tight as the vertices are; the others put boxes around up to 128 vertices each and reach beyond by less than the
    /// diagonal of such a box, and never beyond the corners of `bounds` by more than rounding.
    pub light: Option<LightBounds>,
    /// Milliseconds from the call until the vertices were there; with vertices in the renderer's own buffers, without the
    /// wait for frames that are still drawn from them.
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

    /// Begins to bring what is wanted of the last [`Self::deform`] to the host, and nothing else: the other lists of the
    /// [`Surface`] are empty. Tangents are for the renderer alone and stay. Positions and normals may be on their way
    /// while the next step is deformed; displacements and boxes are there when this returns.
    ///
    /// # Errors
    /// `Fault` when nothing was deformed or copying from the device failed.
    fn fetch(&mut self, wanted: Wanted) -> Result<Fetch> {
        Ok(Fetch::ready(Arc::new(self.read(wanted)?.only(wanted))))
    }

    /// Waits until all of it is there.
    ///
    /// # Errors
    /// `Fault` when copying from the device failed, or when it is another deformer's.
    fn fetched(&mut self, fetch: &Fetch) -> Result<Arc<Surface>> {
        fetch.complete().cloned().ok_or_else(|| during("fetch")("it was begun by another deformer"))
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

    /// A deformer that keeps its output in host memory.
    struct OnHost(Surface);

    impl Deformer for OnHost {
        fn backend(&self) -> Backend {
            Backend::Cpu
        }

        fn deform(&mut self, _: &State) -> Result<Deformed> {
            Ok(Deformed { bounds: Bounds::EMPTY, light: None, ms: 0.0 })
        }

        fn surface(&mut self) -> Result<&Surface> {
            Ok(&self.0)
        }
    }

    #[test]
    fn a_pending_fetch_of_another_deformer_is_refused() {
        let mut deformer = OnHost(Surface { positions: vec![1.0], ..Surface::default() });
        let own = deformer.fetch(Wanted::ALL).expect("fetches");
        assert_eq!(deformer.fetched(&own).expect("its own").positions, [1.0]);
        let pending = Fetch::pending(Arc::new(Surface::default()));
        let error = deformer.fetched(&pending).expect_err("a device may be writing it").to_string();
        assert!(error.contains("another deformer"), "{error}");
    }

    #[test]
    fn a_copy_has_what_is_wanted_and_never_tangents() {
        let whole = Surface {
            positions: vec![1.0],
            normals: vec![2.0],
            tangents: vec![3.0],
            displacements: vec![4.0],
            boxes: vec![Bounds::EMPTY],
        };
        assert_eq!(whole.only(Wanted::ALL), Surface { tangents: vec![], ..whole.clone() });
        assert_eq!(whole.only(Wanted::default()), Surface::default());
        let normals = Wanted { normals: true, ..Wanted::default() };
        assert_eq!(whole.only(normals), Surface { normals: vec![2.0], ..Surface::default() });
    }
}
