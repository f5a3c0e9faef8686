//! Probes CUDA on this machine for `doctor`: driver, devices, NVRTC, kernel cache. Never fails, never panics.

use cudarc::driver::sys::CUdevice_attribute as Attribute;
use cudarc::driver::{CudaContext, DriverError, result};
use serde::Serialize;

use super::compile::{self, nvrtc};
use super::device::driver_version;

/// One CUDA device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DeviceInfo {
    pub ordinal: i32,
    pub name: String,
    /// Compute capability, e.g. "9.0".
    pub capability: String,
    pub memory_bytes: u64,
}

/// The available CUDA components, and a message for each missing one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Probe {
    /// Version of the kernel driver, e.g. "580.159.04".
    pub driver: Option<String>,
    /// CUDA version that the driver supports, e.g. "13.0".
    pub cuda: Option<String>,
    /// Reason why no device can be used, with the remedy.
    pub cuda_problem: Option<String>,
    pub devices: Vec<DeviceInfo>,
    /// Path of NVRTC.
    pub nvrtc: Option<String>,
    pub nvrtc_version: Option<String>,
    /// Reason why NVRTC cannot be used, with the package to install.
    pub nvrtc_problem: Option<String>,
    /// Folder of the compiled kernels.
    pub kernel_cache: Option<String>,
}

/// Probes this machine.
pub fn probe() -> Probe {
    let mut probe = Probe {
        driver: kernel_driver_version(),
        cuda: None,
        cuda_problem: None,
        devices: Vec::new(),
        nvrtc: None,
        nvrtc_version: None,
        nvrtc_problem: None,
        kernel_cache: compile::cache_folder().map(|folder| folder.display().to_string()),
    };
    match driver_version() {
        Ok(version) => {
            probe.cuda = Some(format!("{}.{}", version / 1000, version % 1000 / 10));
            probe.add_devices();
        }
        Err(error) => probe.cuda_problem = Some(error.to_string()),
    }
    match nvrtc() {
        Ok(nvrtc) => {
            probe.nvrtc = Some(nvrtc.path.display().to_string());
            probe.nvrtc_version = Some(format!("{}.{}", nvrtc.version.0, nvrtc.version.1));
        }
        Err(error) => probe.nvrtc_problem = Some(error.to_string()),
    }
    probe
}

impl Probe {
    fn add_devices(&mut self) {
        let devices = CudaContext::device_count().and_then(|count| (0..count).map(describe_device).collect());
        match devices {
            Ok(devices) => self.devices = devices,
            Err(error) => self.cuda_problem = Some(error.to_string()),
        }
    }
}

/// Name, capability and memory of a device, without a context on it.
fn describe_device(ordinal: i32) -> Result<DeviceInfo, DriverError> {
    let device = result::device::get(ordinal)?;
    // SAFETY: the driver returned `device` above.
    let (major, minor, memory) = unsafe {
        let major = result::device::get_attribute(device, Attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR)?;
        let minor = result::device::get_attribute(device, Attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR)?;
        (major, minor, result::device::total_mem(device)?)
    };
    let (name, capability) = (result::device::get_name(device)?, format!("{major}.{minor}"));
    Ok(DeviceInfo { ordinal, name, capability, memory_bytes: memory as u64 })
}

/// The version of the NVIDIA kernel module; `None` without an NVIDIA driver.
fn kernel_driver_version() -> Option<String> {
    let read = |path: &str| std::fs::read_to_string(path).ok();
    let text = read("/sys/module/nvidia/version").or_else(|| read("/proc/driver/nvidia/version"))?;
    first_version(&text)
}

/// The first word that consists of digits and dots.
fn first_version(text: &str) -> Option<String> {
    let is_version = |word: &&str| word.contains('.') && word.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    text.split_whitespace().find(is_version).map(String::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probe_reports_each_component_or_its_problem() {
        let probe = probe();
        assert_ne!(probe.devices.is_empty(), probe.cuda_problem.is_none(), "{probe:?}");
        assert_ne!(probe.nvrtc.is_some(), probe.nvrtc_problem.is_some());
        if let Some(problem) = probe.nvrtc_problem {
            assert!(problem.contains("nvidia-cuda-nvrtc"), "{problem}");
        }
    }

    #[test]
    fn driver_version_is_found_in_either_file() {
        let version_file = "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  580.159.04  Release Build";
        assert_eq!(first_version(version_file).as_deref(), Some("580.159.04"));
        assert_eq!(first_version("580.159.04\n").as_deref(), Some("580.159.04"));
        assert_eq!(first_version("no driver here."), None);
    }
}
