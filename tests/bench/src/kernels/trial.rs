//! Ways to deform that can be measured: a step of theirs is kernels alone, on coordinates that lie on the device already.

use cudarc::driver::CudaFunction;
use serde::Serialize;

use modalcast_compute::gpu::Device;
use modalcast_model::error::{Result, during};

/// One way to deform on the device, prepared for measuring: the coordinates of several turns lie on the device.
pub trait Trial {
    /// The name that reports give it.
    fn name(&self) -> String;

    /// How many different q are prepared, at least 1; a turn is taken modulo this.
    fn turns(&self) -> usize;

    /// Starts one step's kernels on the device's stream: no copies and no waiting, so that a graph can capture it.
    ///
    /// # Errors
    /// `Fault` when the device refuses.
    fn launch(&self, device: &Device, turn: usize) -> Result<()>;

    /// Brings up to date what a launch of this turn passes over; for the judge, before the launch.
    ///
    /// # Errors
    /// `Fault` when the device refuses.
    fn complete(&self, _device: &Device, _turn: usize) -> Result<()> {
        Ok(())
    }

    /// World positions of the last launch, 3 f32 per vertex, packed as the scene's layout says, for the judge. Empty
    /// when the trial deforms nothing.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn positions(&self, _device: &Device) -> Result<Vec<f32>> {
        Ok(Vec::new())
    }

    /// What one step must move, as (what, bytes); the sum is the numerator of a rate.
    fn bytes(&self) -> Vec<(&'static str, u64)> {
        Vec::new()
    }

    /// Kernel launches of one step.
    fn launches(&self) -> usize;

    /// What the driver says of each kernel; empty where the kernels are a library's.
    fn kernels(&self) -> Vec<KernelFacts> {
        Vec::new()
    }
}

/// What the driver says of a loaded kernel (cuFuncGetAttribute).
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KernelFacts {
    /// The kernel's name and the macros that it was compiled with.
    pub name: String,
    /// Registers of a thread.
    pub registers: u32,
    /// Bytes of local memory of a thread: what did not fit into registers, and arrays that are indexed at run time.
    pub spilled_bytes: u32,
    /// Static shared memory of a block, bytes.
    pub shared_bytes: u32,
}

impl KernelFacts {
    /// Asks the driver.
    ///
    /// # Errors
    /// `Fault` when the driver reports one.
    pub(super) fn of(name: &str, function: &CudaFunction) -> Result<Self> {
        let fail = during("kernel facts");
        let number = |value: i32| u32::try_from(value).unwrap_or(0);
        Ok(Self {
            name: name.to_owned(),
            registers: number(function.num_regs().map_err(&fail)?),
            spilled_bytes: number(function.local_size_bytes().map_err(&fail)?),
            shared_bytes: number(function.shared_size_bytes().map_err(&fail)?),
        })
    }
}

/// A kernel file that only trials use.
#[derive(Debug)]
pub(super) struct Code {
    pub source: &'static str,
    /// The functions in it; [`Compiled`] is the first.
    pub functions: &'static [&'static str],
    /// The lists of macros that it is ever compiled with.
    pub variants: &'static [&'static [&'static str]],
}

/// A compiled function and its facts.
#[derive(Debug)]
pub(super) struct Compiled {
    pub function: CudaFunction,
    pub facts: KernelFacts,
}

impl Compiled {
    /// Compiles the first function of a file with one of its lists of macros.
    pub(super) fn new(device: &Device, code: &Code, defines: &[&str]) -> Result<Self> {
        let function = code.functions[0];
        let compiled = device.function(function, code.source, defines)?;
        let name = std::iter::once(function).chain(defines.iter().copied()).collect::<Vec<_>>().join(" ");
        Ok(Self { facts: KernelFacts::of(&name, &compiled)?, function: compiled })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use modalcast_compute::testing::assert_compiles;

    /// Compiles every function with every list of macros; nothing may spill.
    pub(in super::super) fn compile_all(code: &Code) {
        assert_compiles(code.source, code.functions, code.variants);
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_a_kernel_that_does_not_compile_fails_the_check() {
        let broken =
            Code { source: "extern \"C\" __global__ void f() { wrong; }", functions: &["f"], variants: &[&[]] };
        assert!(std::panic::catch_unwind(|| compile_all(&broken)).is_err());
        let misnamed = Code { source: "extern \"C\" __global__ void g() {}", functions: &["f"], variants: &[&[]] };
        assert!(std::panic::catch_unwind(|| compile_all(&misnamed)).is_err());
    }
}
