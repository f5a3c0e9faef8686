//! Output buffers of positions, normals and tangents: OpenGL's buffers when the driver shares them, else owned ones.

use super::interop::{GlInterop, MapAccess, Mapping, RegisteredBuffer, with_mapped};
use super::pinned_surface::SurfaceLists;
use crate::gpu::launch::{Device, DeviceBuffer, download};
use crate::gpu::tables::plan::{BufferRole, DeformPlan};
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};

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
    positions: DeviceBuffer,
    normals: DeviceBuffer,
    tangents: Option<DeviceBuffer>,
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
            positions: DeviceBuffer::zeroed(device, positions)?,
            normals: DeviceBuffer::zeroed(device, normals)?,
            tangents: (tangents > 0).then(|| DeviceBuffer::zeroed(device, tangents)).transpose()?,
        })
    }

    fn addresses(&self) -> OutputAddresses {
        OutputAddresses {
            positions: self.positions.address(),
            normals: self.normals.address(),
            tangents: self.tangents.as_ref().map_or(0, DeviceBuffer::address),
        }
    }
}

/// OpenGL buffers of positions, normals and optionally tangents, registered with CUDA.
#[derive(Debug)]
pub(super) struct RegisteredOutputs {
    positions: RegisteredBuffer,
    normals: RegisteredBuffer,
    tangents: Option<RegisteredBuffer>,
}

impl RegisteredOutputs {
    /// Registers the buffers. `sizes`: bytes of positions, normals and tangents; 0 bytes of tangents means no tangents.
    ///
    /// # Errors
    /// `Fault` with the refused resource; nothing remains registered.
    fn register(device: &Device, buffers: GlVertexBuffers, sizes: [u64; 3]) -> Result<Self> {
        let missing = || fault_in("interop")("the renderer gave no buffer for tangents");
        let [positions, normals, tangents] = sizes;
        let interop = GlInterop::open(device, &buffers.positions)?;
        let register = |buffer, bytes| interop.register(device, GlBuffer { bytes, ..buffer });
        let mut outputs = Self {
            positions: register(buffers.positions, positions)?,
            normals: register(buffers.normals, normals)?,
            tangents: match tangents {
                0 => None,
                bytes => Some(register(buffers.tangents.ok_or_else(missing)?, bytes)?),
            },
        };
        outputs.with_addresses(device, MapAccess::Read, |_| Ok(()))?;
        Ok(outputs)
    }

    /// Maps all buffers, runs `work` with their addresses, and unmaps them. See [`with_mapped`].
    fn with_addresses(
        &mut self,
        device: &Device,
        access: MapAccess,
        work: impl FnOnce(OutputAddresses) -> Result<()>,
    ) -> Result<()> {
        let Self { positions, normals, tangents } = self;
        let buffers = [positions, normals].into_iter().chain(tangents);
        let mut mappings: Vec<Mapping<'_>> = buffers.map(|buffer| Mapping { buffer, access }).collect();
        with_mapped(device, &mut mappings, |addresses| {
            let address = |index: usize| addresses.get(index).copied().unwrap_or(0);
            work(OutputAddresses { positions: address(0), normals: address(1), tangents: address(2) })
        })
    }
}

impl OutputBuffers {
    /// Uses OpenGL's buffers if they are given and the driver registers them. A refusal is logged, not returned.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; `DeviceLost`.
    pub(super) fn new(device: &Device, plan: &DeformPlan, gl: Option<GlVertexBuffers>) -> Result<Self> {
        match gl.map(|buffers| RegisteredOutputs::register(device, buffers, output_sizes(plan))) {
            Some(Ok(interop)) => return Ok(Self::Shared(interop)),
            Some(Err(lost @ Error::DeviceLost { .. })) => return Err(lost),
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

    /// Copies a set into `lists`, which have the lengths of the plan or are empty, and waits for the copies.
    pub(super) fn read(&mut self, device: &Device, set: usize, lists: SurfaceLists<'_>) -> Result<()> {
        let SurfaceLists { positions, normals, tangents, .. } = lists;
        if let Self::Owned(sets) = self {
            let of = &sets[set];
            of.positions.read(device, 0, positions)?;
            of.normals.read(device, 0, normals)?;
            return of.tangents.as_ref().map_or(Ok(()), |buffer| buffer.read(device, 0, tangents));
        }
        self.with_addresses(device, OutputAccess { set, access: MapAccess::Read }, |from| {
            // SAFETY: each mapping checks that the outputs have the bytes of the plan, from which the lists have their
            // lengths.
            unsafe {
                download(device, from.positions, positions)?;
                download(device, from.normals, normals)?;
                download(device, from.tangents, tangents)
            }
        })
    }

    /// Runs `work` with the addresses of an existing set, mapped if it is shared. `work` submits to the device's stream.
    /// The addresses of a shared set are not valid after `work`.
    pub(super) fn with_addresses(
        &mut self,
        device: &Device,
        OutputAccess { set, access }: OutputAccess,
        work: impl FnOnce(OutputAddresses) -> Result<()>,
    ) -> Result<()> {
        match self {
            Self::Shared(outputs) => outputs.with_addresses(device, access, work),
            Self::Owned(sets) => work(sets[set].addresses()),
        }
    }

    /// The addresses of an existing set that is not shared, for a copy that runs while the set exists.
    ///
    /// # Errors
    /// `Fault` when the outputs are OpenGL's buffers, which have addresses only while they are mapped.
    pub(super) fn owned_addresses(&self, set: usize) -> Result<OutputAddresses> {
        match self {
            Self::Owned(sets) => Ok(sets[set].addresses()),
            Self::Shared(_) => Err(fault_in("fetch")("the outputs are OpenGL's buffers, which are not mapped")),
        }
    }
}
