//! The trait of kernel benchmarks, and the compilation of their kernels. Inputs are uploaded in advance, so that only
//! kernels are timed.

use cudarc::driver::CudaFunction;
use serde::Serialize;

use modalcast_compute::gpu::Device;
use modalcast_model::error::{Result, fault_in};

/// A sequence of kernels to time, with several uploaded input sets. An input set is the input of one step.
pub trait KernelBenchmark {
    /// Name in reports.
    fn name(&self) -> String;

    /// Number of uploaded input sets, at least 1. [`Self::launch`] reduces its `input_set` modulo
    /// this number.
    fn input_set_count(&self) -> usize;

    /// Enqueues the kernels of one step on the stream of the device. The call does not wait, so that a graph can
    /// capture it.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn launch(&self, device: &Device, input_set: usize) -> Result<()>;

    /// Computes the positions of the domains that [`Self::launch`] with this input set does not compute, because the
    /// step changes only some domains. Validation calls this before `launch`. By default, `launch` computes all
    /// domains.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn compute_skipped_domains(&self, _device: &Device, _input_set: usize) -> Result<()> {
        Ok(())
    }

    /// World positions of the last launch for validation, three f32 per vertex, packed as in the scene's layout. Empty
    /// if the kernels do not deform.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    fn positions(&self, _device: &Device) -> Result<Vec<f32>> {
        Ok(Vec::new())
    }

    /// Minimum memory traffic of one step for each array. The reported bandwidth is the sum of all arrays divided by
    /// the time.
    fn traffic(&self) -> Vec<ArrayTraffic> {
        Vec::new()
    }

    /// Kernel launches per step.
    fn launches_per_step(&self) -> usize;

    /// The driver's attributes of each kernel; empty for a library's kernels.
    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        Vec::new()
    }
}

/// Bytes that a step reads from or writes to one array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ArrayTraffic {
    pub array: &'static str,
    pub bytes: u64,
}

impl ArrayTraffic {
    pub(super) const fn new(array: &'static str, bytes: u64) -> Self {
        Self { array, bytes }
    }
}

/// Attributes of a loaded kernel from the driver (cuFuncGetAttribute).
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KernelAttributes {
    /// The kernel's name and its macros.
    pub name: String,
    /// Registers per thread.
    pub registers: u32,
    /// Bytes of local memory per thread: register spills, and arrays that are indexed at run time.
    #[serde(rename = "spilled_bytes")]
    pub local_bytes: u32,
    /// Static shared memory per block, bytes.
    pub shared_bytes: u32,
}

impl KernelAttributes {
    /// Queries the driver.
    ///
    /// # Errors
    /// `Fault` when the driver reports an error.
    pub(super) fn query(name: &str, function: &CudaFunction) -> Result<Self> {
        let to_fault = fault_in("kernel attributes");
        let as_u32 = |value: i32| u32::try_from(value).unwrap_or(0);
        Ok(Self {
            name: name.to_owned(),
            registers: as_u32(function.num_regs().map_err(&to_fault)?),
            local_bytes: as_u32(function.local_size_bytes().map_err(&to_fault)?),
            shared_bytes: as_u32(function.shared_size_bytes().map_err(&to_fault)?),
        })
    }
}

/// A kernel source file that only benchmarks use.
#[derive(Debug)]
pub(super) struct BenchmarkSource {
    pub text: &'static str,
    /// Names of the kernels in the file. [`CompiledKernel`] compiles only the first kernel.
    pub functions: &'static [&'static str],
    /// All sets of macros that the file is compiled with.
    pub define_sets: &'static [&'static [&'static str]],
}

/// A compiled kernel and its attributes.
#[derive(Debug)]
pub(super) struct CompiledKernel {
    pub function: CudaFunction,
    pub attributes: KernelAttributes,
}

impl CompiledKernel {
    /// Compiles the first kernel of a file with one set of macros.
    pub(super) fn new(device: &Device, source: &BenchmarkSource, defines: &[&str]) -> Result<Self> {
        let function = source.functions[0];
        let compiled = device.function(function, source.text, defines)?;
        let name = std::iter::once(function).chain(defines.iter().copied()).collect::<Vec<_>>().join(" ");
        Ok(Self { attributes: KernelAttributes::query(&name, &compiled)?, function: compiled })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use modalcast_compute::testing::{CAPABILITIES, assert_compiles};

    /// Compiles every kernel with every set of macros. Panics if a kernel does not compile or spills registers.
    pub(in super::super) fn compile_all(source: &BenchmarkSource) {
        assert_compiles(source.text, source.functions, source.define_sets, &CAPABILITIES);
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compile_all_rejects_broken_kernels() {
        let broken = BenchmarkSource {
            text: "extern \"C\" __global__ void f() { wrong; }",
            functions: &["f"],
            define_sets: &[&[]],
        };
        assert!(std::panic::catch_unwind(|| compile_all(&broken)).is_err());
        let misnamed =
            BenchmarkSource { text: "extern \"C\" __global__ void g() {}", functions: &["f"], define_sets: &[&[]] };
        assert!(std::panic::catch_unwind(|| compile_all(&misnamed)).is_err());
    }
}
