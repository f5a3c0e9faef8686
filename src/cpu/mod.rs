//! The f32 deformer of machines without a GPU: rayon over a flat list of tiles, SIMD inside a tile.

use std::sync::Arc;

use crate::deform::{Backend, Deformed, Deformer, Surface};
use crate::error::Result;
use crate::scene::{Scene, State};

/// The deformer `cpu` of one scene.
#[derive(Debug)]
pub struct CpuDeformer {
    surface: Surface,
}

impl CpuDeformer {
    /// Prepares the work list of a scene.
    pub fn new(_scene: &Arc<Scene>) -> Self {
        Self { surface: Surface::default() }
    }
}

impl Deformer for CpuDeformer {
    fn backend(&self) -> Backend {
        Backend::Cpu
    }

    fn deform(&mut self, _state: &State) -> Result<Deformed> {
        Err(crate::error::during("deform")("not built yet"))
    }

    fn surface(&mut self) -> Result<&Surface> {
        Ok(&self.surface)
    }
}
