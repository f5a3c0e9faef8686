//! The CPU deformer in f32, for machines without a GPU: rayon over a flat list of tiles of all domains, SIMD inside a
//! tile.
//!
//! Each vertex sums its modes in order by fused multiply-adds, independent of its tile and of the domains that changed,
//! so equal inputs give bit-identical outputs on any number of cores. Domains whose q and T equal those of the previous
//! step keep their vertices and normals. With a truncation budget, the result also depends on earlier steps, because
//! the choice of truncated modes has hysteresis.

#[cfg(test)]
mod bench;
mod changes;
mod decode;
mod deform;
mod extent;
#[cfg(target_arch = "x86_64")]
mod fused;
mod kept;
mod normals;
mod orient;
mod rate;
mod simd;
mod sum;
mod tile;

use std::sync::Arc;
use std::time::Instant;

use rayon::prelude::*;

pub use rate::read_rate;

use crate::storage::{Tiles, Truncation};
use changes::Changes;
use deform::{Inputs, TILE};
use extent::Extent;
use kept::Kept;
use modalcast_model::deform::{Backend, Deformed, Deformer, Surface};
use modalcast_model::error::Result;
use modalcast_model::scene::{Bounds, Scene, State};
use tile::{Packed, PerTile, Work};

/// Maximum number of corners of a tile.
const CORNER_TILE: usize = 256;

/// The deformer of the `cpu` backend, of one scene.
#[derive(Debug)]
pub struct CpuDeformer {
    scene: Arc<Scene>,
    /// Per shape.
    shapes: Vec<Tiles>,
    every_chunk: Vec<u16>,
    kept: Option<Kept>,
    changes: Changes,
    vertex_work: Work,
    corner_work: Work,
    /// Per tile of vertices.
    extents: Vec<Extent>,
    surface: Surface,
}

impl CpuDeformer {
    /// Encodes U in the scene's storage type and allocates work lists and outputs.
    pub fn new(scene: &Arc<Scene>) -> Self {
        let layout = &scene.layout;
        let tangents = if scene.needs.normal_maps { 4 * layout.corners } else { 0 };
        let storage = scene.deformation.storage;
        let shapes: Vec<Tiles> = scene.shapes.par_iter().map(|shape| Tiles::new(shape, storage)).collect();
        let most_chunks = shapes.iter().map(Tiles::chunks).max().unwrap_or(0);
        let vertex_work = Work::new(layout.slots.iter().map(|slot| slot.vertices), TILE);
        Self {
            scene: Arc::clone(scene),
            every_chunk: (0..most_chunks as u16).collect(),
            kept: Kept::new(scene),
            changes: Changes::default(),
            extents: vec![Extent::EMPTY; vertex_work.len()],
            shapes,
            vertex_work,
            corner_work: Work::new(layout.slots.iter().map(|slot| slot.corners), CORNER_TILE),
            surface: Surface {
                positions: vec![0.0; 3 * layout.vertices],
                normals: vec![0.0; 3 * layout.corners],
                tangents: vec![0.0; tangents],
                displacements: vec![0.0; if scene.needs.displacements { 3 * layout.vertices } else { 0 }],
                boxes: vec![Bounds::EMPTY; if scene.needs.boxes { layout.slots.len() } else { 0 }],
            },
        }
    }

    /// Bytes of stored U and x0: what a step of all domains reads if no two domains share a shape.
    pub fn stored_bytes(&self) -> usize {
        self.shapes.iter().map(|tiles| tiles.bytes().len() + size_of_val(tiles.rest())).sum()
    }

    /// The truncated modes of a domain in the last step; `None` for a scene without a truncation budget.
    pub fn truncation(&self, domain: usize) -> Option<&Truncation> {
        self.kept.as_ref().map(|kept| kept.truncation(domain))
    }

    fn deform_positions(&mut self, state: &State) {
        let inputs = Inputs {
            scene: &self.scene,
            state,
            shapes: &self.shapes,
            kept: self.kept.as_ref(),
            every_chunk: &self.every_chunk,
        };
        let Surface { positions, displacements, .. } = &mut self.surface;
        let displacements = self.scene.needs.displacements.then(|| Packed::new(3, displacements));
        let outputs = (Packed::new(3, positions), PerTile::new(&mut self.extents), displacements);
        deform::deform(inputs, self.vertex_work.of(&self.changes), outputs);
    }

    /// Updates the boxes of the domains that changed, from those of their tiles; does nothing if the scene keeps no
    /// boxes.
    fn keep_boxes(&mut self) {
        let (changes, work, extents) = (&self.changes, &self.vertex_work, &self.extents);
        self.surface.boxes.par_iter_mut().with_min_len(1024).enumerate().for_each(|(domain, all)| {
            if changes.is(domain) {
                *all = Extent::of_domain(&extents[work.tiles_of(domain)]);
            }
        });
    }
}

impl Deformer for CpuDeformer {
    fn backend(&self) -> Backend {
        Backend::Cpu
    }

    fn deform(&mut self, state: &State) -> Result<Deformed> {
        let begin = Instant::now();
        self.changes.follow(&self.scene, state);
        if let Some(kept) = &mut self.kept {
            kept.follow(&self.scene, state, &self.changes);
        }
        self.deform_positions(state);
        self.keep_boxes();
        // Both kinds of normals depend only on the domain's own positions and T.
        let corners = self.corner_work.of(&self.changes);
        if self.scene.needs.exact_normals {
            normals::normals(&self.scene, state, corners, &mut self.surface);
        } else {
            orient::orient(&self.scene, state, corners, &mut self.surface);
        }
        let light = self.scene.light_axes().map(|axes| Extent::along(&self.extents, &axes));
        Ok(Deformed { bounds: Extent::all(&self.extents), light, ms: begin.elapsed().as_secs_f64() * 1e3 })
    }

    fn surface(&mut self) -> Result<&Surface> {
        Ok(&self.surface)
    }
}
