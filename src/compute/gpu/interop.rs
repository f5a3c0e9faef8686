//! OpenGL buffers as device memory: registered once, mapped together for each step, unmapped before anything is drawn.
//!
//! Mapping orders the two APIs, so that nobody waits on the host: what OpenGL was told before a mapping ends before work that
//! the stream is given after it, and what the stream was given before an unmapping ends before what OpenGL is told after it.
//! A frame may therefore still be under way when the next step is given to the stream: that step waits on the device until it
//! is drawn and its pixels have left. It never runs beside a frame; nor is that wait part of the step's time (`flight`).

use std::ffi::{c_int, c_uint};
use std::sync::Arc;

use cudarc::driver::sys::{self, CUgraphicsResource, CUresult};
use cudarc::driver::{CudaContext, DriverError};
use libloading::Library;

use super::GlBuffers;
use super::device::Device;
use super::output::Addresses;
use modalcast_model::error::{Error, Result, during};
use modalcast_model::raster::GlBuffer;

const STAGE: &str = "interop";

/// `CU_GL_DEVICE_LIST_ALL`: every device that the current context draws with.
const ALL_DEVICES: c_uint = 1;

/// The most buffers that are mapped together.
const MOST: usize = 3;

type RegisterBuffer = unsafe extern "C" fn(*mut CUgraphicsResource, c_uint, c_uint) -> CUresult;
type GetDevices = unsafe extern "C" fn(*mut c_uint, *mut c_int, c_uint, c_uint) -> CUresult;

/// What a mapping is for. The driver may drop what a buffer held when all of it will be written and nothing read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    WriteAll,
    WriteSome,
    Read,
}

/// What registers buffers of the OpenGL context that is current on this thread.
#[derive(Debug)]
pub(super) struct Sharing {
    register: RegisterBuffer,
    /// Kept as long as its function.
    _library: Library,
}

impl Sharing {
    /// Finds out whether that context draws on this device.
    ///
    /// # Errors
    /// `Fault` saying why nothing can be shared.
    pub(super) fn open(device: &Device) -> Result<Self> {
        let fail = during(STAGE);
        // SAFETY: the driver is loaded already; this only counts one more user of it.
        let library = unsafe { Library::new("libcuda.so.1") }.map_err(|error| fail(error.to_string()))?;
        check_device(&library, device)?;
        // SAFETY: the type is that of cudaGL.h.
        let register = unsafe { library.get::<RegisterBuffer>(b"cuGraphicsGLRegisterBuffer\0") };
        let register = *register.map_err(|error| fail(error.to_string()))?;
        Ok(Self { register, _library: library })
    }

    /// Registers a buffer; it must have at least the bytes that it is said to have once it is mapped.
    ///
    /// # Errors
    /// `Fault` naming the buffer that was refused.
    pub(super) fn register(&self, device: &Device, buffer: GlBuffer) -> Result<Registered> {
        let mut resource = std::ptr::null_mut();
        // SAFETY: `resource` is a live pointer; an unknown buffer name is refused by the driver.
        let answer = unsafe { (self.register)(&mut resource, buffer.name, 0) };
        answer.result().map_err(|error| during(STAGE)(format!("buffer {}: {error}", buffer.name)))?;
        Ok(Registered { resource, buffer, access: None, context: Arc::clone(device.context()) })
    }
}

/// A buffer that CUDA may map; unregistered when dropped.
#[derive(Debug)]
pub(super) struct Registered {
    resource: CUgraphicsResource,
    buffer: GlBuffer,
    access: Option<Access>,
    context: Arc<CudaContext>,
}

impl Registered {
    pub(super) const fn buffer(&self) -> GlBuffer {
        self.buffer
    }

    /// Tells the driver what the next mapping is for, if that changed.
    fn announce(&mut self, access: Access) -> Result<(), DriverError> {
        use sys::CUgraphicsMapResourceFlags_enum as Flags;
        if self.access == Some(access) {
            return Ok(());
        }
        let flags = match access {
            Access::WriteAll => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_WRITE_DISCARD,
            Access::WriteSome => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_NONE,
            Access::Read => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_READ_ONLY,
        };
        self.access = None;
        // SAFETY: the resource is registered and unmapped.
        unsafe { sys::cuGraphicsResourceSetMapFlags_v2(self.resource, flags as c_uint) }.result()?;
        self.access = Some(access);
        Ok(())
    }

    /// Where it is mapped, if it is large enough.
    fn address(&self) -> Result<u64> {
        let fail = during(STAGE);
        let GlBuffer { name, bytes: expected } = self.buffer;
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

impl Drop for Registered {
    fn drop(&mut self) {
        // Answers are dropped on purpose: nothing is left to be done, and a device that failed says so at its next call.
        self.context.bind_to_thread().ok();
        // SAFETY: registered once, unregistered once.
        unsafe { sys::cuGraphicsUnregisterResource(self.resource) }.result().ok();
    }
}

/// Maps buffers, each once and at most three, by one call; lets `work` use their addresses on the device's stream, and
/// unmaps them whatever it returned.
///
/// # Errors
/// What `work` returned, or a `Fault` of mapping.
pub(super) fn mapped(
    device: &Device,
    uses: &mut [(&mut Registered, Access)],
    work: impl FnOnce([u64; MOST]) -> Result<()>,
) -> Result<()> {
    let fail = during(STAGE);
    let mut resources = [std::ptr::null_mut(); MOST];
    for (place, (registered, access)) in resources.iter_mut().zip(uses.iter_mut()) {
        registered.announce(*access).map_err(&fail)?;
        *place = registered.resource;
    }
    let stream = device.stream().cu_stream();
    let (count, resources) = (uses.len().min(MOST) as c_uint, resources.as_mut_ptr());
    // SAFETY: all are registered and unmapped, and the stream is of the same device. Frames that OpenGL still draws from
    // them end before the stream goes on.
    unsafe { sys::cuGraphicsMapResources(count, resources, stream) }.result().map_err(&fail)?;
    let worked = addresses(uses).and_then(work);
    // SAFETY: they were mapped just now; work that was started on the stream ends before OpenGL goes on.
    let unmapped = unsafe { sys::cuGraphicsUnmapResources(count, resources, stream) }.result();
    worked.and(unmapped.map_err(fail))
}

fn addresses(uses: &[(&mut Registered, Access)]) -> Result<[u64; MOST]> {
    let mut list = [0; MOST];
    for (place, (registered, _)) in list.iter_mut().zip(uses) {
        *place = registered.address()?;
    }
    Ok(list)
}

/// Positions, normals and perhaps tangents, registered with CUDA.
#[derive(Debug)]
pub(super) struct Interop {
    positions: Registered,
    normals: Registered,
    tangents: Option<Registered>,
}

impl Interop {
    /// Registers the buffers of the OpenGL context that is current on this thread. `sizes` are the bytes of positions,
    /// normals and tangents; 0 tangents means none.
    ///
    /// # Errors
    /// `Fault` saying what was refused; nothing stays registered.
    pub(super) fn register(device: &Device, buffers: GlBuffers, sizes: [u64; 3]) -> Result<Self> {
        let missing = || during(STAGE)("the renderer gave no buffer for tangents");
        let [positions, normals, tangents] = sizes;
        let sharing = Sharing::open(device)?;
        let register = |name, bytes| sharing.register(device, GlBuffer { name, bytes });
        let mut interop = Self {
            positions: register(buffers.positions, positions)?,
            normals: register(buffers.normals, normals)?,
            tangents: match tangents {
                0 => None,
                bytes => Some(register(buffers.tangents.ok_or_else(missing)?, bytes)?),
            },
        };
        interop.mapped(device, Access::Read, |_| Ok(()))?;
        Ok(interop)
    }

    /// Maps all buffers, lets `work` use their addresses on the device's stream, and unmaps them whatever it returned.
    ///
    /// # Errors
    /// What `work` returned, or a `Fault` of mapping.
    pub(super) fn mapped(
        &mut self,
        device: &Device,
        access: Access,
        work: impl FnOnce(Addresses) -> Result<()>,
    ) -> Result<()> {
        let Self { positions, normals, tangents } = self;
        let work = |[positions, normals, tangents]: [u64; MOST]| work(Addresses { positions, normals, tangents });
        match tangents {
            None => mapped(device, &mut [(positions, access), (normals, access)], work),
            Some(tangents) => mapped(device, &mut [(positions, access), (normals, access), (tangents, access)], work),
        }
    }
}

/// Whether OpenGL draws on this CUDA device; with any other, or Mesa's rasteriser, registering cannot work.
fn check_device(library: &Library, device: &Device) -> Result<()> {
    let refused = |reason: String| Error::Fault { stage: STAGE, reason };
    // SAFETY: the type is that of cudaGL.h.
    let get = unsafe { library.get::<GetDevices>(b"cuGLGetDevices_v2\0") };
    let get = get.map_err(|error| refused(error.to_string()))?;
    let (mut count, mut devices) = (0, [0; 16]);
    // SAFETY: `devices` has as many places as the call is told.
    let answer = unsafe { get(&mut count, devices.as_mut_ptr(), devices.len() as c_uint, ALL_DEVICES) };
    answer.result().map_err(|error| refused(format!("no current OpenGL context of a CUDA device: {error}")))?;
    let drawing = &devices[..devices.len().min(count as usize)];
    if drawing.contains(&device.context().cu_device()) {
        return Ok(());
    }
    Err(refused(format!("OpenGL draws on CUDA devices {drawing:?}, vertices are computed on {}", device.ordinal())))
}
