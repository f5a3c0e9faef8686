//! Where positions, normals and tangents go: OpenGL's buffers when the driver allows it, else buffers of our own.

use cudarc::driver::CudaSlice;

use super::GlBuffers;
use super::device::Device;
use super::interop::{Access, Interop};
use super::memory::{address, download, room};
use super::plan::{Plan, Role};
use crate::deform::Surface;
use crate::error::Result;

/// Device addresses of the outputs while they may be used; `tangents` is 0 when the scene has none.
#[derive(Debug, Clone, Copy)]
pub(super) struct Addresses {
    pub positions: u64,
    pub normals: u64,
    pub tangents: u64,
}

/// The three outputs; each has exactly the bytes that the plan says, or more.
#[derive(Debug)]
pub(super) enum Output {
    Own { positions: CudaSlice<u8>, normals: CudaSlice<u8>, tangents: Option<CudaSlice<u8>> },
    Shared(Interop),
}

/// Bytes of positions, normals and tangents.
pub(super) fn sizes(plan: &Plan) -> [u64; 3] {
    [Role::Positions, Role::Normals, Role::Tangents].map(|role| plan.bytes(role))
}

impl Output {
    /// OpenGL's buffers when they are given and the driver registers them; a refusal is logged, not returned.
    pub(super) fn new(device: &Device, plan: &Plan, gl: Option<GlBuffers>) -> Result<Self> {
        match gl.map(|buffers| Interop::register(device, buffers, sizes(plan))) {
            Some(Ok(interop)) => return Ok(Self::Shared(interop)),
            Some(Err(error)) => tracing::warn!(%error, "vertices are copied: CUDA cannot write into OpenGL's buffers"),
            None => {}
        }
        let [positions, normals, tangents] = sizes(plan);
        Ok(Self::Own {
            positions: room(device, positions)?,
            normals: room(device, normals)?,
            tangents: (tangents > 0).then(|| room(device, tangents)).transpose()?,
        })
    }

    pub(super) const fn is_shared(&self) -> bool {
        matches!(self, Self::Shared(_))
    }

    /// Lets `work` write all of the outputs, or with `keep` parts of them, so that the rest stays what it was, and read
    /// them.
    pub(super) fn write(
        &mut self,
        device: &Device,
        keep: bool,
        work: impl FnOnce(Addresses) -> Result<()>,
    ) -> Result<()> {
        self.with(device, if keep { Access::WriteSome } else { Access::WriteAll }, work)
    }

    /// Copies the outputs into `surface`, whose lists have the right lengths, and waits for it.
    pub(super) fn read(&mut self, device: &Device, surface: &mut Surface) -> Result<()> {
        self.with(device, Access::Read, |from| {
            // SAFETY: the outputs have the bytes of the plan, and the lists were made from the same numbers.
            unsafe {
                download(device, from.positions, &mut surface.positions)?;
                download(device, from.normals, &mut surface.normals)?;
                download(device, from.tangents, &mut surface.tangents)
            }
        })
    }

    fn with(&mut self, device: &Device, access: Access, work: impl FnOnce(Addresses) -> Result<()>) -> Result<()> {
        match self {
            Self::Shared(interop) => interop.mapped(device, access, work),
            Self::Own { positions, normals, tangents } => work(Addresses {
                positions: address(device, positions),
                normals: address(device, normals),
                tangents: tangents.as_ref().map_or(0, |buffer| address(device, buffer)),
            }),
        }
    }
}
