//! Output buffers: OpenGL's buffers if CUDA can register them, else own buffers. An output set is one buffer each of
//! positions, normals and tangents.

use super::interop::{GlInterop, MapAccess, Mapping, RegisteredBuffer, with_mapped};
use super::pinned_surface::SurfaceLists;
use crate::gpu::launch::{Device, DeviceBuffer, download};
use crate::gpu::tables::plan::{BufferRole, DeformPlan};
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};

/// Device addresses of the outputs. The address of an OpenGL buffer is valid only while the buffer is mapped.
/// `tangents` is 0 if the scene has no tangents.
#[derive(Debug, Clone, Copy)]
pub(super) struct OutputAddresses {
    pub positions: u64,
    pub normals: u64,
    pub tangents: u64,
}

/// The output sets. Each buffer of a set has at least the bytes of the plan.
#[derive(Debug)]
pub(super) enum OutputBuffers {
    /// One set. A second set is added when a step is submitted while the host reads the first.
    Owned(Vec<OutputSet>),
    /// One set: the buffers that OpenGL draws from.
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
    /// Registers the buffers. `sizes` are the bytes of positions, normals and tangents, 0 without tangents.
    ///
    /// # Errors
    /// `Fault` with the buffer that cannot be registered. No buffer remains registered.
    fn register(device: &Device, buffers: GlVertexBuffers, sizes: [u64; 3]) -> Result<Self> {
        let missing_tangents = || fault("interop", "expected an OpenGL buffer for tangents, got none");
        let [positions, normals, tangents] = sizes;
        let interop = GlInterop::open(device, &buffers.positions)?;
        let register_buffer = |buffer, bytes| interop.register(device, GlBuffer { bytes, ..buffer });
        let mut outputs = Self {
            positions: register_buffer(buffers.positions, positions)?,
            normals: register_buffer(buffers.normals, normals)?,
            tangents: match tangents {
                0 => None,
                bytes => Some(register_buffer(buffers.tangents.ok_or_else(missing_tangents)?, bytes)?),
            },
        };
        // Map once, because mapping checks the sizes of the buffers.
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
    /// Registers OpenGL's buffers if they are given. If this fails, logs the error and allocates own buffers.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; `DeviceLost`.
    pub(super) fn new(device: &Device, plan: &DeformPlan, gl_buffers: Option<GlVertexBuffers>) -> Result<Self> {
        match gl_buffers.map(|buffers| RegisteredOutputs::register(device, buffers, output_sizes(plan))) {
            Some(Ok(outputs)) => return Ok(Self::Shared(outputs)),
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

    /// Copies a set into `surface_lists` and waits for the copies. Each list must have the length of the plan or be
    /// empty.
    pub(super) fn read(&mut self, device: &Device, set: usize, surface_lists: SurfaceLists<'_>) -> Result<()> {
        let SurfaceLists { positions, normals, tangents, .. } = surface_lists;
        if let Self::Owned(sets) = self {
            let buffers = &sets[set];
            buffers.positions.read(device, 0, positions)?;
            buffers.normals.read(device, 0, normals)?;
            return buffers.tangents.as_ref().map_or(Ok(()), |buffer| buffer.read(device, 0, tangents));
        }
        self.with_addresses(device, OutputAccess { set, access: MapAccess::Read }, |addresses| {
            // SAFETY: each mapping checks that the outputs have the bytes of the plan. The lists have these sizes or
            // are empty.
            unsafe {
                download(device, addresses.positions, positions)?;
                download(device, addresses.normals, normals)?;
                download(device, addresses.tangents, tangents)
            }
        })
    }

    /// Runs `work` with the addresses of an existing set. A shared set is mapped only while `work` runs, so its
    /// addresses are not valid after `work`. `work` submits to the device's stream.
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

    /// The addresses of an existing set that is not shared. They are valid while the set exists.
    ///
    /// # Errors
    /// `Fault` when the outputs are OpenGL's buffers, which have addresses only while they are mapped.
    pub(super) fn owned_addresses(&self, set: usize) -> Result<OutputAddresses> {
        match self {
            Self::Owned(sets) => Ok(sets[set].addresses()),
            Self::Shared(_) => Err(fault("fetch", "expected buffers of the deformer, got OpenGL's buffers")),
        }
    }
}
