//! Normals and tangents of a step: rigid or exact, as the scene asks.

use super::device::Device;
use super::inputs::Values;
use super::normals::Normals;
use super::orient::Orient;
use super::plan::Kernel;
use crate::error::Result;
use crate::scene::Scene;

/// The one of the two kernels that a scene has.
#[derive(Debug)]
pub(super) enum Directions {
    Rigid(Orient),
    Exact(Normals),
}

impl Directions {
    pub(super) fn new(device: &Device, scene: &Scene, kernel: &Kernel) -> Result<Self> {
        if scene.needs.exact_normals {
            Normals::new(device, scene, kernel).map(Self::Exact)
        } else {
            Orient::new(device, scene, kernel).map(Self::Rigid)
        }
    }

    /// Starts the kernel, behind the one that writes the positions.
    pub(super) fn launch(&self, device: &Device, values: Values) -> Result<()> {
        match self {
            Self::Rigid(orient) => orient.launch(device, values),
            Self::Exact(normals) => normals.launch(device, values),
        }
    }

    /// Whether the positions of the step are read again: OpenGL's buffers must then not be mapped for writing alone.
    pub(super) const fn reads_positions(&self) -> bool {
        matches!(self, Self::Exact(_))
    }
}
