//! CUDA-OpenGL interop: OpenGL buffers as device memory. They are registered once. Those of the vertices are mapped
//! together for each step that is drawn, and unmapped before the draw.
//!
//! Map and unmap order the two APIs on the device, so the host never waits. OpenGL commands issued before a map
//! complete before CUDA work that is submitted to the stream after it. CUDA work submitted before an unmap completes
//! before OpenGL commands that are issued after it. A frame may therefore be in flight when the buffers are mapped for
//! the next one: the copy of the vertices waits on the device until the frame is drawn and its pixels are read back.

use std::cell::Cell;
use std::ffi::{c_int, c_uint};
use std::sync::Arc;

use cudarc::driver::CudaContext;
use cudarc::driver::sys::{self, CUgraphicsResource, CUresult};
use libloading::Library;

use crate::gpu::launch::Device;
use crate::gpu::launch::cleanup::with_cleanup;
use crate::gpu::launch::context::CurrentContext;
use crate::gpu::launch::error::cuda_error;
use modalcast_model::error::{Error, Result, fault, fault_in};
use modalcast_model::fault_injection::{self, InjectionPoint};
use modalcast_model::raster::GlBuffer;

const STAGE: &str = "interop";

/// `CU_GL_DEVICE_LIST_ALL`: every CUDA device that the current OpenGL context uses.
const GL_DEVICE_LIST_ALL: c_uint = 1;

type RegisterBuffer = unsafe extern "C" fn(*mut CUgraphicsResource, c_uint, c_uint) -> CUresult;
type GetDevices = unsafe extern "C" fn(*mut c_uint, *mut c_int, c_uint, c_uint) -> CUresult;

/// Purpose of a mapping. With `WriteDiscard` the driver may discard the old contents of the buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MapAccess {
    WriteDiscard,
    ReadWrite,
    Read,
}

/// Registers OpenGL buffers.
#[derive(Debug)]
pub(super) struct GlInterop {
    register: RegisterBuffer,
    /// Keeps `register` loaded.
    _library: Library,
}

impl GlInterop {
    /// Checks that the OpenGL context of `buffer` draws on this device.
    ///
    /// # Errors
    /// `Fault` with the reason why buffers cannot be shared.
    pub(super) fn open(device: &Device, buffer: &GlBuffer) -> Result<Self> {
        let to_fault = fault_in(STAGE);
        let _gl = buffer.owner.make_current()?;
        // SAFETY: the driver library is already loaded, so this only increments its reference count and runs no
        // initializer.
        let library = unsafe { Library::new("libcuda.so.1") }.map_err(|error| to_fault(error.to_string()))?;
        check_device(&library, device)?;
        // SAFETY: the type matches the declaration in cudaGL.h.
        let register = unsafe { library.get::<RegisterBuffer>(b"cuGraphicsGLRegisterBuffer\0") };
        let register = *register.map_err(|error| to_fault(error.to_string()))?;
        Ok(Self { register, _library: library })
    }

    /// Registers a buffer. Each mapping checks that the buffer has at least `buffer.bytes` bytes.
    ///
    /// # Errors
    /// `Fault` with the name of the buffer that the driver rejects.
    pub(super) fn register(&self, device: &Device, buffer: GlBuffer) -> Result<RegisteredBuffer> {
        let _current = device.enter()?;
        let _gl = buffer.owner.make_current()?;
        let mut resource = std::ptr::null_mut();
        // SAFETY: `resource` is a live pointer; the driver rejects an unknown buffer name.
        let result = unsafe { (self.register)(&mut resource, buffer.name, 0) };
        result.result().map_err(|error| match cuda_error(STAGE)(error) {
            Error::Fault { stage, reason } => {
                Error::Fault { stage, reason: format!("buffer {}: {reason}", buffer.name) }
            }
            lost => lost,
        })?;
        let context = Arc::clone(device.context());
        Ok(RegisteredBuffer { resource, buffer, announced_access: None, is_mapped: Cell::new(false), context })
    }
}

/// An OpenGL buffer that CUDA may map; unregistered on drop. The buffer's owner keeps the buffer and its context alive.
/// It is not `Send`, so this type stays on the thread of the context.
#[derive(Debug)]
pub(super) struct RegisteredBuffer {
    resource: CUgraphicsResource,
    buffer: GlBuffer,
    /// The access that was last announced to the driver; `None` before the first mapping and after a failure.
    announced_access: Option<MapAccess>,
    /// Whether the buffer is mapped. Outside of [`with_mapped`], this is true only if the last unmap failed.
    is_mapped: Cell<bool>,
    context: Arc<CudaContext>,
}

impl RegisteredBuffer {
    pub(super) const fn buffer(&self) -> &GlBuffer {
        &self.buffer
    }

    /// Announces the purpose of the next mapping to the driver, if it differs from the last announced purpose.
    fn set_map_flags(&mut self, access: MapAccess) -> Result<()> {
        use sys::CUgraphicsMapResourceFlags_enum as Flags;
        if self.is_mapped.get() {
            let reason = format!("buffer {} is still mapped: its last unmap failed", self.buffer.name);
            return Err(Error::Fault { stage: STAGE, reason });
        }
        if self.announced_access == Some(access) {
            return Ok(());
        }
        let flags = match access {
            MapAccess::WriteDiscard => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_WRITE_DISCARD,
            MapAccess::ReadWrite => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_NONE,
            MapAccess::Read => Flags::CU_GRAPHICS_MAP_RESOURCE_FLAGS_READ_ONLY,
        };
        self.announced_access = None;
        // SAFETY: the resource is registered, and `is_mapped` shows that it is unmapped.
        unsafe { sys::cuGraphicsResourceSetMapFlags_v2(self.resource, flags as c_uint) }
            .result()
            .map_err(cuda_error(STAGE))?;
        self.announced_access = Some(access);
        Ok(())
    }

    /// Device address of the mapped buffer.
    ///
    /// # Errors
    /// `Fault` when the buffer is smaller than expected.
    fn address(&self) -> Result<u64> {
        let GlBuffer { name, bytes: expected_bytes, .. } = self.buffer;
        let (mut address, mut bytes) = (0, 0);
        // SAFETY: both pointers are live; the driver rejects a resource that is not mapped.
        unsafe { sys::cuGraphicsResourceGetMappedPointer_v2(&mut address, &mut bytes, self.resource) }
            .result()
            .map_err(cuda_error(STAGE))?;
        if (bytes as u64) < expected_bytes {
            return Err(fault(STAGE, format!("buffer {name}: expected {expected_bytes} bytes, got {bytes}")));
        }
        Ok(address)
    }
}

impl Drop for RegisteredBuffer {
    fn drop(&mut self) {
        // Ignore errors: there is no other cleanup, and a failed device reports its error at the next call.
        let _current = CurrentContext::enter(&self.context);
        let _gl = self.buffer.owner.make_current();
        // SAFETY: the resource was registered once and is unregistered once.
        unsafe { sys::cuGraphicsUnregisterResource(self.resource) }.result().ok();
    }
}

/// A buffer to map, and the purpose of the mapping.
#[derive(Debug)]
pub(super) struct Mapping<'a> {
    pub buffer: &'a mut RegisteredBuffer,
    pub access: MapAccess,
}

/// Maps distinct buffers by one call, runs `work` with their addresses in the same order, and unmaps them, also when
/// `work` fails or panics. `work` submits to the device's stream.
///
/// # Errors
/// The error of `work`, or a `Fault` of mapping. A buffer whose unmap fails is rejected by the next mapping.
pub(super) fn with_mapped(
    device: &Device,
    mappings: &mut [Mapping<'_>],
    work: impl FnOnce(&[u64]) -> Result<()>,
) -> Result<()> {
    let _current = device.enter()?;
    fault_injection::check(InjectionPoint::Interop)?;
    mappings.iter_mut().try_for_each(|Mapping { buffer, access }| buffer.set_map_flags(*access))?;
    let _gl = mappings.first().map(|mapping| mapping.buffer.buffer.owner.make_current()).transpose()?;
    let mut resources: Vec<CUgraphicsResource> = mappings.iter().map(|mapping| mapping.buffer.resource).collect();
    // SAFETY: all resources are registered and unmapped, and the stream belongs to the same device. OpenGL frames that
    // read the buffers complete before later work on the stream.
    unsafe {
        sys::cuGraphicsMapResources(resources.len() as c_uint, resources.as_mut_ptr(), device.stream().cu_stream())
    }
    .result()
    .map_err(cuda_error(STAGE))?;
    let buffers: Vec<&RegisteredBuffer> = mappings.iter().map(|mapping| &*mapping.buffer).collect();
    let mapped_flags: Vec<&Cell<bool>> = buffers.iter().map(|buffer| &buffer.is_mapped).collect();
    let addresses = || buffers.iter().map(|buffer| buffer.address()).collect::<Result<Vec<u64>>>();
    run_mapped(
        &mapped_flags,
        || work(&addresses()?),
        || {
            let count = resources.len() as c_uint;
            // SAFETY: the resources were mapped above. The device work that `work` submitted completes before OpenGL
            // uses the buffers.
            unsafe { sys::cuGraphicsUnmapResources(count, resources.as_mut_ptr(), device.stream().cu_stream()) }
                .result()
                .map_err(cuda_error(STAGE))
        },
    )
}

/// Runs `work` on mapped buffers, then `unmap`, also when `work` panics. Afterwards each of `mapped_flags` is true if
/// `unmap` failed and the buffers are still mapped, otherwise false.
fn run_mapped(
    mapped_flags: &[&Cell<bool>],
    work: impl FnOnce() -> Result<()>,
    unmap: impl FnOnce() -> Result<()>,
) -> Result<()> {
    let set_flags = |is_mapped| mapped_flags.iter().for_each(|flag| flag.set(is_mapped));
    set_flags(true);
    let (work_result, unmap_result) = with_cleanup(work, || unmap().inspect(|()| set_flags(false)));
    work_result.and(unmap_result)
}

/// Checks that OpenGL draws on this CUDA device. Registration cannot work with another device or with Mesa's software
/// rasterizer.
fn check_device(library: &Library, device: &Device) -> Result<()> {
    let fault = |reason: String| Error::Fault { stage: STAGE, reason };
    // SAFETY: the type matches the declaration in cudaGL.h.
    let get_devices = unsafe { library.get::<GetDevices>(b"cuGLGetDevices_v2\0") };
    let get_devices = get_devices.map_err(|error| fault(error.to_string()))?;
    let (mut count, mut devices) = (0, [0; 16]);
    // SAFETY: `devices` has as many elements as the call receives in its third argument.
    let status = unsafe { get_devices(&mut count, devices.as_mut_ptr(), devices.len() as c_uint, GL_DEVICE_LIST_ALL) };
    status.result().map_err(|error| fault(format!("no current OpenGL context of a CUDA device: {error}")))?;
    let gl_devices = &devices[..devices.len().min(count as usize)];
    if gl_devices.contains(&device.context().cu_device()) {
        return Ok(());
    }
    Err(fault(format!("OpenGL draws on CUDA devices {gl_devices:?}, vertices are computed on {}", device.ordinal())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::panic::{AssertUnwindSafe, catch_unwind};

    #[test]
    fn buffers_are_unmapped_after_errors_and_panics() {
        let (first, second, unmap_calls) = (Cell::new(false), Cell::new(false), Cell::new(0));
        let run = |work: &dyn Fn() -> Result<()>, unmap_result: Result<()>| {
            let unmap = || {
                unmap_calls.set(unmap_calls.get() + 1);
                unmap_result.clone()
            };
            let result = catch_unwind(AssertUnwindSafe(|| run_mapped(&[&first, &second], work, unmap)));
            (result, first.get(), second.get())
        };
        let check_mapped = || if first.get() && second.get() { Ok(()) } else { Err(fault("work", "not mapped")) };
        assert!(matches!(run(&check_mapped, Ok(())), (Ok(Ok(())), false, false)));
        assert!(matches!(run(&|| Err(fault("work", "wrong")), Ok(())), (Ok(Err(_)), false, false)));
        assert!(matches!(run(&|| panic!("injected"), Ok(())), (Err(_), false, false)));
        let unmap_error = Err(fault(STAGE, "unmap"));
        let result = run(&|| Ok(()), unmap_error);
        assert!(matches!(result, (Ok(Err(_)), true, true)), "expected mapped buffers after a failed unmap");
        assert_eq!(unmap_calls.get(), 4);
    }
}
