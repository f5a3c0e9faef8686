//! What CUDA finds on this machine, for `doctor`: driver, devices, NVRTC, cache. Never fails, never panics.

use cudarc::driver::CudaContext;
use serde::Serialize;

use super::cache::Cache;
use super::device::{describe, driver_version};
use super::nvrtc::nvrtc;

/// One CUDA device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DeviceInfo {
    pub ordinal: i32,
    pub name: String,
    /// Compute capability, e.g. "9.0".
    pub capability: String,
    pub memory_bytes: u64,
}

/// What is there, and in words what is not.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Probe {
    /// Version of the kernel driver, e.g. "580.159.04".
    pub driver: Option<String>,
    /// Version of CUDA that the driver knows, e.g. "13.0".
    pub cuda: Option<String>,
    /// Why no device can be used, with the remedy.
    pub cuda_problem: Option<String>,
    pub devices: Vec<DeviceInfo>,
    /// Where NVRTC was found.
    pub nvrtc: Option<String>,
    pub nvrtc_version: Option<String>,
    /// Why NVRTC cannot be used, with the package that brings it.
    pub nvrtc_problem: Option<String>,
    /// Where compiled kernels are kept.
    pub kernel_cache: Option<String>,
}

/// Looks at this machine.
pub fn probe() -> Probe {
    let mut probe = Probe {
        driver: kernel_driver(),
        cuda: None,
        cuda_problem: None,
        devices: Vec::new(),
        nvrtc: None,
        nvrtc_version: None,
        nvrtc_problem: None,
        kernel_cache: Cache::of_environment().folder().map(|folder| folder.display().to_string()),
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
        let count = CudaContext::device_count();
        let devices = count.and_then(|count| (0..count).map(|ordinal| Ok((ordinal, describe(ordinal)?))).collect());
        match devices {
            Ok(list) => {
                let list: Vec<(i32, (String, (i32, i32), usize))> = list;
                let info = |(ordinal, (name, (major, minor), memory))| DeviceInfo {
                    ordinal,
                    name,
                    capability: format!("{major}.{minor}"),
                    memory_bytes: memory as u64,
                };
                self.devices = list.into_iter().map(info).collect();
            }
            Err(error) => self.cuda_problem = Some(error.to_string()),
        }
    }
}

/// The version that the kernel module gives itself; none without an NVIDIA driver.
fn kernel_driver() -> Option<String> {
    std::fs::read_to_string("/sys/module/nvidia/version").ok().map(|version| version.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_machine_can_be_probed_and_what_is_missing_is_said() {
        let probe = probe();
        assert_ne!(probe.devices.is_empty(), probe.cuda_problem.is_none(), "{probe:?}");
        assert_ne!(probe.nvrtc.is_some(), probe.nvrtc_problem.is_some());
        if let Some(problem) = probe.nvrtc_problem {
            assert!(problem.contains("nvidia-cuda-nvrtc"), "{problem}");
        }
    }
}
