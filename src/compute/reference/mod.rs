//! The reference deformer: plain f64 loops that define the results. It shares no code with the other deformers.

mod deform;
mod normals;
pub mod raster;
mod rigid_normals;
pub mod views;

use std::sync::Arc;
use std::time::Instant;

pub use deform::{deform, displacements};
pub use normals::{exact_normals, exact_tangents};
pub use rigid_normals::{rigid_normals, rigid_tangents};

use modalcast_model::deform::{Backend, BoundingAxes, DeformSummary, DeformedSurface, Deformer};
use modalcast_model::error::Result;
use modalcast_model::scene::{BoundingBox, DomainLayout, OrientedBounds, Scene, SceneState};

/// The deformer of the `reference` backend: computes in f64 and rounds once.
#[derive(Debug)]
pub struct ReferenceDeformer {
    scene: Arc<Scene>,
    bounding_axes: Option<BoundingAxes>,
    surface: DeformedSurface,
}

impl ReferenceDeformer {
    /// Creates a deformer of one scene.
    pub fn new(scene: &Arc<Scene>) -> Self {
        Self { scene: Arc::clone(scene), bounding_axes: None, surface: DeformedSurface::default() }
    }

    /// Also bounds the positions of every step along these axes.
    #[must_use]
    pub fn with_bounding_axes(self, axes: Option<BoundingAxes>) -> Self {
        Self { bounding_axes: axes, ..self }
    }

    /// Computes displacements u and one box per domain, if they are outputs of the scene. Displacements that overflow
    /// f32 make `bounds` NaN.
    fn compute_attributes(&mut self, state: &SceneState, bounds: &mut BoundingBox) {
        let (scene, surface) = (&self.scene, &mut self.surface);
        if scene.features.displacements {
            surface.displacements = round_to_f32(displacements(scene, state));
            if !surface.displacements.iter().all(|number| number.is_finite()) {
                bounds.include([f64::NAN; 3]);
            }
        }
        if scene.features.boxes {
            let box_of = |layout: &DomainLayout| {
                BoundingBox::from_positions(&surface.positions[3 * layout.first_vertex..][..3 * layout.vertices])
            };
            surface.boxes = scene.layout.domains.iter().map(box_of).collect();
        }
    }
}

impl Deformer for ReferenceDeformer {
    fn backend(&self) -> Backend {
        Backend::Reference
    }

    fn deform(&mut self, state: &SceneState) -> Result<DeformSummary> {
        let start = Instant::now();
        let positions = deform(&self.scene, state);
        let oriented_bounds = self.bounding_axes.map(|axes| {
            let bounds_of =
                |position: &[f64; 3]| OrientedBounds::enclosing(&axes, &BoundingBox { min: *position, max: *position });
            positions.iter().map(bounds_of).fold(OrientedBounds::EMPTY, OrientedBounds::union)
        });
        let (normals, tangents) = if self.scene.features.exact_normals {
            (exact_normals(&self.scene, state, &positions), exact_tangents(&self.scene, state, &positions))
        } else {
            (rigid_normals(&self.scene, state), rigid_tangents(&self.scene, state))
        };
        self.surface.positions = round_to_f32(positions);
        self.surface.normals = round_to_f32(normals);
        self.surface.tangents = round_to_f32(tangents);
        let mut bounds = BoundingBox::from_positions(&self.surface.positions);
        self.compute_attributes(state, &mut bounds);
        Ok(DeformSummary { bounds, oriented_bounds, ms: start.elapsed().as_secs_f64() * 1e3 })
    }

    fn surface(&mut self) -> Result<&DeformedSurface> {
        Ok(&self.surface)
    }
}

fn round_to_f32<const N: usize>(vectors: Vec<[f64; N]>) -> Vec<f32> {
    vectors.into_flattened().into_iter().map(|number| number as f32).collect()
}
