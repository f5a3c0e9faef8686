//! Buffers in memory of another API, imported through a file descriptor (`GL_EXT_memory_object_fd`).

use std::ffi::c_void;
use std::os::fd::{AsRawFd as _, IntoRawFd as _, OwnedFd};
use std::rc::Rc;

use glow::HasContext as _;

use super::{Buffer, Gl};
use modalcast_model::error::{Result, fault, fault_in};

/// GL_DEDICATED_MEMORY_OBJECT_EXT.
const DEDICATED_MEMORY_OBJECT: u32 = 0x9581;
/// GL_HANDLE_TYPE_OPAQUE_FD_EXT.
const HANDLE_TYPE_OPAQUE_FD: u32 = 0x9586;

type CreateMemoryObjects = unsafe extern "system" fn(i32, *mut u32);
type DeleteMemoryObjects = unsafe extern "system" fn(i32, *const u32);
type MemoryObjectParameter = unsafe extern "system" fn(u32, u32, *const i32);
type ImportMemoryFd = unsafe extern "system" fn(u32, u64, u32, i32);
type BufferStorageMem = unsafe extern "system" fn(u32, isize, u32, u64);

/// The functions of `GL_EXT_memory_object` and `GL_EXT_memory_object_fd`, which glow does not have.
#[derive(Debug, Clone, Copy)]
struct MemoryObjectFunctions {
    create: CreateMemoryObjects,
    delete: DeleteMemoryObjects,
    set_parameter: MemoryObjectParameter,
    import: ImportMemoryFd,
    create_storage: BufferStorageMem,
}

/// Imported memory: OpenGL's reference to it.
#[derive(Debug)]
pub(super) struct MemoryObject {
    gl: Rc<Gl>,
    name: u32,
    delete: DeleteMemoryObjects,
}

impl Gl {
    /// Creates a buffer of `bytes` bytes at the start of another API's memory of `allocated_bytes` bytes. The memory lives
    /// at least as long as the buffer. OpenGL does not order its commands with those of the other API.
    ///
    /// # Errors
    /// `Fault` when the context cannot import memory, refuses this memory, or the memory is smaller than the buffer.
    pub(crate) fn import_buffer(
        self: &Rc<Self>,
        descriptor: OwnedFd,
        allocated_bytes: u64,
        bytes: u64,
    ) -> Result<Buffer> {
        if bytes > allocated_bytes {
            return Err(fault("import", format!("expected at least {bytes} bytes of memory, got {allocated_bytes}")));
        }
        let size = i32::try_from(bytes).map_err(fault_in("import"))?;
        let functions = self.memory_object_functions()?;
        let memory = MemoryObject::import(self, &functions, descriptor, allocated_bytes)?;
        let gl = self.functions()?;
        // SAFETY: a new name, which the buffer owns.
        let name = unsafe { gl.create_buffer() }.map_err(fault_in("import"))?;
        let memory_name = memory.name;
        let buffer = Buffer::in_memory(self, name, bytes, memory);
        // SAFETY: the function has the signature of the extension. The memory object has at least `size` bytes.
        unsafe {
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(name));
            (functions.create_storage)(glow::COPY_WRITE_BUFFER, size as isize, memory_name, 0);
        }
        self.check("import").map(|()| buffer)
    }

    /// # Errors
    /// `Fault` when the context lacks the extension.
    fn memory_object_functions(&self) -> Result<MemoryObjectFunctions> {
        if !self.limits.memory_object_fd {
            return Err(fault("import", "OpenGL lacks the extension GL_EXT_memory_object_fd"));
        }
        let load = |name: &str| match self.context.address(name) {
            address if address.is_null() => Err(fault("import", format!("OpenGL lacks the function {name}"))),
            address => Ok(address),
        };
        // SAFETY: the types are those of the extension, which the context has.
        unsafe {
            Ok(MemoryObjectFunctions {
                create: std::mem::transmute::<*const c_void, CreateMemoryObjects>(load("glCreateMemoryObjectsEXT")?),
                delete: std::mem::transmute::<*const c_void, DeleteMemoryObjects>(load("glDeleteMemoryObjectsEXT")?),
                set_parameter: std::mem::transmute::<*const c_void, MemoryObjectParameter>(load(
                    "glMemoryObjectParameterivEXT",
                )?),
                import: std::mem::transmute::<*const c_void, ImportMemoryFd>(load("glImportMemoryFdEXT")?),
                create_storage: std::mem::transmute::<*const c_void, BufferStorageMem>(load("glBufferStorageMemEXT")?),
            })
        }
    }
}

impl MemoryObject {
    /// Imports memory as a dedicated object. Without this flag, CUDA does not see what OpenGL writes on some drivers.
    fn import(
        gl: &Rc<Gl>,
        functions: &MemoryObjectFunctions,
        descriptor: OwnedFd,
        allocated_bytes: u64,
    ) -> Result<Self> {
        let _current = gl.make_current()?;
        let mut name = 0;
        // SAFETY: the functions have the signatures of the extension, and write or read one number.
        unsafe {
            (functions.create)(1, &raw mut name);
            (functions.set_parameter)(name, DEDICATED_MEMORY_OBJECT, &1);
        }
        let memory = Self { gl: Rc::clone(gl), name, delete: functions.delete };
        gl.check("import")?;
        // SAFETY: as above. The descriptor is open.
        unsafe { (functions.import)(name, allocated_bytes, HANDLE_TYPE_OPAQUE_FD, descriptor.as_raw_fd()) };
        gl.check("import")?;
        // A successful import owns the descriptor. After a failure, dropping `descriptor` closes it.
        let _ = descriptor.into_raw_fd();
        Ok(memory)
    }
}

impl Drop for MemoryObject {
    fn drop(&mut self) {
        // SAFETY: this value owns the name. The buffer in the memory is already deleted, and commands in flight keep the
        // memory until they are complete.
        self.gl.delete(|_| unsafe { (self.delete)(1, &raw const self.name) });
    }
}
