//! Output sets that steps write, and the copy of a drawn step to OpenGL's buffers. An output set has positions, normals
//! and tangents.
//!
//! If OpenGL can import memory of CUDA, the sets are in such memory, and OpenGL copies a set to its buffers at the beginning of
//! a frame. The host waits for the step before that copy is submitted, and for the copy before a later step writes the
//! set. With four sets, the next two steps can run while the frames of two steps are drawn.
//!
//! Otherwise CUDA maps OpenGL's buffers and copies a set into them. Steps do not write OpenGL's buffers themselves,
//! because mapping them makes the GPU change between the contexts of CUDA and OpenGL. That takes longer than the step
//! of a small scene, so only steps that are drawn pay for it. While every step is drawn, the copy is submitted together
//! with the step, so that the GPU changes its context once for both.

use std::ops::Range;
use std::rc::Rc;

use cudarc::driver::{result, sys};

use super::interop::{GlInterop, MapAccess, Mapping, RegisteredBuffer, with_mapped};
use super::pinned_surface::SurfaceLists;
use super::shared_range::CudaRange;
use super::views::DeviceRange;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, ExportedMemory, download};
use crate::gpu::tables::plan::{BufferRole, DeformPlan};
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};
use modalcast_model::shared_memory::{ExportedVertices, ImportedVertices, VertexImporter};

/// Alignment of the attributes in shared memory in bytes: the largest that OpenGL may demand of a storage buffer.
const ATTRIBUTE_ALIGNMENT: u64 = 256;

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
    /// One set. Another set is added when a step is submitted while the others are read.
    sets: Vec<OutputSet>,
    gl_outputs: GlOutputs,
}

/// How vertices get to OpenGL's buffers.
#[derive(Debug)]
enum GlOutputs {
    /// They are uploaded, because CUDA and OpenGL share nothing.
    None,
    /// CUDA maps OpenGL's buffers.
    Mapped(RegisteredOutputs),
    /// OpenGL imports the output sets.
    Imported(Rc<dyn VertexImporter>),
}

/// Memory that a step writes. The plan determines the sizes of its attributes.
#[derive(Debug)]
pub(super) struct OutputSet {
    addresses: OutputAddresses,
    /// Bytes of positions, normals and tangents.
    sizes: [u64; 3],
    memory: SetMemory,
}

#[derive(Debug)]
enum SetMemory {
    Own {
        /// Positions, normals and, if the scene has them, tangents.
        _buffers: Vec<DeviceBuffer>,
    },
    /// Shared with OpenGL, which releases its reference first.
    Shared { vertices: Box<dyn ImportedVertices>, memory: Rc<ExportedMemory> },
}

/// Bytes of positions, normals and tangents.
pub(super) fn output_sizes(plan: &DeformPlan) -> [u64; 3] {
    [BufferRole::Positions, BufferRole::Normals, BufferRole::Tangents].map(|role| plan.bytes(role))
}

impl OutputSet {
    fn new(device: &Device, plan: &DeformPlan) -> Result<Self> {
        let sizes = output_sizes(plan);
        let used_sizes = sizes.into_iter().filter(|bytes| *bytes > 0);
        let buffers = used_sizes.map(|bytes| DeviceBuffer::zeroed(device, bytes)).collect::<Result<Vec<_>>>()?;
        let mut addresses = buffers.iter().map(DeviceBuffer::address);
        let mut next_address = |bytes: u64| if bytes > 0 { addresses.next().unwrap_or(0) } else { 0 };
        let [positions, normals, tangents] = sizes.map(&mut next_address);
        let addresses = OutputAddresses { positions, normals, tangents };
        Ok(Self { addresses, sizes, memory: SetMemory::Own { _buffers: buffers } })
    }

    /// A set in memory that OpenGL imports.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory or OpenGL refuses it.
    fn shared(device: &Device, plan: &DeformPlan, importer: &dyn VertexImporter) -> Result<Self> {
        let sizes = output_sizes(plan);
        let ranges = attribute_ranges(sizes);
        let bytes = ranges.iter().map(|range| range.end).max().unwrap_or(0) as usize;
        let memory = ExportedMemory::new(device, bytes)?;
        let stream = device.stream();
        // SAFETY: the memory has at least these bytes, and the stream is synchronized before anything else uses it.
        let clear_result = unsafe { sys::cuMemsetD8Async(memory.address(), 0, bytes, stream.cu_stream()) };
        clear_result.result().and(stream.synchronize()).map_err(cuda_error("allocate"))?;
        let address_of = |range: Option<&Range<u64>>| range.map_or(0, |range| memory.address() + range.start);
        let [positions, normals, tangents] = [0, 1, 2].map(|index| address_of(ranges.get(index)));
        let addresses = OutputAddresses { positions, normals, tangents };
        let (descriptor, allocated_bytes) = (memory.export()?, memory.bytes() as u64);
        let vertices = importer.import(ExportedVertices { descriptor, allocated_bytes, ranges })?;
        Ok(Self { addresses, sizes, memory: SetMemory::Shared { vertices, memory: Rc::new(memory) } })
    }

    /// Address and bytes of each attribute that the scene has.
    fn attributes(&self) -> impl Iterator<Item = (u64, u64)> {
        let OutputAddresses { positions, normals, tangents } = self.addresses;
        [positions, normals, tangents].into_iter().zip(self.sizes).filter(|(_, bytes)| *bytes > 0)
    }

    /// The positions in shared memory.
    fn shared_positions(&self, device: &Device) -> Option<CudaRange> {
        match &self.memory {
            SetMemory::Own { .. } => None,
            // The positions are at the beginning.
            SetMemory::Shared { memory, .. } => Some(CudaRange::new(device, memory, 0..self.sizes[0])),
        }
    }

    /// OpenGL's side of shared memory.
    fn imported(&self) -> Option<&dyn ImportedVertices> {
        match &self.memory {
            SetMemory::Own { .. } => None,
            SetMemory::Shared { vertices, .. } => Some(vertices.as_ref()),
        }
    }
}

/// Ranges of positions, normals and, if their size is not 0, tangents in shared memory.
fn attribute_ranges([positions, normals, tangents]: [u64; 3]) -> Vec<Range<u64>> {
    let mut begin = 0;
    let mut next_range = |bytes: u64| {
        let range = begin..begin + bytes;
        begin = range.end.next_multiple_of(ATTRIBUTE_ALIGNMENT);
        range
    };
    let vertices = [positions, normals].map(&mut next_range);
    vertices.into_iter().chain((tangents > 0).then(|| next_range(tangents))).collect()
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
            for ((source, bytes), target) in set.attributes().zip(targets) {
                // SAFETY: the mapping checks that the target has the bytes of the plan, which are those of the source.
                // The deformer owns both, which do not overlap, and waits for the device's stream before it drops them.
                unsafe { result::memcpy_dtod_async(*target, source, bytes as usize, device.stream().cu_stream()) }
                    .map_err(cuda_error("interop"))?;
            }
            Ok(())
        })
    }
}

impl OutputBuffers {
    /// Maximum number of sets: one that is read while a step writes the other. OpenGL copies imported sets at the beginning of a
    /// frame, so two frames in flight may still read theirs while two steps are computed.
    pub(super) const fn max_sets(&self) -> usize {
        if matches!(self.gl_outputs, GlOutputs::Imported(_)) { 4 } else { 2 }
    }

    /// Allocates a set. If OpenGL's buffers are given, lets OpenGL import the set, or else registers the buffers. If
    /// both fail, logs the errors.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory; `DeviceLost`.
    pub(super) fn new(device: &Device, plan: &DeformPlan, gl_buffers: Option<GlVertexBuffers>) -> Result<Self> {
        if let Some(importer) = gl_buffers.as_ref().and_then(|buffers| buffers.importer.clone()) {
            match OutputSet::shared(device, plan, importer.as_ref()) {
                Ok(set) => return Ok(Self { sets: vec![set], gl_outputs: GlOutputs::Imported(importer) }),
                Err(lost @ Error::DeviceLost { .. }) => return Err(lost),
                Err(error) => tracing::warn!(%error, "CUDA maps OpenGL's buffers: OpenGL cannot import the vertices"),
            }
        }
        let gl_outputs =
            match gl_buffers.map(|buffers| RegisteredOutputs::register(device, buffers, output_sizes(plan))) {
                Some(Ok(registered)) => GlOutputs::Mapped(registered),
                Some(Err(lost @ Error::DeviceLost { .. })) => return Err(lost),
                Some(Err(error)) => {
                    tracing::warn!(%error, "vertices are uploaded: CUDA cannot write OpenGL's buffers");
                    GlOutputs::None
                }
                None => GlOutputs::None,
            };
        Ok(Self { sets: vec![OutputSet::new(device, plan)?], gl_outputs })
    }

    /// Whether OpenGL's buffers can be filled on the device.
    pub(super) const fn has_gl_buffers(&self) -> bool {
        !matches!(self.gl_outputs, GlOutputs::None)
    }

    /// Whether CUDA maps OpenGL's buffers, so that a copy into them is best submitted together with a step.
    pub(super) const fn maps_gl_buffers(&self) -> bool {
        matches!(self.gl_outputs, GlOutputs::Mapped(_))
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
            self.sets.push(match &self.gl_outputs {
                GlOutputs::Imported(importer) => OutputSet::shared(device, plan, importer.as_ref())?,
                GlOutputs::None | GlOutputs::Mapped(_) => OutputSet::new(device, plan)?,
            });
        }
        Ok(())
    }

    /// Runs `submit_step`, which submits the step that writes a set, and copies the set into OpenGL's buffers. Both are
    /// on the device's stream: after all OpenGL commands issued before, and before all OpenGL commands issued later.
    ///
    /// # Errors
    /// The error of `submit_step`; `Fault` without mapped OpenGL buffers, or when the device fails.
    pub(super) fn copy_to_gl_after(
        &mut self,
        device: &Device,
        set: usize,
        submit_step: impl FnOnce() -> Result<()>,
    ) -> Result<()> {
        match &mut self.gl_outputs {
            GlOutputs::Mapped(gl_buffers) => gl_buffers.copy_after(device, &self.sets[set], submit_step),
            GlOutputs::None | GlOutputs::Imported(_) => {
                Err(fault("interop", "expected OpenGL buffers that CUDA can write, got none"))
            }
        }
    }

    /// Lets OpenGL copy a set into its buffers. The caller has waited for the step that wrote the set.
    ///
    /// # Errors
    /// `Fault` unless OpenGL has imported the set, or if OpenGL fails.
    pub(super) fn copy_by_gl(&self, set: usize) -> Result<()> {
        let missing_import = || fault("interop", "expected an output that OpenGL has imported, got none");
        self.sets[set].imported().ok_or_else(missing_import)?.copy_to_scene()
    }

    /// The positions of a set, if OpenGL has imported it.
    pub(super) fn shared_positions(&self, device: &Device, set: usize) -> Option<CudaRange> {
        self.sets[set].shared_positions(device)
    }

    /// Whether OpenGL still copies from a set.
    pub(super) fn is_read_by_gl(&self, set: usize) -> bool {
        self.sets[set].imported().is_some_and(|vertices| !vertices.is_copied())
    }

    /// Waits until OpenGL no longer copies from a set.
    ///
    /// # Errors
    /// `Fault` if OpenGL does not finish.
    pub(super) fn wait_for_gl(&self, set: usize) -> Result<()> {
        self.sets[set].imported().map_or(Ok(()), ImportedVertices::wait_for_copy)
    }

    /// Copies a set into `surface_lists` and waits for the copies. Each list must have the length of the plan or be
    /// empty.
    pub(super) fn read(&self, device: &Device, set: usize, surface_lists: SurfaceLists<'_>) -> Result<()> {
        let SurfaceLists { positions, normals, tangents, .. } = surface_lists;
        for ((address, bytes), list) in self.sets[set].attributes().zip([positions, normals, tangents]) {
            if size_of_val(list) as u64 > bytes {
                let got = size_of_val(list);
                return Err(fault("download", format!("expected a list of at most {bytes} bytes, got {got}")));
            }
            // SAFETY: the attribute has at least the bytes of the list.
            unsafe { download(device, address, list) }?;
        }
        Ok(())
    }

    /// The ranges of positions, normals and tangents of an existing set.
    pub(super) fn ranges(&self, set: usize) -> [DeviceRange; 3] {
        let OutputSet { addresses: OutputAddresses { positions, normals, tangents }, sizes, .. } = &self.sets[set];
        let addresses = [*positions, *normals, *tangents];
        std::array::from_fn(|index| DeviceRange { address: addresses[index], bytes: sizes[index] })
    }

    /// The addresses of an existing set. They are valid while the set exists.
    pub(super) fn addresses(&self, set: usize) -> OutputAddresses {
        self.sets[set].addresses
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attributes_in_shared_memory_are_aligned_and_do_not_overlap() {
        assert_eq!(attribute_ranges([12, 256, 0]), [0..12, 256..512]);
        assert_eq!(attribute_ranges([300, 36, 48]), [0..300, 512..548, 768..816]);
    }
}
