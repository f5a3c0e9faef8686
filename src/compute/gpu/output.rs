//! Output buffers of positions, normals and tangents: OpenGL's buffers when the driver shares them, else owned ones.

use cudarc::driver::CudaSlice;

use super::GlBuffers;
use super::device::Device;
use super::interop::{Access, Interop};
use super::memory::{address, download, room};
use super::plan::{Plan, Role};
use modalcast_model::deform::Surface;
use modalcast_model::error::Result;

/// Device addresses of the outputs, valid while the outputs are mapped; `tangents` is 0 when the scene has none.
#[derive(Debug, Clone, Copy)]
pub(super) struct Addresses {
    pub positions: u64,
    pub normals: u64,
    pub tangents: u64,
}

/// The three output buffers; each has at least the bytes of the plan.
#[derive(Debug)]
pub(super) enum Output {
    /// One set, or two after a step was submitted while the host reads the other set.
    Own(Vec<Buffers>),
    /// Buffers that OpenGL draws from, so there is one set.
    Shared(Interop),
}

/// A set of owned buffers.
#[derive(Debug)]
pub(super) struct Buffers {
    positions: CudaSlice<u8>,
    normals: CudaSlice<u8>,
    tangents: Option<CudaSlice<u8>>,
}

/// An access to an output set.
#[derive(Debug, Clone, Copy)]
pub(super) struct Use {
    pub set: usize,
    pub access: Access,
}

/// Bytes of positions, normals and tangents.
pub(super) fn sizes(plan: &Plan) -> [u64; 3] {
    [Role::Positions, Role::Normals, Role::Tangents].map(|role| plan.bytes(role))
}

impl Buffers {
    fn new(device: &Device, plan: &Plan) -> Result<Self> {
        let [positions, normals, tangents] = sizes(plan);
        Ok(Self {
            positions: room(device, positions)?,
            normals: room(device, normals)?,
            tangents: (tangents > 0).then(|| room(device, tangents)).transpose()?,
        })
    }

    fn addresses(&self, device: &Device) -> Addresses {
        Addresses {
            positions: address(device, &self.positions),
            normals: address(device, &self.normals),
            tangents: self.tangents.as_ref().map_or(0, |buffer| address(device, buffer)),
        }
    }
}

impl Output {
    /// Uses OpenGL's buffers if they are given and the driver registers them. A refusal is logged, not returned.
    pub(super) fn new(device: &Device, plan: &Plan, gl: Option<GlBuffers>) -> Result<Self> {
        match gl.map(|buffers| Interop::register(device, buffers, sizes(plan))) {
            Some(Ok(interop)) => return Ok(Self::Shared(interop)),
            Some(Err(error)) => tracing::warn!(%error, "vertices are copied: CUDA cannot write into OpenGL's buffers"),
            None => {}
        }
        Ok(Self::Own(vec![Buffers::new(device, plan)?]))
    }

    pub(super) const fn is_shared(&self) -> bool {
        matches!(self, Self::Shared(_))
    }

    /// Maximum number of sets.
    pub(super) const fn most(&self) -> usize {
        if self.is_shared() { 1 } else { 2 }
    }

    /// Number of allocated sets.
    pub(super) fn count(&self) -> usize {
        match self {
            Self::Own(sets) => sets.len(),
            Self::Shared(_) => 1,
        }
    }

    /// Allocates a set unless it exists.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; the existing sets remain unchanged.
    pub(super) fn ensure(&mut self, device: &Device, plan: &Plan, set: usize) -> Result<()> {
        match self {
            Self::Own(sets) if sets.len() <= set => {
                sets.push(Buffers::new(device, plan)?);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Copies a set into `surface`, whose lists have the right lengths, and waits for the copies.
    pub(super) fn read(&mut self, device: &Device, set: usize, surface: &mut Surface) -> Result<()> {
        self.with(device, Use { set, access: Access::Read }, |from| {
            // SAFETY: the outputs have the bytes of the plan, from which the lists have their lengths.
            unsafe {
                download(device, from.positions, &mut surface.positions)?;
                download(device, from.normals, &mut surface.normals)?;
                download(device, from.tangents, &mut surface.tangents)
            }
        })
    }

    /// Runs `work` with the addresses of an existing set, mapped if it is shared. `work` submits to the device's
    /// stream.
    pub(super) fn with(
        &mut self,
        device: &Device,
        Use { set, access }: Use,
        work: impl FnOnce(Addresses) -> Result<()>,
    ) -> Result<()> {
        match self {
            Self::Shared(interop) => interop.mapped(device, access, work),
            Self::Own(sets) => work(sets[set].addresses(device)),
        }
    }
}
