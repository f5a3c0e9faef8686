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
use crate::error::{Error, Result, during};

const STAGE: &str = "interop";

/// `CU_GL_DEVICE_LIST_ALL`: every device that the current context draws with.
const ALL_DEVICES: c_uint = 1;

type RegisterBuffer = unsafe extern "C" fn(*mut CUgraphicsResource, c_uint, c_uint) -> CUresult;
type GetDevices = unsafe extern "C" fn(*mut c_uint, *mut c_int, c_uint, c_uint) -> CUresult;

/// What a mapping is for. The driver may drop what a buffer held when all of it will be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    WriteAll,
    WriteSome,
    Read,
}

/// Positions, normals and perhaps tangents, registered with CUDA.
#[derive(Debug)]
pub(super) struct Interop {
    resources: Vec<CUgraphicsResource>,
    /// Bytes that each must have.
    sizes: Vec<u64>,
    access: Option<Access>,
    context: Arc<CudaContext>,
}

impl Interop {
    /// Registers the buffers of the OpenGL context that is current on this thread. `sizes` are the bytes of positions,
    /// normals and tangents; 0 tangents means none.
    ///
    /// # Errors
    /// `Fault` saying what was refused; nothing stays registered.
    pub(super) fn register(device: &Device, buffers: GlBuffers, sizes: [u64; 3]) -> Result<Self> {
        let fail = during(STAGE);
        // SAFETY: the driver is loaded already; this only counts one more user of it.
        let library = unsafe { Library::new("libcuda.so.1") }.map_err(|error| fail(error.to_string()))?;
        check_device(&library, device)?;
        // SAFETY: the type is that of cudaGL.h.
        let register = unsafe { library.get::<RegisterBuffer>(b"cuGraphicsGLRegisterBuffer\0") };
        let register = register.map_err(|error| fail(error.to_string()))?;
        let mut names = vec![buffers.positions, buffers.normals];
        if sizes[2] > 0 {
            names.push(buffers.tangents.ok_or_else(|| fail("the renderer gave no buffer for tangents".into()))?);
        }
        let sizes = sizes[..names.len()].to_vec();
        let mut interop = Self { resources: Vec::new(), sizes, access: None, context: Arc::clone(device.context()) };
        for name in names {
            let mut resource = std::ptr::null_mut();
            // SAFETY: `resource` is a live pointer; an unknown buffer name is refused by the driver.
            let answer = unsafe { register(&mut resource, name, 0) };
            answer.result().map_err(|error| fail(format!("buffer {name}: {error}")))?;
            interop.resources.push(resource);
        }
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
        let fail = during(STAGE);
        self.announce(access).map_err(&fail)?;
        let stream = device.stream().cu_stream();
        let (count, resources) = (self.resources.len() as c_uint, self.resources.as_mut_ptr());
        // SAFETY: all are registered and unmapped, and the stream is of the same device. Frames that OpenGL still draws from
        // them end before the stream goes on.
        unsafe { sys::cuGraphicsMapResources(count, resources, stream) }.result().map_err(&fail)?;
        let worked = self.addresses().and_then(work);
        // SAFETY: they were mapped just now; work that was started on the stream ends before OpenGL goes on.
        let unmapped = unsafe { sys::cuGraphicsUnmapResources(count, resources, stream) }.result();
        worked.and(unmapped.map_err(fail))
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
        for resource in &self.resources {
            // SAFETY: the resource is registered and unmapped.
            unsafe { sys::cuGraphicsResourceSetMapFlags_v2(*resource, flags as c_uint) }.result()?;
        }
        self.access = Some(access);
        Ok(())
    }

    /// Addresses of the mapped buffers, each checked to be large enough.
    fn addresses(&self) -> Result<Addresses> {
        let fail = during(STAGE);
        let mut list = [0; 3];
        for ((place, resource), expected) in list.iter_mut().zip(&self.resources).zip(&self.sizes) {
            let mut bytes = 0;
            // SAFETY: both pointers are live and the resource is a mapped buffer.
            unsafe { sys::cuGraphicsResourceGetMappedPointer_v2(place, &mut bytes, *resource) }
                .result()
                .map_err(|error| fail(error.to_string()))?;
            if (bytes as u64) < *expected {
                return Err(fail(format!("a buffer of {bytes} bytes was given, {expected} are needed")));
            }
        }
        let [positions, normals, tangents] = list;
        Ok(Addresses { positions, normals, tangents })
    }
}

impl Drop for Interop {
    fn drop(&mut self) {
        // Answers are dropped on purpose: nothing is left to be done, and a device that failed says so at its next call.
        self.context.bind_to_thread().ok();
        for resource in &self.resources {
            // SAFETY: registered once, unregistered once.
            unsafe { sys::cuGraphicsUnregisterResource(*resource) }.result().ok();
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
