//! The trait of all deformers. A deformer computes x = T (x0 + U q) for every vertex of a scene, and the normals and
//! tangents of the deformed surface.
//!
//! Vertices are read back only on request. [`Deformer::surface`] blocks until they are in host memory;
//! [`Deformer::fetch`] starts a readback that can overlap the next step.
//!
//! Three backends implement [`Deformer`]: `reference` (f64, the definition), `cpu` (f32, rayon and SIMD) and `gpu`
//! (CUDA).

use std::sync::Arc;

use crate::error::{Result, during};
use crate::scene::{Bounds, LightBounds, State};

/// Deformed vertices of a whole scene, packed as in [`Layout`](crate::scene::Layout).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Surface {
    /// World positions, three numbers per vertex, relative to the cell of their domain ([`State::cell_of`]). The cell
    /// is the scene's origin unless a step with f64 translations moved the domain far from it.
    pub positions: Vec<f32>,
    /// World-space unit normals, three numbers per corner.
    pub normals: Vec<f32>,
    /// World-space unit tangents and bitangent signs, four numbers per corner. Empty if the scene has no normal map.
    pub tangents: Vec<f32>,
    /// Displacements u = U q in the domain's own frame, three numbers per vertex, in scene units. Empty unless the
    /// scene enables `deform.displacements`.
    pub displacements: Vec<f32>,
    /// The axis-aligned bounding box of each domain's `positions`, relative to the same cell. Empty unless the scene
    /// enables `deform.boxes`.
    pub boxes: Vec<Bounds>,
}

impl Surface {
    /// Copies the requested attributes. Tangents are never copied: only the renderer uses them.
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

/// Attributes of a [`Surface`] to read back. The default is none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wanted {
    pub positions: bool,
    /// Normals, and tangents where a deformer reads them in place. A [`Fetch`] never contains tangents.
    pub normals: bool,
    pub displacements: bool,
    pub boxes: bool,
}

impl Wanted {
    /// The attributes that are needed for drawing.
    pub const VERTICES: Self = Self { positions: true, normals: true, displacements: false, boxes: false };
    /// Every attribute.
    pub const ALL: Self = Self { positions: true, normals: true, displacements: true, boxes: true };

    /// The union of both sets.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        Self {
            positions: self.positions || other.positions,
            normals: self.normals || other.normals,
            displacements: self.displacements || other.displacements,
            boxes: self.boxes || other.boxes,
        }
    }

    /// Whether `other` is a subset of this set.
    pub fn covers(self, other: Self) -> bool {
        self.or(other) == self
    }
}

/// A readback of one step's vertices, in flight or complete. Deforming later steps does not change its contents. It can
/// be awaited at any time, more than once, or never. Its memory stays allocated while this handle or the result of
/// [`Deformer::fetched`] is alive.
///
/// A pending readback does not expose its vertices, because the device may still write them. Only the deformer that
/// started it can complete it.
#[derive(Debug, Clone)]
pub struct Fetch {
    surface: Arc<Surface>,
    is_ready: bool,
}

impl Fetch {
    /// A readback in flight. The deformer identifies it by [`Self::is_of`].
    pub const fn pending(surface: Arc<Surface>) -> Self {
        Self { surface, is_ready: false }
    }

    /// A completed readback.
    pub const fn ready(surface: Arc<Surface>) -> Self {
        Self { surface, is_ready: true }
    }

    /// Whether the readback was complete when it was created, so that [`Deformer::fetched`] does not block.
    pub const fn is_ready(&self) -> bool {
        self.is_ready
    }

    /// Whether this readback writes to `surface`.
    pub fn is_of(&self, surface: &Arc<Surface>) -> bool {
        Arc::ptr_eq(&self.surface, surface)
    }

    /// The vertices, or `None` if they may still be in flight.
    fn complete(&self) -> Option<&Arc<Surface>> {
        self.is_ready.then_some(&self.surface)
    }
}

/// The deformer implementations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    Reference,
    Cpu,
    Cuda,
}

impl Backend {
    /// The name on the command line, in the protocol and in benchmark records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
        }
    }
}

/// The result of [`Deformer::deform`] apart from the vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deformed {
    /// Bounds of all deformed positions in the coordinates of [`Surface::positions`]. Not finite if f32 overflowed in a
    /// position or in a stored displacement.
    pub bounds: Bounds,
    /// Bounds of the same positions along the axes of light space ([`Scene::light_axes`](crate::scene::Scene)),
    /// relative to the same origin. `None` if the look has no shadow map that is fitted to the vertices. The bounds
    /// contain every vertex. `reference` returns the tight bounds. The other backends bound boxes of up to 128 vertices
    /// each: they exceed the tight bounds by less than the diagonal of such a box, and never extend beyond the corners
    /// of `bounds` by more than rounding.
    pub light: Option<LightBounds>,
    /// Milliseconds from the call until the vertices were complete. If they are written to the renderer's own buffers,
    /// the wait for frames that still read these buffers is not included.
    pub ms: f64,
}

/// A deformer for one scene. It owns all data that it needs from the scene.
pub trait Deformer {
    /// The implementation behind this trait object.
    fn backend(&self) -> Backend;

    /// Computes the vertices of `state` into the deformer's output.
    ///
    /// # Errors
    /// `Fault` if the device fails.
    fn deform(&mut self, state: &State) -> Result<Deformed>;

    /// Whether the output is written to the renderer's own buffers, so that no upload is needed.
    fn shares_buffers(&self) -> bool {
        false
    }

    /// The vertices of the last [`Self::deform`], in host memory. Blocks until they are complete.
    ///
    /// # Errors
    /// `Fault` if the copy from the device fails.
    fn surface(&mut self) -> Result<&Surface>;

    /// Like [`Self::surface`], but only the attributes in `wanted` are guaranteed. The others may be empty or belong to
    /// an earlier step. A deformer whose output is in host memory returns all of them.
    ///
    /// # Errors
    /// As for [`Self::surface`].
    fn read(&mut self, _wanted: Wanted) -> Result<&Surface> {
        self.surface()
    }

    /// Starts a readback of the attributes in `wanted` of the last [`Self::deform`]. All other arrays of the resulting
    /// [`Surface`] are empty; tangents are never read back. Positions and normals may still be in flight while the next
    /// step is deformed. Displacements and boxes are complete when this returns.
    ///
    /// # Errors
    /// `Fault` if no step was deformed yet, or if the copy from the device fails.
    fn fetch(&mut self, wanted: Wanted) -> Result<Fetch> {
        Ok(Fetch::ready(Arc::new(self.read(wanted)?.only(wanted))))
    }

    /// Blocks until the readback is complete.
    ///
    /// # Errors
    /// `Fault` if the copy from the device fails, or if another deformer started the readback.
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

    /// A deformer whose output is in host memory.
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
