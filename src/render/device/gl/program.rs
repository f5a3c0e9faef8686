//! Compilation of programs, if possible on threads of the driver.

use std::rc::Rc;

use glow::HasContext as _;

use super::{Gl, Program};
use modalcast_model::error::{Result, fault, fault_in};

/// A program that the driver may still be compiling.
#[derive(Debug)]
pub(crate) struct PendingProgram {
    program: Program,
    shaders: Vec<glow::Shader>,
    label: String,
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

    /// Begins to compile and link a program. With `GL_KHR_parallel_shader_compile`, threads of the driver compile it.
    /// Without the extension, this call may take as long as the compilation.
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
            gl.link_program(name);
            Ok(PendingProgram { program, shaders, label: label.to_owned() })
        }
    }
}

impl PendingProgram {
    /// Whether [`Self::finish`] would return without waiting. Always true without the extension.
    pub(crate) fn is_complete(&self) -> bool {
        let gl = &self.program.gl;
        let Some(functions) = gl.functions_or_skip().filter(|_| gl.limits.parallel_compile) else { return true };
        // SAFETY: a query that the extension defines, of a program of this context.
        unsafe { functions.get_program_completion_status(self.program.name) }
    }

    /// Waits for the program.
    ///
    /// # Errors
    /// `Fault` with the log of the compiler or of the linker.
    pub(crate) fn finish(self) -> Result<Program> {
        let Self { program, shaders, label } = self;
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
