//! CUDA-OpenGL interop: OpenGL buffers as device memory. They are registered once, mapped together for each step, and
//! unmapped before the next draw.
//!
//! Map and unmap order the two APIs on the device, so the host never waits. OpenGL commands issued before a map
//! complete before CUDA work that is submitted to the stream after it. CUDA work submitted before an unmap completes
//! before OpenGL commands that are issued after it. A frame may therefore be in flight when the next step is submitted:
//! the step waits on the device until the frame is drawn and its pixels are read back. A step never runs concurrently
//! with a frame that uses its buffers, and this wait is not part of the step's time (`step_slot`).

use std::ffi::{c_int, c_uint};
use std::sync::Arc;

use cudarc::driver::sys::{self, CUgraphicsResource, CUresult};
use cudarc::driver::{CudaContext, DriverError};
use libloading::Library;

use super::device::Device;
use super::output::OutputAddresses;
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};

const STAGE: &str = "interop";

/// `CU_GL_DEVICE_LIST_ALL`: every CUDA device that the current OpenGL context uses.
const GL_DEVICE_LIST_ALL: c_uint = 1;

/// Maximum number of buffers that are mapped together.
const MAX_MAPPED_BUFFERS: usize = 3;

type RegisterBuffer = unsafe extern "C" fn(*mut CUgraphicsResource, c_uint, c_uint) -> CUresult;
type GetDevices = unsafe extern "C" fn(*mut c_uint, *mut c_int, c_uint, c_uint) -> CUresult;

/// Purpose of a mapping. With `WriteDiscard` the driver may discard the old contents of the buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MapAccess {
    WriteDiscard,
    ReadWrite,
    Read,
}

/// Registers buffers of the OpenGL context that is current on this thread.
#[derive(Debug)]
pub(super) struct GlInterop {
    register: RegisterBuffer,
    /// Keeps `register` loaded.
    _library: Library,
}

impl GlInterop {
    /// Checks that the current OpenGL context draws on this device.
    ///
    /// # Errors
    /// `Fault` with the reason why nothing can be shared.
    pub(super) fn open(device: &Device) -> Result<Self> {
        let fail = fault_in(STAGE);
        // SAFETY: the driver library is already loaded, so this only increments its reference count and runs no
        // initializer.
        let library = unsafe { Library::new("libcuda.so.1") }.map_err(|error| fail(error.to_string()))?;
        check_device(&library, device)?;
        // SAFETY: the type matches the declaration in cudaGL.h.
        let register = unsafe { library.get::<RegisterBuffer>(b"cuGraphicsGLRegisterBuffer\0") };
        let register = *register.map_err(|error| fail(error.to_string()))?;
        Ok(Self { register, _library: library })
    }

    /// Registers a buffer. Each mapping checks that the buffer has at least `buffer.bytes` bytes.
    ///
    /// # Errors
    /// `Fault` with the name of the buffer that the driver refused.
    pub(super) fn register(&self, device: &Device, buffer: GlBuffer) -> Result<RegisteredBuffer> {
        let _current = buffer.owner.make_current()?;
        let mut resource = std::ptr::null_mut();
        // SAFETY: `resource` is a live pointer; the driver refuses an unknown buffer name.
        let answer = unsafe { (self.register)(&mut resource, buffer.name, 0) };
        answer.result().map_err(|error| fault_in(STAGE)(format!("buffer {}: {error}", buffer.name)))?;
        Ok(RegisteredBuffer { resource, buffer, access: None, context: Arc::clone(device.context()) })
    }
}

/// An OpenGL buffer that CUDA may map; unregistered on drop. Its handle keeps the buffer and its context alive until
/// then.
#[derive(Debug)]
pub(super) struct RegisteredBuffer {
    resource: CUgraphicsResource,
    buffer: GlBuffer,
    access: Option<MapAccess>,
    context: Arc<CudaContext>,
}

impl RegisteredBuffer {
    pub(super) const fn buffer(&self) -> &GlBuffer {
        &self.buffer
    }

    /// Announces the purpose of the next mapping to the driver, if it differs from the last one.
    fn set_map_flags(&mut self, access: MapAccess) -> Result<(), DriverError> {
        use sys::CUgraphicsMapResourceFlags_enum as Flags;
        if self.access == Some(access) {
            return Ok(());
        }
        let flags = match access {
            MapAccess::WriteDiscard => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_WRITE_DISCARD,
            MapAccess::ReadWrite => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_NONE,
            MapAccess::Read => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_READ_ONLY,
        };
        self.access = None;
        // SAFETY: the resource is registered and unmapped.
        unsafe { sys::cuGraphicsResourceSetMapFlags_v2(self.resource, flags as c_uint) }.result()?;
        self.access = Some(access);
        Ok(())
    }

    /// Device address of the mapped buffer.
    ///
    /// # Errors
    /// `Fault` when the buffer is smaller than expected.
    fn address(&self) -> Result<u64> {
        let fail = fault_in(STAGE);
        let GlBuffer { name, bytes: expected, .. } = self.buffer;
        let (mut place, mut bytes) = (0, 0);
        // SAFETY: both pointers are live and the resource is a mapped buffer.
        unsafe { sys::cuGraphicsResourceGetMappedPointer_v2(&mut place, &mut bytes, self.resource) }
            .result()
            .map_err(|error| fail(error.to_string()))?;
        if (bytes as u64) < expected {
            return Err(fail(format!("buffer {name} has {bytes} bytes, {expected} are needed")));
        }
        Ok(place)
    }
}

impl Drop for RegisteredBuffer {
    fn drop(&mut self) {
        // Errors are ignored: no cleanup remains, and a failed device reports its error at the next call.
        self.context.bind_to_thread().ok();
        let _current = self.buffer.owner.make_current();
        // SAFETY: the resource was registered once and is unregistered once.
        unsafe { sys::cuGraphicsUnregisterResource(self.resource) }.result().ok();
    }
}

/// Maps at most three distinct buffers by one call, runs `work` with their addresses, and unmaps them whether `work`
/// succeeds or not. `work` submits to the device's stream.
///
/// # Errors
/// The error of `work`, or a `Fault` of mapping.
pub(super) fn with_mapped(
    device: &Device,
    uses: &mut [(&mut RegisteredBuffer, MapAccess)],
    work: impl FnOnce([u64; MAX_MAPPED_BUFFERS]) -> Result<()>,
) -> Result<()> {
    let fail = fault_in(STAGE);
    let mut resources = [std::ptr::null_mut(); MAX_MAPPED_BUFFERS];
    for (place, (registered, access)) in resources.iter_mut().zip(uses.iter_mut()) {
        registered.set_map_flags(*access).map_err(&fail)?;
        *place = registered.resource;
    }
    let _current = uses.first().map(|(registered, _)| registered.buffer.owner.make_current()).transpose()?;
    let stream = device.stream().cu_stream();
    let (count, resources) = (uses.len().min(MAX_MAPPED_BUFFERS) as c_uint, resources.as_mut_ptr());
    // SAFETY: all resources are registered and unmapped, and the stream belongs to the same device. OpenGL frames that
    // read the buffers complete before later work on the stream.
    unsafe { sys::cuGraphicsMapResources(count, resources, stream) }.result().map_err(&fail)?;
    let worked = addresses(uses).and_then(work);
    // SAFETY: they were mapped above; the work that `work` submitted completes before OpenGL uses the buffers.
    let unmapped = unsafe { sys::cuGraphicsUnmapResources(count, resources, stream) }.result();
    worked.and(unmapped.map_err(fail))
}

fn addresses(uses: &[(&mut RegisteredBuffer, MapAccess)]) -> Result<[u64; MAX_MAPPED_BUFFERS]> {
    let mut list = [0; MAX_MAPPED_BUFFERS];
    for (place, (registered, _)) in list.iter_mut().zip(uses) {
        *place = registered.address()?;
    }
    Ok(list)
}

/// OpenGL buffers of positions, normals and optionally tangents, registered with CUDA.
#[derive(Debug)]
pub(super) struct RegisteredOutputs {
    positions: RegisteredBuffer,
    normals: RegisteredBuffer,
    tangents: Option<RegisteredBuffer>,
}

impl RegisteredOutputs {
    /// Registers the buffers. `sizes`: bytes of positions, normals
    /// and tangents; 0 bytes of tangents means no tangents.
    ///
    /// # Errors
    /// `Fault` with the refused resource; nothing remains registered.
    pub(super) fn register(device: &Device, buffers: GlVertexBuffers, sizes: [u64; 3]) -> Result<Self> {
        let missing = || fault_in(STAGE)("the renderer gave no buffer for tangents");
        let [positions, normals, tangents] = sizes;
        let _current = buffers.positions.owner.make_current()?;
        let sharing = GlInterop::open(device)?;
        let register = |buffer, bytes| sharing.register(device, GlBuffer { bytes, ..buffer });
        let mut interop = Self {
            positions: register(buffers.positions, positions)?,
            normals: register(buffers.normals, normals)?,
            tangents: match tangents {
                0 => None,
                bytes => Some(register(buffers.tangents.ok_or_else(missing)?, bytes)?),
            },
        };
        interop.with_mapped(device, MapAccess::Read, |_| Ok(()))?;
        Ok(interop)
    }

    /// Maps all buffers, runs `work` with their addresses, and unmaps them whether `work` succeeds or not. `work`
    /// submits to the device's stream.
    ///
    /// # Errors
    /// The error of `work`, or a `Fault` of mapping.
    pub(super) fn with_mapped(
        &mut self,
        device: &Device,
        access: MapAccess,
        work: impl FnOnce(OutputAddresses) -> Result<()>,
    ) -> Result<()> {
        let Self { positions, normals, tangents } = self;
        let work = |[positions, normals, tangents]: [u64; MAX_MAPPED_BUFFERS]| {
            work(OutputAddresses { positions, normals, tangents })
        };
        match tangents {
            None => with_mapped(device, &mut [(positions, access), (normals, access)], work),
            Some(tangents) => {
                with_mapped(device, &mut [(positions, access), (normals, access), (tangents, access)], work)
            }
        }
    }
}

/// Checks that OpenGL draws on this CUDA device. Registration cannot work with another device or with Mesa's software
/// rasterizer.
fn check_device(library: &Library, device: &Device) -> Result<()> {
    let refused = |reason: String| Error::Fault { stage: STAGE, reason };
    // SAFETY: the type matches the declaration in cudaGL.h.
    let get = unsafe { library.get::<GetDevices>(b"cuGLGetDevices_v2\0") };
    let get = get.map_err(|error| refused(error.to_string()))?;
    let (mut count, mut devices) = (0, [0; 16]);
    // SAFETY: `devices` has as many elements as the call receives in its third argument.
    let answer = unsafe { get(&mut count, devices.as_mut_ptr(), devices.len() as c_uint, GL_DEVICE_LIST_ALL) };
    answer.result().map_err(|error| refused(format!("no current OpenGL context of a CUDA device: {error}")))?;
    let drawing = &devices[..devices.len().min(count as usize)];
    if drawing.contains(&device.context().cu_device()) {
        return Ok(());
    }
    Err(refused(format!("OpenGL draws on CUDA devices {drawing:?}, vertices are computed on {}", device.ordinal())))
}
