//! Output buffers: the sets that steps write, and the OpenGL buffers to which a drawn step is copied on the device. An
//! output set is one buffer each of positions, normals and tangents.
//!
//! Steps do not write OpenGL's buffers themselves, because mapping them makes the GPU change between the contexts of CUDA
//! and OpenGL. That takes longer than the step of a small scene, so only steps that are drawn pay for it. While every
//! step is drawn, the copy is submitted together with the step, so that the GPU changes its context once for both.

use cudarc::driver::result;

use super::interop::{GlInterop, MapAccess, Mapping, RegisteredBuffer, with_mapped};
use super::pinned_surface::SurfaceLists;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer};
use crate::gpu::tables::plan::{BufferRole, DeformPlan};
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};

/// Device addresses of an output set. `tangents` is 0 if the scene has no tangents.
#[derive(Debug, Clone, Copy)]
pub(super) struct OutputAddresses {
    pub positions: u64,
    pub normals: u64,
    pub tangents: u64,
}

/// The output sets and the buffers that OpenGL draws from.
#[derive(Debug)]
pub(super) struct OutputBuffers {
    /// One set. A second set is added when a step is submitted while the host reads the first.
    sets: Vec<OutputSet>,
    /// `None` if CUDA cannot write OpenGL's buffers.
    gl_buffers: Option<RegisteredOutputs>,
}

/// Buffers that a step writes. Each has the bytes of the plan.
#[derive(Debug)]
pub(super) struct OutputSet {
    positions: DeviceBuffer,
    normals: DeviceBuffer,
    tangents: Option<DeviceBuffer>,
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
        work: impl FnOnce(&[u64]) -> Result<()>,
    ) -> Result<()> {
        let Self { positions, normals, tangents } = self;
        let buffers = [positions, normals].into_iter().chain(tangents);
        let mut mappings: Vec<Mapping<'_>> = buffers.map(|buffer| Mapping { buffer, access }).collect();
        with_mapped(device, &mut mappings, work)
    }

    /// Maps the buffers, runs `submit_step`, and copies an output set into the buffers, on the device's stream.
    fn copy_after(&mut self, device: &Device, set: &OutputSet, submit_step: impl FnOnce() -> Result<()>) -> Result<()> {
        self.with_addresses(device, MapAccess::WriteDiscard, |targets| {
            submit_step()?;
            let sources = [Some(&set.positions), Some(&set.normals), set.tangents.as_ref()];
            for (source, target) in sources.into_iter().flatten().zip(targets) {
                // SAFETY: the mapping checks that the target has the bytes of the plan, which are those of the source.
                // The deformer owns both, and waits for its stream before it drops them. The buffers do not overlap.
                unsafe {
                    result::memcpy_dtod_async(
                        *target,
                        source.address(),
                        source.bytes() as usize,
                        device.stream().cu_stream(),
                    )
                }
                .map_err(cuda_error("interop"))?;
            }
            Ok(())
        })
    }
}

impl OutputBuffers {
    /// Maximum number of sets.
    pub(super) const MAX_SETS: usize = 2;

    /// Allocates a set, and registers OpenGL's buffers if they are given. If that fails, logs the error.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; `DeviceLost`.
    pub(super) fn new(device: &Device, plan: &DeformPlan, gl_buffers: Option<GlVertexBuffers>) -> Result<Self> {
        let gl_buffers =
            match gl_buffers.map(|buffers| RegisteredOutputs::register(device, buffers, output_sizes(plan))) {
                Some(Ok(registered)) => Some(registered),
                Some(Err(lost @ Error::DeviceLost { .. })) => return Err(lost),
                Some(Err(error)) => {
                    tracing::warn!(%error, "vertices are uploaded: CUDA cannot write OpenGL's buffers");
                    None
                }
                None => None,
            };
        Ok(Self { sets: vec![OutputSet::new(device, plan)?], gl_buffers })
    }

    /// Whether OpenGL's buffers can be filled on the device.
    pub(super) const fn has_gl_buffers(&self) -> bool {
        self.gl_buffers.is_some()
    }

    /// Number of allocated sets.
    pub(super) const fn count(&self) -> usize {
        self.sets.len()
    }

    /// Allocates a set unless it exists.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; the existing sets remain unchanged.
    pub(super) fn ensure_set(&mut self, device: &Device, plan: &DeformPlan, set: usize) -> Result<()> {
        if self.sets.len() <= set {
            self.sets.push(OutputSet::new(device, plan)?);
        }
        Ok(())
    }

    /// Runs `submit_step`, which submits the step that writes a set, and copies the set into OpenGL's buffers. Both are
    /// on the device's stream: after all OpenGL commands issued before, and before all OpenGL commands issued later.
    ///
    /// # Errors
    /// The error of `submit_step`; `Fault` without OpenGL's buffers, or when the device fails.
    pub(super) fn copy_to_gl_after(
        &mut self,
        device: &Device,
        set: usize,
        submit_step: impl FnOnce() -> Result<()>,
    ) -> Result<()> {
        let missing_buffers = || fault("interop", "expected OpenGL buffers that CUDA can write, got none");
        let gl_buffers = self.gl_buffers.as_mut().ok_or_else(missing_buffers)?;
        gl_buffers.copy_after(device, &self.sets[set], submit_step)
    }

    /// Copies a set into `surface_lists` and waits for the copies. Each list must have the length of the plan or be
    /// empty.
    pub(super) fn read(&self, device: &Device, set: usize, surface_lists: SurfaceLists<'_>) -> Result<()> {
        let SurfaceLists { positions, normals, tangents, .. } = surface_lists;
        let buffers = &self.sets[set];
        buffers.positions.read(device, 0, positions)?;
        buffers.normals.read(device, 0, normals)?;
        buffers.tangents.as_ref().map_or(Ok(()), |buffer| buffer.read(device, 0, tangents))
    }

    /// The addresses of an existing set. They are valid while the set exists.
    pub(super) fn addresses(&self, set: usize) -> OutputAddresses {
        self.sets[set].addresses()
    }
}
