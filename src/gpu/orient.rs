//! Launches `kernels/orient.cu`: world normals, and tangents where the scene has normal maps, of all corners at once.

use cudarc::driver::{CudaFunction, CudaSlice, LaunchConfig, PushKernelArg as _};

use super::deform::config;
use super::device::Device;
use super::inputs::Values;
use super::layout::OrientArgs;
use super::memory::{address, upload};
use super::pack;
use super::plan::Kernel;
use crate::error::{Result, during};
use crate::scene::Scene;

/// The kernel and what it reads of a scene.
#[derive(Debug)]
pub(super) struct Orient {
    pub(super) function: CudaFunction,
    config: LaunchConfig,
    slots: CudaSlice<u8>,
    first_domains: CudaSlice<u8>,
    rest_normals: CudaSlice<u8>,
    rest_tangents: Option<CudaSlice<u8>>,
    corners: u32,
    rest_corners: u32,
}

impl Orient {
    pub(super) fn new(device: &Device, scene: &Scene, kernel: &Kernel) -> Result<Self> {
        let slots = pack::corner_slots(scene);
        let firsts = pack::first_domains(slots.iter().map(|slot| slot.first), scene.layout.corners);
        let tangents = || upload(device, &pack::rest_tangents(scene));
        Ok(Self {
            function: device.function(kernel.name, kernel.source, &kernel.defines)?,
            config: config(kernel),
            slots: upload(device, &slots)?,
            first_domains: upload(device, &firsts)?,
            rest_normals: upload(device, &pack::rest_normals(scene))?,
            rest_tangents: scene.needs.normal_maps.then(tangents).transpose()?,
            corners: scene.layout.corners as u32,
            rest_corners: pack::rest_corners(scene) as u32,
        })
    }

    /// Starts the kernel; the header among the values says where normals and tangents go.
    pub(super) fn launch(&self, device: &Device, values: Values) -> Result<()> {
        let args = OrientArgs {
            header: values.header,
            slots: address(device, &self.slots),
            first_domains: address(device, &self.first_domains),
            rest_normals: address(device, &self.rest_normals),
            rest_tangents: self.rest_tangents.as_ref().map_or(0, |buffer| address(device, buffer)),
            transforms: values.transforms,
            stamps: values.stamps,
            corners: self.corners,
            rest_corners: self.rest_corners,
        };
        let mut launch = device.stream().launch_builder(&self.function);
        // SAFETY: `OrientArgs` is the kernel's only argument. The tables come from `pack`, whose slots lie inside the
        // rest normals, tangents and transforms of the same scene; the header's outputs have the sizes that `Output` checked,
        // and the tangents are read and written only by a kernel that was compiled for a scene with normal maps.
        unsafe { launch.arg(&args).launch(self.config) }.map_err(during("orient"))?;
        Ok(())
    }
}
