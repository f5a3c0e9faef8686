//! EGL devices: describes all of them for `doctor`, and selects one.

use std::rc::Rc;

use super::egl::{Candidate, Context, candidates, no_device_error};
use super::gl::{self, Gl};
use crate::types::DevicePreference;
use modalcast_model::error::{Error, Result};

/// A device that may offer OpenGL, as EGL describes it.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct EglDevice {
    /// Index among EGL's devices; none for Mesa's surfaceless platform, which needs no device.
    pub index: Option<usize>,
    /// Vendor or driver.
    pub vendor: String,
    /// Extensions of the device.
    pub extensions: Vec<String>,
    /// Ordinal of the corresponding CUDA device, from EGL_CUDA_DEVICE_NV.
    pub cuda_device: Option<i32>,
    /// DRM node, such as `/dev/dri/card0`.
    pub drm_node: Option<String>,
    /// GL_RENDERER and GL_VERSION; none when no context could be created.
    pub renderer: Option<String>,
    pub version: Option<String>,
    /// Whether it draws on the CPU. Without a context, this is what the device itself reports.
    pub software: bool,
    /// Why no context could be created.
    pub problem: Option<String>,
}

/// All EGL devices; a context is tried on each.
///
/// # Errors
/// `Unavailable` with the package name when libEGL cannot be loaded.
pub fn devices() -> Result<Vec<EglDevice>> {
    Ok(candidates()?.into_iter().map(describe).collect())
}

fn describe(candidate: Candidate) -> EglDevice {
    let tried = open_candidate(&candidate);
    let (limits, problem) = match tried {
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

fn open_candidate(candidate: &Candidate) -> Result<Rc<Gl>> {
    Gl::new(Context::open(candidate, gl::is_debug_enabled())?)
}

/// Opens the preferred device, leaves its context current on this thread and returns it with the ordinal of its CUDA device.
pub(crate) fn open(prefer: DevicePreference) -> Result<(Rc<Gl>, Option<i32>)> {
    let mut tried = Vec::new();
    for (candidate, software) in rank_candidates(candidates()?, prefer) {
        let name = candidate.index.map_or("surfaceless".to_string(), |index| format!("device {index}"));
        match open_candidate(&candidate) {
            Ok(gl) if software.is_none_or(|software| software == gl.limits.software) => {
                gl.stay_current()?;
                return Ok((gl, candidate.cuda_device));
            }
            Ok(gl) => tried.push(format!("{name} ({}) draws with {}", candidate.vendor, gl.limits.renderer)),
            Err(error) => tried.push(format!("{name} ({}): {error}", candidate.vendor)),
        }
    }
    Err(refusal(prefer, &tried))
}

fn refusal(prefer: DevicePreference, tried: &[String]) -> Error {
    match prefer {
        DevicePreference::Cuda(ordinal) => {
            no_device_error(&format!("the EGL device that is CUDA device {ordinal}"), tried)
        }
        DevicePreference::Any => no_device_error("any device", tried),
        DevicePreference::Software => no_device_error("Mesa's software rasterizer", tried),
    }
}

/// The candidates to try, best first. The flag says whether the context must be a software one (`true`) or hardware
/// (`false`).
fn rank_candidates(found: Vec<Candidate>, prefer: DevicePreference) -> Vec<(Candidate, Option<bool>)> {
    let hardware = |candidate: &Candidate| match (candidate.cuda_device, &candidate.drm_node) {
        (Some(_), _) => 0,
        (None, Some(_)) => 1,
        (None, None) => 2,
    };
    let software = |candidate: &Candidate| if candidate.software { 0 } else { 1 };
    let sorted = |rank: &dyn Fn(&Candidate) -> i32, wanted: Option<bool>| {
        let mut list = found.clone();
        list.sort_by_key(rank);
        list.into_iter().map(|candidate| (candidate, wanted)).collect::<Vec<_>>()
    };
    match prefer {
        DevicePreference::Cuda(ordinal) => {
            let is_it = |candidate: &Candidate| candidate.cuda_device == Some(ordinal);
            found.into_iter().filter(is_it).map(|candidate| (candidate, None)).collect()
        }
        DevicePreference::Software => sorted(&software, Some(true)),
        DevicePreference::Any => {
            let mut list = sorted(&hardware, Some(false));
            list.retain(|(candidate, _)| !candidate.software);
            list.extend(sorted(&software, Some(true)));
            list
        }
    }
}
