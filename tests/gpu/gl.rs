//! OpenGL buffers of a hidden context on the CUDA device.

use std::any::Any;
use std::num::NonZeroU32;
use std::rc::Rc;

use glow::HasContext as _;
use modalcast_model::error::Result;
use modalcast_model::raster::{GlBuffer, GlBufferOwner};
use modalcast_render::{DevicePreference, Renderer};

/// The context of a renderer, which stays current on this thread.
pub(crate) struct Gl {
    pub(crate) renderer: Renderer,
    api: Rc<glow::Context>,
}

/// A buffer of the context that is current on this thread; deleted when dropped.
struct OwnedBuffer {
    api: Rc<glow::Context>,
    name: u32,
}

impl std::fmt::Debug for OwnedBuffer {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "buffer {}", self.name)
    }
}

impl GlBufferOwner for OwnedBuffer {
    fn make_current(&self) -> Result<Box<dyn Any>> {
        Ok(Box::new(()))
    }
}

impl Drop for OwnedBuffer {
    fn drop(&mut self) {
        // SAFETY: the context is current on this thread. OpenGL ignores names that it does not know.
        unsafe { self.api.delete_buffer(native(self.name)) };
    }
}

impl Gl {
    pub(crate) fn open() -> Self {
        let renderer = Renderer::open(DevicePreference::Cuda(0)).expect("OpenGL on the CUDA device");
        // SAFETY: loading runs the initializers of libEGL. They have run already, because the renderer has loaded the
        // library.
        let egl = unsafe { khronos_egl::DynamicInstance::<khronos_egl::EGL1_4>::load_required() }.expect("EGL");
        let address = |name: &str| egl.get_proc_address(name).map_or(std::ptr::null(), |found| found as *const _);
        // SAFETY: the renderer's context is current on this thread and outlives `api`.
        let api = unsafe { glow::Context::from_loader_function(address) };
        Self { renderer, api: Rc::new(api) }
    }

    /// A buffer that contains these numbers.
    pub(crate) fn filled<T: bytemuck::Pod>(&self, list: &[T]) -> GlBuffer {
        let buffer = self.room(size_of_val(list) as u64);
        self.write(&buffer, list);
        buffer
    }

    /// A buffer in which all bits are one.
    pub(crate) fn room(&self, bytes: u64) -> GlBuffer {
        let ones = vec![u8::MAX; bytes.max(16) as usize];
        // SAFETY: the context is current on this thread, as in all calls below.
        let name = unsafe {
            let buffer = self.api.create_buffer().expect("a buffer");
            self.api.bind_buffer(glow::COPY_WRITE_BUFFER, Some(buffer));
            self.api.buffer_data_u8_slice(glow::COPY_WRITE_BUFFER, &ones, glow::DYNAMIC_DRAW);
            buffer.0.get()
        };
        self.handle(name, ones.len() as u64)
    }

    /// A handle that owns the buffer of this name, if there is one.
    pub(crate) fn handle(&self, name: u32, bytes: u64) -> GlBuffer {
        GlBuffer { name, bytes, owner: Rc::new(OwnedBuffer { api: Rc::clone(&self.api), name }) }
    }

    pub(crate) fn write<T: bytemuck::Pod>(&self, to: &GlBuffer, list: &[T]) {
        // SAFETY: as above; OpenGL refuses writes beyond the end of the buffer.
        unsafe {
            self.api.bind_buffer(glow::COPY_WRITE_BUFFER, Some(native(to.name)));
            self.api.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, 0, bytemuck::cast_slice(list));
        }
    }

    /// Reads the first `count` numbers of a buffer, in the order of OpenGL commands. The call does not synchronize with
    /// CUDA.
    pub(crate) fn read<T: bytemuck::Pod>(&self, from: &GlBuffer, count: usize) -> Vec<T> {
        let mut list = vec![T::zeroed(); count];
        // SAFETY: as above; `list` has exactly the requested size.
        unsafe {
            self.api.bind_buffer(glow::COPY_READ_BUFFER, Some(native(from.name)));
            self.api.get_buffer_sub_data(glow::COPY_READ_BUFFER, 0, bytemuck::cast_slice_mut(&mut list));
        }
        list
    }
}

fn native(name: u32) -> glow::NativeBuffer {
    glow::NativeBuffer(NonZeroU32::new(name).expect("a name"))
}
