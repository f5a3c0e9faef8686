//! The f32 deformer of machines without a GPU: rayon over a flat list of tiles of all domains, SIMD inside a tile.
//!
//! A vertex sums its modes in their order by fused multiply-adds, whatever tile it falls in, so equal inputs give
//! bit-identical outputs on any number of cores.

mod deform;
mod normals;
mod orient;
mod tile;

use std::sync::Arc;
use std::time::Instant;

use crate::deform::{Backend, Deformed, Deformer, Surface};
use crate::error::Result;
use crate::scene::{Scene, State};
use tile::Tile;

/// The deformer `cpu` of one scene.
#[derive(Debug)]
pub struct CpuDeformer {
    scene: Arc<Scene>,
    vertex_tiles: Vec<Tile>,
    corner_tiles: Vec<Tile>,
    surface: Surface,
}

impl CpuDeformer {
    /// Prepares the work lists of a scene and room for its vertices.
    pub fn new(scene: &Arc<Scene>) -> Self {
        let layout = &scene.layout;
        let tangents = if scene.needs.normal_maps { 4 * layout.corners } else { 0 };
        Self {
            scene: Arc::clone(scene),
            vertex_tiles: tile::cut(layout.slots.iter().map(|slot| slot.vertices)),
            corner_tiles: tile::cut(layout.slots.iter().map(|slot| slot.corners)),
            surface: Surface {
                positions: vec![0.0; 3 * layout.vertices],
                normals: vec![0.0; 3 * layout.corners],
                tangents: vec![0.0; tangents],
            },
        }
    }
}

impl Deformer for CpuDeformer {
    fn backend(&self) -> Backend {
        Backend::Cpu
    }

    fn deform(&mut self, state: &State) -> Result<Deformed> {
        let begin = Instant::now();
        let bounds = deform::deform(&self.scene, state, &self.vertex_tiles, &mut self.surface.positions);
        if self.scene.needs.exact_normals {
            normals::normals(&self.scene, state, &self.corner_tiles, &mut self.surface);
        } else {
            orient::orient(&self.scene, state, &self.corner_tiles, &mut self.surface);
        }
        Ok(Deformed { bounds, ms: begin.elapsed().as_secs_f64() * 1e3 })
    }

    fn surface(&mut self) -> Result<&Surface> {
        Ok(&self.surface)
    }
}
