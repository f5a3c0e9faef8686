//! OpenGL buffers for tests, in the context of a renderer on the CUDA device.

use std::any::Any;
use std::num::NonZeroU32;
use std::ops::{Deref, DerefMut};
use std::rc::Rc;
use std::sync::{Mutex, MutexGuard, PoisonError};

use glow::HasContext as _;
use modalcast_model::error::Result;
use modalcast_model::raster::{GlBuffer, GlBufferOwner};
use modalcast_render::{DevicePreference, Renderer};

/// An owner of an OpenGL context on the GPU. It exists only while no other test of this process has one: see
/// [`Renderer::open`].
pub(crate) struct Exclusive<T> {
    // Dropped before the lock is released.
    value: T,
    _lock: MutexGuard<'static, ()>,
}

impl<T> Exclusive<T> {
    /// Waits until no other test has a context, and opens one.
    pub(crate) fn open(open: impl FnOnce() -> Result<T>) -> Self {
        static LOCK: Mutex<()> = Mutex::new(());
        // The lock protects no data, so a failed test leaves it usable.
        let lock = LOCK.lock().unwrap_or_else(PoisonError::into_inner);
        Self { value: open().expect("expected an OpenGL context on the CUDA device"), _lock: lock }
    }
}

impl Exclusive<Renderer> {
    /// A renderer on the CUDA device.
    pub(crate) fn renderer() -> Self {
        Self::open(|| Renderer::open(DevicePreference::Cuda(0)))
    }
}

impl<T> Deref for Exclusive<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.value
    }
}

impl<T> DerefMut for Exclusive<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.value
    }
}

/// The context of a renderer, which stays current on this thread.
pub(crate) struct GlContext {
    pub(crate) renderer: Exclusive<Renderer>,
    api: Rc<glow::Context>,
}

/// A buffer of the context that is current on this thread; deleted when dropped.
struct OwnedBuffer {
    api: Rc<glow::Context>,
    name: u32,
}

impl std::fmt::Debug for OwnedBuffer {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "buffer {}", self.name)
    }
}

impl GlBufferOwner for OwnedBuffer {
    // The context is always current.
    fn make_current(&self) -> Result<Box<dyn Any>> {
        Ok(Box::new(()))
    }
}

impl Drop for OwnedBuffer {
    fn drop(&mut self) {
        // SAFETY: the context is current on this thread. OpenGL ignores names that it does not know.
        unsafe { self.api.delete_buffer(native_buffer(self.name)) };
    }
}

impl GlContext {
    pub(crate) fn open() -> Self {
        let renderer = Exclusive::renderer();
        // SAFETY: loading runs the initializers of libEGL. They have already run, because the renderer loaded libEGL.
        let egl =
            unsafe { khronos_egl::DynamicInstance::<khronos_egl::EGL1_4>::load_required() }.expect("expected libEGL");
        let load_address =
            |name: &str| egl.get_proc_address(name).map_or(std::ptr::null(), |function| function as *const _);
        // SAFETY: the renderer's context is current on this thread and outlives `api`.
        let api = unsafe { glow::Context::from_loader_function(load_address) };
        Self { renderer, api: Rc::new(api) }
    }

    /// Creates a buffer with these items.
    pub(crate) fn create_buffer_from<T: bytemuck::Pod>(&self, items: &[T]) -> GlBuffer {
        let buffer = self.create_buffer(size_of_val(items) as u64);
        self.write(&buffer, items);
        buffer
    }

    /// Creates a buffer of `bytes` bytes, but at least 16, in which all bits are one.
    pub(crate) fn create_buffer(&self, bytes: u64) -> GlBuffer {
        let ones = vec![u8::MAX; bytes.max(16) as usize];
        // SAFETY: the context is current on this thread, as in all calls below.
        let name = unsafe {
            let buffer = self.api.create_buffer().expect("expected a buffer");
            self.api.bind_buffer(glow::COPY_WRITE_BUFFER, Some(buffer));
            self.api.buffer_data_u8_slice(glow::COPY_WRITE_BUFFER, &ones, glow::DYNAMIC_DRAW);
            buffer.0.get()
        };
        self.buffer_handle(name, ones.len() as u64)
    }

    /// A handle with a stated size of `bytes` bytes, which deletes the buffer `name` when dropped. Tests also pass a
    /// name that is unknown to OpenGL.
    pub(crate) fn buffer_handle(&self, name: u32, bytes: u64) -> GlBuffer {
        GlBuffer { name, bytes, owner: Rc::new(OwnedBuffer { api: Rc::clone(&self.api), name }) }
    }

    pub(crate) fn write<T: bytemuck::Pod>(&self, buffer: &GlBuffer, items: &[T]) {
        // SAFETY: as above; OpenGL rejects writes beyond the end of the buffer.
        unsafe {
            self.api.bind_buffer(glow::COPY_WRITE_BUFFER, Some(native_buffer(buffer.name)));
            self.api.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, 0, bytemuck::cast_slice(items));
        }
    }

    /// Reads the first `count` items of a buffer, ordered after earlier OpenGL commands. Does not synchronize with
    /// CUDA.
    pub(crate) fn read<T: bytemuck::Pod>(&self, buffer: &GlBuffer, count: usize) -> Vec<T> {
        let mut items = vec![T::zeroed(); count];
        // SAFETY: as above; `items` has exactly the requested size.
        unsafe {
            self.api.bind_buffer(glow::COPY_READ_BUFFER, Some(native_buffer(buffer.name)));
            self.api.get_buffer_sub_data(glow::COPY_READ_BUFFER, 0, bytemuck::cast_slice_mut(&mut items));
        }
        items
    }
}

fn native_buffer(name: u32) -> glow::NativeBuffer {
    glow::NativeBuffer(NonZeroU32::new(name).expect("expected a name"))
}
