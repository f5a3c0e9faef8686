//! CUDA: one launcher per kernel, with the kernel's name.

use std::sync::Arc;

use crate::deform::{Backend, Deformed, Deformer, Surface};
use crate::error::{Error, Result};
use crate::scene::{Scene, State};

/// OpenGL buffers to write into, by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GlBuffers {
    pub positions: u32,
    pub normals: u32,
    pub tangents: Option<u32>,
}

/// A CUDA device with its context current on this thread.
#[derive(Debug)]
pub struct Device {
    name: String,
}

impl Device {
    /// Opens a device by ordinal.
    ///
    /// # Errors
    /// `Unavailable` naming the missing library and what installs it; never a panic.
    pub fn open(ordinal: usize) -> Result<Arc<Self>> {
        Err(Error::Unavailable {
            what: "CUDA",
            reason: format!("device {ordinal}: not built yet"),
            remedy: String::new(),
        })
    }

    /// The device's name.
    pub fn name(&self) -> &str {
        &self.name
    }
}

/// The CUDA deformer of one scene.
#[derive(Debug)]
pub struct CudaDeformer {
    surface: Surface,
}

impl CudaDeformer {
    /// Packs a scene onto the device. With `gl`, output goes straight into those buffers when the driver allows it.
    ///
    /// # Errors
    /// `Fault` when the device refuses; `Unavailable` when NVRTC is missing.
    pub fn new(_device: &Arc<Device>, _scene: &Arc<Scene>, _gl: Option<GlBuffers>) -> Result<Self> {
        Ok(Self { surface: Surface::default() })
    }
}

impl Deformer for CudaDeformer {
    fn backend(&self) -> Backend {
        Backend::Cuda
    }

    fn deform(&mut self, _state: &State) -> Result<Deformed> {
        Err(crate::error::during("deform")("not built yet"))
    }

    fn surface(&mut self) -> Result<&Surface> {
        Ok(&self.surface)
    }
}
