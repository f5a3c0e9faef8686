//! The interface of benchmark kernels: a step consists of kernels alone, on inputs that are uploaded beforehand.

use cudarc::driver::CudaFunction;
use serde::Serialize;

use modalcast_compute::gpu::Device;
use modalcast_model::error::{Result, fault_in};

/// One way to deform on the device, with the inputs of several turns uploaded.
pub trait KernelBenchmark {
    /// Name in reports.
    fn name(&self) -> String;

    /// Number of prepared turns (different q), at least 1. [`Self::launch`] takes a turn modulo this number.
    fn turns(&self) -> usize;

    /// Enqueues one step's kernels on the device's stream, without copies or waiting, so that a graph can capture it.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn launch(&self, device: &Device, turn: usize) -> Result<()>;

    /// Computes the domains that a launch of this turn skips. Validation calls it before the launch.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn complete(&self, _device: &Device, _turn: usize) -> Result<()> {
        Ok(())
    }

    /// World positions of the last launch for validation, three f32 per vertex, packed as in the scene's layout. Empty
    /// when the trial does not deform.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn positions(&self, _device: &Device) -> Result<Vec<f32>> {
        Ok(Vec::new())
    }

    /// Bytes that one step must move, as (part, bytes). The sum is the numerator of a rate.
    fn bytes(&self) -> Vec<(&'static str, u64)> {
        Vec::new()
    }

    /// Kernel launches per step.
    fn launches(&self) -> usize;

    /// The driver's facts about each kernel; empty for a library's kernels.
    fn kernels(&self) -> Vec<KernelAttributes> {
        Vec::new()
    }
}

/// Facts about a loaded kernel from the driver (cuFuncGetAttribute).
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KernelAttributes {
    /// The kernel's name and its macros.
    pub name: String,
    /// Registers per thread.
    pub registers: u32,
    /// Bytes of local memory per thread: register spills, and arrays that are indexed at run time.
    pub spilled_bytes: u32,
    /// Static shared memory per block, bytes.
    pub shared_bytes: u32,
}

impl KernelAttributes {
    /// Queries the driver.
    ///
    /// # Errors
    /// `Fault` when the driver reports an error.
    pub(super) fn of(name: &str, function: &CudaFunction) -> Result<Self> {
        let fail = fault_in("kernel facts");
        let number = |value: i32| u32::try_from(value).unwrap_or(0);
        Ok(Self {
            name: name.to_owned(),
            registers: number(function.num_regs().map_err(&fail)?),
            spilled_bytes: number(function.local_size_bytes().map_err(&fail)?),
            shared_bytes: number(function.shared_size_bytes().map_err(&fail)?),
        })
    }
}

/// A kernel source file that only benchmarks use.
#[derive(Debug)]
pub(super) struct BenchmarkSource {
    pub source: &'static str,
    /// Its functions; [`CompiledKernel`] compiles the first one.
    pub functions: &'static [&'static str],
    /// All lists of macros that it is compiled with.
    pub variants: &'static [&'static [&'static str]],
}

/// A compiled function and its facts.
#[derive(Debug)]
pub(super) struct CompiledKernel {
    pub function: CudaFunction,
    pub facts: KernelAttributes,
}

impl CompiledKernel {
    /// Compiles the first function of a file with one list of macros.
    pub(super) fn new(device: &Device, code: &BenchmarkSource, defines: &[&str]) -> Result<Self> {
        let function = code.functions[0];
        let compiled = device.function(function, code.source, defines)?;
        let name = std::iter::once(function).chain(defines.iter().copied()).collect::<Vec<_>>().join(" ");
        Ok(Self { facts: KernelAttributes::of(&name, &compiled)?, function: compiled })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use modalcast_compute::testing::assert_compiles;

    /// Compiles every function with every list of macros; fails if a kernel spills registers.
    pub(in super::super) fn compile_all(code: &BenchmarkSource) {
        assert_compiles(code.source, code.functions, code.variants);
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_broken_kernel_fails_the_check() {
        let broken = BenchmarkSource {
            source: "extern \"C\" __global__ void f() { wrong; }",
            functions: &["f"],
            variants: &[&[]],
        };
        assert!(std::panic::catch_unwind(|| compile_all(&broken)).is_err());
        let misnamed =
            BenchmarkSource { source: "extern \"C\" __global__ void g() {}", functions: &["f"], variants: &[&[]] };
        assert!(std::panic::catch_unwind(|| compile_all(&misnamed)).is_err());
    }
}
