//! Output buffers of positions, normals and tangents: OpenGL's buffers when the driver shares them, else owned ones.

use cudarc::driver::CudaSlice;

use super::device::Device;
use super::interop::{MapAccess, RegisteredOutputs};
use super::memory::{address, alloc_zeroed, download};
use super::plan::{BufferRole, DeformPlan};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::Result;
use modalcast_model::raster::GlVertexBuffers;

/// Device addresses of the outputs, valid while the outputs are mapped; `tangents` is 0 when the scene has none.
#[derive(Debug, Clone, Copy)]
pub(super) struct OutputAddresses {
    pub positions: u64,
    pub normals: u64,
    pub tangents: u64,
}

/// The three output buffers; each has at least the bytes of the plan.
#[derive(Debug)]
pub(super) enum OutputBuffers {
    /// One set, or two after a step was submitted while the host reads the other set.
    Owned(Vec<OutputSet>),
    /// Buffers that OpenGL draws from, so there is one set.
    Shared(RegisteredOutputs),
}

/// A set of owned buffers.
#[derive(Debug)]
pub(super) struct OutputSet {
    positions: CudaSlice<u8>,
    normals: CudaSlice<u8>,
    tangents: Option<CudaSlice<u8>>,
}

/// An access to an output set.
#[derive(Debug, Clone, Copy)]
pub(super) struct OutputAccess {
    pub set: usize,
    pub access: MapAccess,
}

/// Bytes of positions, normals and tangents.
pub(super) fn output_sizes(plan: &DeformPlan) -> [u64; 3] {
    [BufferRole::Positions, BufferRole::Normals, BufferRole::Tangents].map(|role| plan.bytes(role))
}

impl OutputSet {
    fn new(device: &Device, plan: &DeformPlan) -> Result<Self> {
        let [positions, normals, tangents] = output_sizes(plan);
        Ok(Self {
            positions: alloc_zeroed(device, positions)?,
            normals: alloc_zeroed(device, normals)?,
            tangents: (tangents > 0).then(|| alloc_zeroed(device, tangents)).transpose()?,
        })
    }

    fn addresses(&self, device: &Device) -> OutputAddresses {
        OutputAddresses {
            positions: address(device, &self.positions),
            normals: address(device, &self.normals),
            tangents: self.tangents.as_ref().map_or(0, |buffer| address(device, buffer)),
        }
    }
}

impl OutputBuffers {
    /// Uses OpenGL's buffers if they are given and the driver registers them. A refusal is logged, not returned.
    pub(super) fn new(device: &Device, plan: &DeformPlan, gl: Option<GlVertexBuffers>) -> Result<Self> {
        match gl.map(|buffers| RegisteredOutputs::register(device, buffers, output_sizes(plan))) {
            Some(Ok(interop)) => return Ok(Self::Shared(interop)),
            Some(Err(error)) => tracing::warn!(%error, "vertices are copied: CUDA cannot write into OpenGL's buffers"),
            None => {}
        }
        Ok(Self::Owned(vec![OutputSet::new(device, plan)?]))
    }

    pub(super) const fn is_shared(&self) -> bool {
        matches!(self, Self::Shared(_))
    }

    /// Maximum number of sets.
    pub(super) const fn max_sets(&self) -> usize {
        if self.is_shared() { 1 } else { 2 }
    }

    /// Number of allocated sets.
    pub(super) fn count(&self) -> usize {
        match self {
            Self::Owned(sets) => sets.len(),
            Self::Shared(_) => 1,
        }
    }

    /// Allocates a set unless it exists.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; the existing sets remain unchanged.
    pub(super) fn ensure_set(&mut self, device: &Device, plan: &DeformPlan, set: usize) -> Result<()> {
        match self {
            Self::Owned(sets) if sets.len() <= set => {
                sets.push(OutputSet::new(device, plan)?);
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Copies a set into `surface`, whose lists have the right lengths, and waits for the copies.
    pub(super) fn read(&mut self, device: &Device, set: usize, surface: &mut DeformedSurface) -> Result<()> {
        self.with_addresses(device, OutputAccess { set, access: MapAccess::Read }, |from| {
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
    pub(super) fn with_addresses(
        &mut self,
        device: &Device,
        OutputAccess { set, access }: OutputAccess,
        work: impl FnOnce(OutputAddresses) -> Result<()>,
    ) -> Result<()> {
        match self {
            Self::Shared(interop) => interop.with_mapped(device, access, work),
            Self::Owned(sets) => work(sets[set].addresses(device)),
        }
    }
}
