//! EGL devices: describes all of them for `modalcast doctor`, and selects one.

use std::rc::Rc;

use super::egl::{Candidate, Context, candidates, no_device_error};
use super::gl::{self, Gl};
use crate::types::DevicePreference;
use modalcast_model::error::{Error, Result};

/// A device that may offer OpenGL, as EGL describes it.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct EglDevice {
    /// Index among EGL's devices; `None` for Mesa's surfaceless platform, which needs no device.
    pub index: Option<usize>,
    /// Name of the vendor or driver.
    pub vendor: String,
    /// Extensions of the device.
    pub extensions: Vec<String>,
    /// Ordinal of the corresponding CUDA device, from EGL_CUDA_DEVICE_NV.
    pub cuda_device: Option<i32>,
    /// DRM node, such as `/dev/dri/card0`.
    pub drm_node: Option<String>,
    /// GL_RENDERER; `None` if no context could be created.
    pub renderer: Option<String>,
    /// GL_VERSION; `None` if no context could be created.
    pub version: Option<String>,
    /// Whether the device draws on the CPU. From the context, or from EGL if no context could be created.
    pub software: bool,
    /// Reason why no context could be created.
    pub problem: Option<String>,
}

/// Describes all EGL devices, after trying to create a context on each.
///
/// # Errors
/// `Unavailable` with the package name when libEGL cannot be loaded.
pub fn devices() -> Result<Vec<EglDevice>> {
    Ok(candidates()?.into_iter().map(describe_device).collect())
}

/// Describes a candidate, after trying to create a context on it.
fn describe_device(candidate: Candidate) -> EglDevice {
    let (limits, problem) = match open_candidate(&candidate) {
        Ok(gl) => (Some(gl.limits.clone()), None),
        Err(error) => (None, Some(error.to_string())),
    };
    EglDevice {
        index: candidate.index,
        vendor: candidate.vendor,
        extensions: candidate.extensions,
        cuda_device: candidate.cuda_device,
        drm_node: candidate.drm_node,
        software: limits.as_ref().map_or(candidate.software, |limits| limits.software),
        version: limits.as_ref().map(|limits| limits.version.clone()),
        renderer: limits.map(|limits| limits.renderer),
        problem,
    }
}

/// Creates a context on a candidate.
fn open_candidate(candidate: &Candidate) -> Result<Rc<Gl>> {
    Gl::new(Context::open(candidate, gl::is_debug_enabled())?)
}

/// Opens the preferred device and leaves its context current on this thread. Returns the context and the ordinal of the
/// corresponding CUDA device.
pub(crate) fn open(preference: DevicePreference) -> Result<(Rc<Gl>, Option<i32>)> {
    let mut attempts = Vec::new();
    for (candidate, expected_software) in rank_candidates(candidates()?, preference) {
        let name = candidate.index.map_or("surfaceless".to_string(), |index| format!("device {index}"));
        match open_candidate(&candidate) {
            Ok(gl) if expected_software.is_none_or(|expected_software| expected_software == gl.limits.software) => {
                gl.stay_current()?;
                return Ok((gl, candidate.cuda_device));
            }
            Ok(gl) => attempts.push(format!("{name} ({}) draws with {}", candidate.vendor, gl.limits.renderer)),
            Err(error) => attempts.push(format!("{name} ({}): {error}", candidate.vendor)),
        }
    }
    Err(selection_error(preference, &attempts))
}

/// The error if no candidate matches the preference.
fn selection_error(preference: DevicePreference, attempts: &[String]) -> Error {
    match preference {
        DevicePreference::Cuda(ordinal) => {
            no_device_error(&format!("the EGL device that is CUDA device {ordinal}"), attempts)
        }
        DevicePreference::Any => no_device_error("any device", attempts),
        DevicePreference::Software => no_device_error("Mesa's software rasterizer", attempts),
    }
}

/// The candidates to try, best first. The flag states whether the context must draw in software (`true`) or on hardware
/// (`false`); `None` allows both.
fn rank_candidates(candidates: Vec<Candidate>, preference: DevicePreference) -> Vec<(Candidate, Option<bool>)> {
    // CUDA devices first, then other devices with a DRM node, which usually are GPUs.
    let hardware_rank = |candidate: &Candidate| match (candidate.cuda_device, &candidate.drm_node) {
        (Some(_), _) => 0,
        (None, Some(_)) => 1,
        (None, None) => 2,
    };
    let software_rank = |candidate: &Candidate| if candidate.software { 0 } else { 1 };
    let sort_by_rank = |rank: &dyn Fn(&Candidate) -> i32, expected_software: Option<bool>| {
        let mut ranked = candidates.clone();
        ranked.sort_by_key(rank);
        ranked.into_iter().map(|candidate| (candidate, expected_software)).collect::<Vec<_>>()
    };
    match preference {
        DevicePreference::Cuda(ordinal) => {
            let is_preferred = |candidate: &Candidate| candidate.cuda_device == Some(ordinal);
            candidates.into_iter().filter(is_preferred).map(|candidate| (candidate, None)).collect()
        }
        DevicePreference::Software => sort_by_rank(&software_rank, Some(true)),
        DevicePreference::Any => {
            let mut ranked = sort_by_rank(&hardware_rank, Some(false));
            ranked.retain(|(candidate, _)| !candidate.software);
            ranked.extend(sort_by_rank(&software_rank, Some(true)));
            ranked
        }
    }
}
