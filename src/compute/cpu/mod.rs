//! The CPU deformer in f32, for machines without a GPU. All cores share the tiles of all domains, and SIMD instructions
//! compute the vertices of a tile.
//!
//! Equal inputs give bit-identical outputs on any number of cores: the modes of a vertex are summed in order by fused
//! multiply-adds, independent of its tile and of the domains that changed. Domains whose q and T equal those of the
//! previous step keep their vertices and normals.

mod bandwidth;
#[cfg(test)]
mod bench;
mod changes;
mod decode;
mod deform;
#[cfg(target_arch = "x86_64")]
mod fused;
mod normals;
mod rigid_normals;
mod simd;
mod sum;
mod tile;
mod tile_bounds;

use std::sync::Arc;
use std::time::Instant;

use rayon::prelude::*;

pub use bandwidth::read_bandwidth;

use crate::storage::TiledModes;
use changes::ChangeTracker;
use deform::{DeformInputs, DeformOutputs, MAX_TILE_VERTICES};
use modalcast_model::deform::{Backend, BoundingAxes, DeformSummary, DeformedSurface, Deformer};
use modalcast_model::error::Result;
use modalcast_model::scene::{BoundingBox, Scene, SceneState};
use tile::{PackedOutput, PerTileOutput, WorkList};
use tile_bounds::{SceneBounds, TileBounds};

/// Maximum number of corners that one work item processes. A corner is a vertex with one of its normals and texture
/// coordinates.
const MAX_TILE_CORNERS: usize = 256;

/// The deformer of the `cpu` backend for one scene.
#[derive(Debug)]
pub struct CpuDeformer {
    scene: Arc<Scene>,
    /// Per shape, its stored U and x0.
    shapes: Vec<TiledModes>,
    changes: ChangeTracker,
    /// The tiles of vertices.
    vertex_work: WorkList,
    /// The tiles of corners.
    corner_work: WorkList,
    /// Per tile of vertices.
    tile_bounds: Vec<TileBounds>,
    scene_bounds: SceneBounds,
    surface: DeformedSurface,
}

impl CpuDeformer {
    /// Encodes U in the scene's storage type and allocates work lists and outputs.
    pub fn new(scene: &Arc<Scene>) -> Self {
        let layout = &scene.layout;
        let tangent_length = if scene.features.normal_maps { 4 * layout.corners } else { 0 };
        let storage = scene.deformation.storage;
        let shapes: Vec<TiledModes> = scene.shapes.par_iter().map(|shape| TiledModes::new(shape, storage)).collect();
        let vertex_work = WorkList::new(layout.domains.iter().map(|domain| domain.vertices), MAX_TILE_VERTICES);
        Self {
            scene: Arc::clone(scene),
            changes: ChangeTracker::default(),
            tile_bounds: vec![TileBounds::EMPTY; vertex_work.len()],
            scene_bounds: SceneBounds::new(),
            shapes,
            vertex_work,
            corner_work: WorkList::new(layout.domains.iter().map(|domain| domain.corners), MAX_TILE_CORNERS),
            surface: DeformedSurface {
                positions: vec![0.0; 3 * layout.vertices],
                normals: vec![0.0; 3 * layout.corners],
                tangents: vec![0.0; tangent_length],
                displacements: vec![0.0; if scene.features.displacements { 3 * layout.vertices } else { 0 }],
                boxes: vec![BoundingBox::EMPTY; if scene.features.boxes { layout.domains.len() } else { 0 }],
            },
        }
    }

    /// Also bounds the positions of every step along these axes.
    #[must_use]
    pub fn with_bounding_axes(mut self, axes: Option<BoundingAxes>) -> Self {
        self.scene_bounds.set_axes(axes);
        self
    }

    /// Bytes of stored U and x0. A step in which all domains change reads this many bytes if no two domains share a
    /// shape.
    pub fn stored_bytes(&self) -> usize {
        self.shapes.iter().map(|tiles| tiles.bytes().len() + size_of_val(tiles.rest())).sum()
    }

    fn deform_positions(&mut self, state: &SceneState) {
        let inputs = DeformInputs { scene: &self.scene, state, shapes: &self.shapes };
        let DeformedSurface { positions, displacements, .. } = &mut self.surface;
        let displacements = self.scene.features.displacements.then(|| PackedOutput::new(3, displacements));
        let outputs = DeformOutputs {
            positions: PackedOutput::new(3, positions),
            bounds: PerTileOutput::new(&mut self.tile_bounds),
            displacements,
        };
        deform::deform(inputs, self.vertex_work.select_changed(&self.changes), outputs);
    }

    /// Updates the boxes of the changed domains from the bounds of their tiles, if boxes are an output of the scene.
    fn update_boxes(&mut self) {
        let Self { changes, vertex_work, tile_bounds, surface: DeformedSurface { boxes, .. }, .. } = self;
        let box_of = |domain: usize| TileBounds::of_domain(&tile_bounds[vertex_work.tiles_of(domain)]);
        match changes.changed_domains() {
            _ if boxes.is_empty() => {}
            Some(domains) => domains.iter().for_each(|domain| boxes[*domain as usize] = box_of(*domain as usize)),
            None => {
                let boxes = boxes.par_iter_mut().with_min_len(1024).enumerate();
                boxes.for_each(|(domain, bounding_box)| *bounding_box = box_of(domain));
            }
        }
    }
}

impl Deformer for CpuDeformer {
    fn backend(&self) -> Backend {
        Backend::Cpu
    }

    fn deform(&mut self, state: &SceneState) -> Result<DeformSummary> {
        let start = Instant::now();
        self.changes.update(&self.scene, state);
        self.deform_positions(state);
        self.update_boxes();
        // Exact and rigid normals depend only on the positions and T of their domain.
        let corner_tiles = self.corner_work.select_changed(&self.changes);
        if self.scene.features.exact_normals {
            normals::compute_normals(&self.scene, state, corner_tiles, &mut self.surface);
        } else {
            rigid_normals::compute_rigid_normals(&self.scene, state, corner_tiles, &mut self.surface);
        }
        let vertex_work = &self.vertex_work;
        let changed_domains = self.changes.changed_domains();
        let changed_tiles =
            changed_domains.map(|domains| domains.iter().map(|domain| vertex_work.tiles_of(*domain as usize)));
        self.scene_bounds.update(&self.tile_bounds, changed_tiles);
        let (bounds, oriented_bounds) = self.scene_bounds.get();
        Ok(DeformSummary { bounds, oriented_bounds, ms: start.elapsed().as_secs_f64() * 1e3 })
    }

    fn surface(&mut self) -> Result<&DeformedSurface> {
        Ok(&self.surface)
    }
}
