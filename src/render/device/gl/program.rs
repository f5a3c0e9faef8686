//! Compilation of programs, if possible on threads of the driver.

use std::cell::Cell;
use std::ffi::c_void;
use std::rc::Rc;

use glow::HasContext as _;

use super::super::egl::Context;
use super::{Gl, Program};
use modalcast_model::error::{Result, fault, fault_in};

/// A program that the driver may still be compiling.
#[derive(Debug)]
pub(crate) struct PendingProgram {
    program: Program,
    shaders: Vec<glow::Shader>,
    label: String,
    is_linked: Cell<bool>,
}

/// Lets the driver compile on up to `count` threads. NVIDIA's driver compiles on the calling thread until this is
/// called. Does nothing without `GL_KHR_parallel_shader_compile` or its ARB version.
pub(super) fn set_compiler_threads(context: &Context, count: u32) {
    type MaxShaderCompilerThreads = unsafe extern "system" fn(u32);
    let addresses =
        ["glMaxShaderCompilerThreadsKHR", "glMaxShaderCompilerThreadsARB"].map(|name| context.address(name));
    if let Some(address) = addresses.into_iter().find(|address| !address.is_null()) {
        // SAFETY: the address is that of a function with this signature. It sets state of the current context.
        unsafe { std::mem::transmute::<*const c_void, MaxShaderCompilerThreads>(address)(count) };
    }
}

impl Gl {
    /// Compiles and links a program from pairs of shader stage and source.
    #[cfg(test)]
    pub(crate) fn program(self: &Rc<Self>, label: &str, stages: &[(u32, &str)]) -> Result<Program> {
        self.begin_program(label, stages)?.finish()
    }

    /// A program without shaders.
    pub(crate) fn empty_program(self: &Rc<Self>) -> Result<Program> {
        // SAFETY: a new name, which the program owns.
        let name = unsafe { self.functions()?.create_program() }.map_err(fault_in("shader"))?;
        Ok(Program { gl: Rc::clone(self), name })
    }

    /// Begins to compile a program. With `GL_KHR_parallel_shader_compile`, threads of the driver compile it, and
    /// [`PendingProgram::is_complete`] links it. Without the extension, this call may take as long as the compilation.
    pub(crate) fn begin_program(self: &Rc<Self>, label: &str, stages: &[(u32, &str)]) -> Result<PendingProgram> {
        let gl = self.functions()?;
        // SAFETY: new objects; the shaders are flagged for deletion and live until the program is deleted.
        unsafe {
            let name = gl.create_program().map_err(fault_in("shader"))?;
            let program = Program { gl: Rc::clone(self), name };
            let mut shaders = Vec::new();
            for (stage, source) in stages {
                let shader = gl.create_shader(*stage).map_err(fault_in("shader"))?;
                gl.shader_source(shader, source);
                gl.compile_shader(shader);
                gl.attach_shader(name, shader);
                gl.delete_shader(shader);
                shaders.push(shader);
            }
            let pending = PendingProgram { program, shaders, label: label.to_owned(), is_linked: Cell::new(false) };
            if !self.limits.parallel_compile {
                pending.link(&gl);
            }
            Ok(pending)
        }
    }
}

impl PendingProgram {
    /// Links the program when its shaders are compiled, because the driver would link it earlier on this thread.
    /// Returns whether [`Self::finish`] would return without waiting. Always true without the extension.
    pub(crate) fn is_complete(&self) -> bool {
        let gl = &self.program.gl;
        let Some(functions) = gl.functions_or_skip().filter(|_| gl.limits.parallel_compile) else { return true };
        if !self.is_linked.get() {
            // SAFETY: a query that the extension defines, of shaders of this context.
            let is_compiled = |shader: &glow::Shader| unsafe { functions.get_shader_completion_status(*shader) };
            if !self.shaders.iter().all(is_compiled) {
                return false;
            }
            self.link(&functions);
        }
        // SAFETY: a query that the extension defines, of a program of this context.
        unsafe { functions.get_program_completion_status(self.program.name) }
    }

    fn link(&self, gl: &glow::Context) {
        // SAFETY: a program of this context.
        unsafe { gl.link_program(self.program.name) };
        self.is_linked.set(true);
    }

    /// Waits for the program.
    ///
    /// # Errors
    /// `Fault` with the log of the compiler or of the linker.
    pub(crate) fn finish(self) -> Result<Program> {
        if !self.is_linked.get() {
            self.link(&*self.program.gl.functions()?);
        }
        let Self { program, shaders, label, .. } = self;
        let gl = program.gl.functions()?;
        // SAFETY: queries of objects of this context. The attached shaders live as long as the program.
        let log = unsafe {
            if gl.get_program_link_status(program.name) {
                None
            } else {
                let failed_shader = shaders.into_iter().find(|shader| !gl.get_shader_compile_status(*shader));
                Some(match failed_shader {
                    Some(shader) => gl.get_shader_info_log(shader),
                    None => gl.get_program_info_log(program.name),
                })
            }
        };
        drop(gl);
        log.map_or(Ok(program), |log| Err(fault("shader", format!("{label}: {log}"))))
    }
}
