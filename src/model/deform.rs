//! The trait of all deformers. A deformer computes x = T (x0 + U q) for every vertex of a scene, and the normals and
//! tangents of the deformed surface.
//!
//! Vertices are read back only on request. [`Deformer::surface`] blocks until they are in host memory;
//! [`Deformer::readback`] starts a readback that can overlap the next step.
//!
//! Three backends in the crate `modalcast-compute` implement [`Deformer`]: `reference` (f64, the definition), `cpu`
//! (f32, rayon and SIMD) and `gpu` (CUDA).

use std::sync::Arc;

use crate::error::{Result, fault};
use crate::scene::{BoundingBox, FloatingOrigins, OrientedBounds, SceneState};
use crate::shared_memory::SharedPositions;

/// Deformed vertices of a whole scene, packed as in [`Layout`](crate::scene::Layout). A corner is a vertex with a
/// normal and texture coordinates.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DeformedSurface {
    /// World positions, three numbers per vertex, relative to the floating origin of their domain
    /// ([`SceneState::origin_of`]), which is the scene's origin before the first step with f64 translations.
    pub positions: Vec<f32>,
    /// World-space unit normals, three numbers per corner.
    pub normals: Vec<f32>,
    /// World-space unit tangents and bitangent signs, four numbers per corner. Empty if the scene has no normal map.
    pub tangents: Vec<f32>,
    /// Displacements u = U q in the domain's own frame, three numbers per vertex, in scene units. Empty unless the
    /// scene enables `deform.displacements`.
    pub displacements: Vec<f32>,
    /// The axis-aligned bounding box of each domain's `positions`, relative to the same origin. Empty unless the scene
    /// enables `deform.boxes`.
    pub boxes: Vec<BoundingBox>,
}

impl DeformedSurface {
    /// Copies the requested attributes. Tangents are never copied: only the renderer uses them.
    fn select(&self, attributes: VertexAttributes) -> Self {
        let copy_if = |is_requested: bool, array: &Vec<f32>| if is_requested { array.clone() } else { Vec::new() };
        Self {
            positions: copy_if(attributes.positions, &self.positions),
            normals: copy_if(attributes.normals, &self.normals),
            tangents: Vec::new(),
            displacements: copy_if(attributes.displacements, &self.displacements),
            boxes: if attributes.boxes { self.boxes.clone() } else { Vec::new() },
        }
    }
}

/// Attributes of a [`DeformedSurface`] to read back. The default is none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct VertexAttributes {
    pub positions: bool,
    /// Normals. A deformer whose output is in host memory also returns tangents; a [`VertexReadback`] never does.
    pub normals: bool,
    pub displacements: bool,
    pub boxes: bool,
}

impl VertexAttributes {
    /// The attributes that are needed for drawing.
    pub const POSITIONS_AND_NORMALS: Self = Self { positions: true, normals: true, displacements: false, boxes: false };
    /// Every attribute.
    pub const ALL: Self = Self { positions: true, normals: true, displacements: true, boxes: true };

    /// The union of both sets.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self {
            positions: self.positions || other.positions,
            normals: self.normals || other.normals,
            displacements: self.displacements || other.displacements,
            boxes: self.boxes || other.boxes,
        }
    }

    /// Whether `other` is a subset of this set.
    pub fn contains(self, other: Self) -> bool {
        self.union(other) == self
    }
}

/// A readback of one step's vertices, in flight or complete. Later steps do not change its contents. A caller may wait
/// for it at any time, repeatedly, or never. Its memory remains allocated while this handle or the result of
/// [`Deformer::wait_readback`] exists.
///
/// A pending readback does not expose its vertices, because the device may still write them. Only the deformer that
/// started it can complete it.
#[derive(Clone)]
pub struct VertexReadback {
    surface: Arc<DeformedSurface>,
    is_ready: bool,
}

impl std::fmt::Debug for VertexReadback {
    /// Does not print the vertices, because the device may still write them.
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("VertexReadback").field("is_ready", &self.is_ready).finish_non_exhaustive()
    }
}

impl VertexReadback {
    /// A readback in flight, which the device writes to `surface`. The deformer that started it recognizes it by
    /// [`Self::writes_to`].
    pub const fn pending(surface: Arc<DeformedSurface>) -> Self {
        Self { surface, is_ready: false }
    }

    /// A completed readback.
    pub const fn ready(surface: Arc<DeformedSurface>) -> Self {
        Self { surface, is_ready: true }
    }

    /// Whether the readback was complete when it was created, so that [`Deformer::wait_readback`] does not block.
    pub const fn is_ready(&self) -> bool {
        self.is_ready
    }

    /// Whether this readback writes to `surface`.
    pub fn writes_to(&self, surface: &Arc<DeformedSurface>) -> bool {
        Arc::ptr_eq(&self.surface, surface)
    }

    /// The vertices, or `None` if they may still be in flight.
    fn completed_surface(&self) -> Option<&Arc<DeformedSurface>> {
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

/// Orthogonal unit vectors in world space. A deformer bounds the positions along these axes in addition to the axes of
/// the world.
pub type BoundingAxes = [nalgebra::Vector3<f64>; 3];

/// The result of [`Deformer::deform`] apart from the vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeformSummary {
    /// Bounds of all deformed positions in the coordinates of [`DeformedSurface::positions`]. Not finite if f32
    /// overflowed in a position or in a stored displacement.
    pub bounds: BoundingBox,
    /// Bounds of the same positions along the [`BoundingAxes`] of the deformer, relative to the same origin. `None` if
    /// the deformer was constructed without axes.
    ///
    /// The bounds contain every vertex. `reference` returns the tight bounds. The other backends first compute the
    /// world-space boxes of groups of up to 128 vertices, then bound these boxes. Their bounds exceed the tight bounds
    /// by less than the diagonal of such a box, and extend beyond the corners of `bounds` at most by rounding.
    pub oriented_bounds: Option<OrientedBounds>,
    /// Milliseconds from the call until the vertices were complete.
    pub ms: f64,
}

/// A step whose positions are in memory that a compute rasterizer can read.
#[derive(Debug, Clone)]
pub struct SharedStep {
    pub positions: SharedPositions,
    /// As [`DeformSummary::bounds`].
    pub bounds: BoundingBox,
    /// As [`DeformSummary::oriented_bounds`].
    pub oriented_bounds: Option<OrientedBounds>,
    /// As [`SceneState::origins`].
    pub origins: Option<Arc<FloatingOrigins>>,
}

/// A deformer for one scene. It owns all data that it needs from the scene.
pub trait Deformer {
    /// The implementation behind this trait object.
    fn backend(&self) -> Backend;

    /// Computes the vertices of `state` into the deformer's output.
    ///
    /// # Errors
    /// `Fault` if the device fails.
    fn deform(&mut self, state: &SceneState) -> Result<DeformSummary>;

    /// Announces the state that probably follows the one of the next [`Self::deform`]. A backend may compute both at once.
    fn announce(&mut self, _following: &Arc<SceneState>) {}

    /// The steps that a compute rasterizer can read: the one of the last [`Self::deform`] first, then those that the backend
    /// has computed before their [`Self::deform`]. Empty if the first one is not in shared memory. Valid until the next
    /// [`Self::deform`].
    ///
    /// # Errors
    /// `Fault` if the device fails.
    fn shared_steps(&mut self) -> Result<Vec<SharedStep>> {
        Ok(Vec::new())
    }

    /// Whether [`Self::fill_gl_buffers`] can fill the renderer's buffers, so that no upload is needed.
    fn fills_gl_buffers(&self) -> bool {
        false
    }

    /// Copies positions, normals and tangents of the last [`Self::deform`] to the renderer's buffers on the device,
    /// without waiting. OpenGL commands issued earlier read the old contents, and later ones the new contents.
    ///
    /// # Errors
    /// `Fault` unless [`Self::fills_gl_buffers`], or if the device fails.
    fn fill_gl_buffers(&mut self) -> Result<()> {
        Err(fault("interop", "expected a deformer that fills OpenGL's buffers"))
    }

    /// The vertices of the last [`Self::deform`], in host memory. Blocks until they are complete.
    ///
    /// # Errors
    /// `Fault` if the copy from the device fails.
    fn surface(&mut self) -> Result<&DeformedSurface>;

    /// Like [`Self::surface`], but guarantees only the given attributes. The others may be empty or belong to an
    /// earlier step. A deformer whose output is in host memory returns all of them.
    ///
    /// # Errors
    /// As for [`Self::surface`].
    fn surface_with(&mut self, _attributes: VertexAttributes) -> Result<&DeformedSurface> {
        self.surface()
    }

    /// Starts a readback of the given attributes of the last [`Self::deform`]. All other arrays of the resulting
    /// [`DeformedSurface`] are empty; tangents are never read back. Positions and normals may still be in flight while
    /// the next step is deformed. Displacements and boxes are complete when this returns.
    ///
    /// # Errors
    /// `Fault` if no step was deformed yet, or if the copy from the device fails.
    fn readback(&mut self, attributes: VertexAttributes) -> Result<VertexReadback> {
        Ok(VertexReadback::ready(Arc::new(self.surface_with(attributes)?.select(attributes))))
    }

    /// Blocks until the readback is complete.
    ///
    /// # Errors
    /// `Fault` if the copy from the device fails, or if another deformer started the readback.
    fn wait_readback(&mut self, readback: &VertexReadback) -> Result<Arc<DeformedSurface>> {
        readback.completed_surface().cloned().ok_or_else(|| fault("readback", "another deformer started it"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contains_compares_attribute_sets() {
        let boxes = VertexAttributes { boxes: true, ..VertexAttributes::default() };
        assert!(
            VertexAttributes::ALL.contains(VertexAttributes::POSITIONS_AND_NORMALS.union(boxes))
                && VertexAttributes::POSITIONS_AND_NORMALS.union(boxes).contains(boxes)
        );
        assert!(
            !VertexAttributes::POSITIONS_AND_NORMALS.contains(boxes)
                && !boxes.contains(VertexAttributes::POSITIONS_AND_NORMALS)
        );
        assert!(boxes.contains(VertexAttributes::default()) && !VertexAttributes::default().contains(boxes));
    }

    /// A deformer whose output is in host memory.
    struct HostDeformer(DeformedSurface);

    impl Deformer for HostDeformer {
        fn backend(&self) -> Backend {
            Backend::Cpu
        }

        fn deform(&mut self, _: &SceneState) -> Result<DeformSummary> {
            Ok(DeformSummary { bounds: BoundingBox::EMPTY, oriented_bounds: None, ms: 0.0 })
        }

        fn surface(&mut self) -> Result<&DeformedSurface> {
            Ok(&self.0)
        }
    }

    #[test]
    fn pending_readback_is_neither_returned_nor_printed() {
        let mut deformer = HostDeformer(DeformedSurface { positions: vec![1.0], ..DeformedSurface::default() });
        let ready = deformer.readback(VertexAttributes::ALL).expect("a ready readback");
        assert_eq!(deformer.wait_readback(&ready).expect("a complete readback").positions, [1.0]);
        let pending = VertexReadback::pending(Arc::new(DeformedSurface::default()));
        let error = deformer.wait_readback(&pending).expect_err("a pending readback").to_string();
        assert!(error.contains("another deformer"), "{error}");
        let surface = Arc::new(DeformedSurface { positions: vec![1234.5], ..DeformedSurface::default() });
        assert!(!format!("{:?}", VertexReadback::pending(surface)).contains("1234"), "expected no vertices in Debug");
    }

    #[test]
    fn select_copies_requested_attributes_but_no_tangents() {
        let surface = DeformedSurface {
            positions: vec![1.0],
            normals: vec![2.0],
            tangents: vec![3.0],
            displacements: vec![4.0],
            boxes: vec![BoundingBox::EMPTY],
        };
        assert_eq!(surface.select(VertexAttributes::ALL), DeformedSurface { tangents: vec![], ..surface.clone() });
        assert_eq!(surface.select(VertexAttributes::default()), DeformedSurface::default());
        let normals = VertexAttributes { normals: true, ..VertexAttributes::default() };
        assert_eq!(surface.select(normals), DeformedSurface { normals: vec![2.0], ..DeformedSurface::default() });
    }
}
