//! A CUDA device: its context, its stream, and compiled kernels.

use std::sync::Arc;

use cudarc::driver::{CudaContext, CudaFunction, CudaModule, CudaStream, DriverError, result, sys};
use cudarc::nvrtc::Ptx;

use super::compile::{cubin, nvrtc};
use super::context::CurrentContext;
use super::error::cuda_error;
use modalcast_model::error::{Error, Result};

/// Minimum CUDA version of the driver, 12.0, in the encoding of cuDriverGetVersion: 1000 major + 10 minor.
const MIN_DRIVER_VERSION: i32 = 12_000;

/// A CUDA device. One stream orders all work, except readbacks of vertices and the preparation of deformers. Readbacks
/// have a second stream, and events order the work of the two streams. Each preparation has a stream of its own, and
/// waits for the end of the work of that stream.
#[derive(Debug)]
pub struct Device {
    context: Arc<CudaContext>,
    stream: Arc<CudaStream>,
    name: String,
    ordinal: usize,
    capability: (i32, i32),
}

impl Device {
    /// Opens a device by ordinal.
    ///
    /// # Errors
    /// `Unavailable` with the missing library and how to install it.
    pub fn open(ordinal: usize) -> Result<Arc<Self>> {
        let version = driver_version()?;
        if version < MIN_DRIVER_VERSION {
            let reason = format!("the driver supports only CUDA {}.{}", version / 1000, version % 1000 / 10);
            return Err(Error::Unavailable { what: "CUDA 12.0", reason, remedy: UPDATE_REMEDY.into() });
        }
        let count = CudaContext::device_count().map_err(|error| no_device(ordinal, &error.to_string()))?;
        if ordinal >= usize::try_from(count).unwrap_or(0) {
            return Err(no_device(ordinal, &format!("this machine has {count} devices")));
        }
        Self::with_context(ordinal).map_err(|error| no_device(ordinal, &error.to_string()))
    }

    fn with_context(ordinal: usize) -> Result<Arc<Self>, DriverError> {
        let context = CudaContext::new(ordinal)?;
        // SAFETY: event tracking orders the accesses of several streams. It is not needed: the stream below orders all
        // work but readbacks, and the module `readback` orders the copies of its own stream by its own events.
        unsafe { context.disable_event_tracking() };
        let stream = context.new_stream()?;
        let name = context.name()?;
        let capability = context.compute_capability()?;
        Ok(Arc::new(Self { context, stream, name, ordinal, capability }))
    }

    /// The same device with another stream. Work on the two streams runs concurrently, so a thread can upload a scene
    /// while another thread captures or launches the steps of other scenes.
    ///
    /// # Errors
    /// `Fault` when the driver refuses a stream.
    pub(crate) fn with_own_stream(&self) -> Result<Self> {
        let stream = self.context.new_stream().map_err(cuda_error("device"))?;
        let (context, name) = (Arc::clone(&self.context), self.name.clone());
        Ok(Self { context, stream, name, ordinal: self.ordinal, capability: self.capability })
    }

    /// The device's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The ordinal by which it was opened.
    pub const fn ordinal(&self) -> usize {
        self.ordinal
    }

    /// The UUID of the device, by which another process finds it.
    ///
    /// # Errors
    /// `Fault` when the driver reports one.
    pub fn uuid(&self) -> Result<[u8; 16]> {
        let uuid = self.context.uuid().map_err(cuda_error("device"))?;
        Ok(uuid.bytes.map(|byte| byte as u8))
    }

    /// Compute capability, major and minor.
    pub const fn capability(&self) -> (i32, i32) {
        self.capability
    }

    /// Free and total device memory in bytes.
    ///
    /// # Errors
    /// `Fault` when the driver reports one.
    pub fn memory(&self) -> Result<(usize, usize)> {
        self.context.mem_get_info().map_err(cuda_error("device"))
    }

    /// Checks that kernels can be compiled for this device, so that a server can choose another backend before it loads
    /// a scene.
    ///
    /// # Errors
    /// `Unavailable` with the remedy when NVRTC is missing or does not fit the driver.
    pub fn check_compiler(&self) -> Result<()> {
        check_nvrtc_version(nvrtc()?.version, driver_version()?)
    }

    /// The context, for calls of the driver that this crate does not wrap.
    pub const fn context(&self) -> &Arc<CudaContext> {
        &self.context
    }

    /// Makes the context current on this thread until the guard is dropped.
    pub(crate) fn enter(&self) -> Result<CurrentContext> {
        CurrentContext::enter(&self.context)
    }

    /// Waits for all work that was submitted to the stream.
    ///
    /// # Errors
    /// `DeviceLost` or `Fault` of that work, in `stage`.
    pub fn synchronize(&self, stage: &'static str) -> Result<()> {
        self.stream.synchronize().map_err(cuda_error(stage))
    }

    /// The stream that orders all work.
    pub const fn stream(&self) -> &Arc<CudaStream> {
        &self.stream
    }

    /// The function `name` of a source, compiled for this device or taken from the cache.
    ///
    /// # Errors
    /// `Unavailable` when NVRTC is missing or does not fit the driver; `Fault` when compiling or loading fails.
    pub fn function(&self, name: &str, source: &str, defines: &[&str]) -> Result<CudaFunction> {
        let module = self.module(name, source, defines)?;
        module.load_function(name).map_err(cuda_error("load kernel"))
    }

    /// Several functions of a source that is compiled once; the first function names the module.
    ///
    /// # Errors
    /// As [`Self::function`].
    pub(crate) fn functions(&self, names: &[&str], source: &str, defines: &[&str]) -> Result<Vec<CudaFunction>> {
        let module = self.module(names.first().unwrap_or(&""), source, defines)?;
        names.iter().map(|name| module.load_function(name).map_err(cuda_error("load kernel"))).collect()
    }

    fn module(&self, name: &str, source: &str, defines: &[&str]) -> Result<Arc<CudaModule>> {
        self.check_compiler()?;
        let cubin = cubin(name, source, defines, self.capability)?;
        self.context.load_module(Ptx::from_binary(cubin)).map_err(cuda_error("load kernel"))
    }
}

const INSTALL_REMEDY: &str = "Install the NVIDIA driver (it brings libcuda.so.1), or use the cpu backend";
const UPDATE_REMEDY: &str = "Update the NVIDIA driver, or use the cpu backend";

fn no_device(ordinal: usize, reason: &str) -> Error {
    let remedy = "List devices with `modalcast doctor`, check CUDA_VISIBLE_DEVICES, or use the cpu backend";
    Error::Unavailable { what: "CUDA device", reason: format!("device {ordinal}: {reason}"), remedy: remedy.into() }
}

/// The CUDA version of the driver in the encoding of cuDriverGetVersion: 13000 is 13.0.
///
/// # Errors
/// `Unavailable` when there is no driver or it does not start.
pub(crate) fn driver_version() -> Result<i32> {
    // SAFETY: the call only tries to load libcuda under its usual names. Without this check the calls below would
    // panic.
    if !unsafe { sys::is_culib_present() } {
        let reason = "libcuda.so.1 cannot be loaded".into();
        return Err(Error::Unavailable { what: "CUDA", reason, remedy: INSTALL_REMEDY.into() });
    }
    let mut version = 0;
    // SAFETY: the library is loaded, and `version` is a live integer.
    let start_result = unsafe { sys::cuDriverGetVersion(&mut version) }.result().and_then(|()| result::init());
    let unusable = |error: DriverError| Error::Unavailable {
        what: "CUDA",
        reason: format!("the driver does not start: {error}"),
        remedy: INSTALL_REMEDY.into(),
    };
    start_result.map_err(unusable).map(|()| version)
}

/// Checks the NVRTC version: the driver does not load machine code of a newer major version.
fn check_nvrtc_version(nvrtc: (i32, i32), driver: i32) -> Result<()> {
    if nvrtc.0 <= driver / 1000 {
        return Ok(());
    }
    let reason = format!("NVRTC is {}.{}, the driver supports only CUDA {}.x", nvrtc.0, nvrtc.1, driver / 1000);
    let remedy = format!("{UPDATE_REMEDY}, or set MODALCAST_NVRTC to the libnvrtc.so of CUDA {}", driver / 1000);
    Err(Error::Unavailable { what: "NVRTC for this driver", reason, remedy })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_device_is_unavailable() {
        let error = Device::open(4096).expect_err("a missing device");
        assert!(matches!(error, Error::Unavailable { .. }), "{error}");
        assert!(error.to_string().contains("cpu backend"), "{error}");
    }

    #[test]
    fn newer_nvrtc_than_the_driver_is_rejected() {
        check_nvrtc_version((12, 9), 13_000).expect("an older NVRTC to be accepted");
        check_nvrtc_version((13, 1), 13_000).expect("a newer minor version to be accepted");
        let error = check_nvrtc_version((13, 0), 12_040).expect_err("a newer major version").to_string();
        assert!(error.contains("13.0") && error.contains("CUDA 12"), "{error}");
    }
}
