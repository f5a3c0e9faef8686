//! Memory of another API, imported through a file descriptor (`GL_EXT_memory_object_fd`).

use std::ffi::c_void;
use std::os::fd::{AsRawFd as _, IntoRawFd as _, OwnedFd};
use std::rc::Rc;

use glow::HasContext as _;

use super::Gl;
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
    allocated_bytes: u64,
    functions: MemoryObjectFunctions,
}

impl Gl {
    /// The functions of the extension.
    ///
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
    ///
    /// # Errors
    /// `Fault` when the context cannot import memory or refuses this memory.
    pub(super) fn import(gl: &Rc<Gl>, descriptor: OwnedFd, allocated_bytes: u64) -> Result<Self> {
        let functions = gl.memory_object_functions()?;
        let _current = gl.make_current()?;
        let mut name = 0;
        // SAFETY: the functions have the signatures of the extension, and write or read one number.
        unsafe {
            (functions.create)(1, &raw mut name);
            (functions.set_parameter)(name, DEDICATED_MEMORY_OBJECT, &1);
        }
        let memory = Self { gl: Rc::clone(gl), name, allocated_bytes, functions };
        gl.check("import")?;
        // SAFETY: as above. The descriptor is open.
        unsafe { (functions.import)(name, allocated_bytes, HANDLE_TYPE_OPAQUE_FD, descriptor.as_raw_fd()) };
        gl.check("import")?;
        // A successful import owns the descriptor. After a failure, dropping `descriptor` closes it.
        let _ = descriptor.into_raw_fd();
        Ok(memory)
    }

    /// Gives a buffer without storage its storage: the first `bytes` bytes of this memory, which must live as long as
    /// the buffer.
    ///
    /// # Errors
    /// `Fault` when the memory is smaller, or OpenGL reports an error.
    pub(super) fn create_storage(&self, buffer: glow::Buffer, bytes: u64) -> Result<()> {
        if bytes > self.allocated_bytes {
            return Err(fault(
                "import",
                format!("expected at least {bytes} bytes of memory, got {}", self.allocated_bytes),
            ));
        }
        let size = i32::try_from(bytes).map_err(fault_in("import"))?;
        let gl = self.gl.functions()?;
        // SAFETY: the function has the signature of the extension. The memory object has at least `size` bytes.
        unsafe {
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(buffer));
            (self.functions.create_storage)(glow::COPY_WRITE_BUFFER, size as isize, self.name, 0);
        }
        self.gl.check("import")
    }
}

impl Drop for MemoryObject {
    fn drop(&mut self) {
        // SAFETY: this value owns the name. The buffer in the memory is already deleted, and commands in flight keep
        // the memory until they are complete.
        self.gl.delete(|_| unsafe { (self.functions.delete)(1, &raw const self.name) });
    }
}
