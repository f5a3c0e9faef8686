//! Launches `kernels/normals.cu`: world normals and tangents of all corners, which follow the deformed triangles.

use cudarc::driver::{CudaFunction, CudaSlice, LaunchConfig};

use super::deform::config;
use super::dependent_launch;
use super::device::Device;
use super::inputs::InputAddresses;
use super::layout::NormalsArgs;
use super::memory::{address, upload};
use super::normal_tables;
use super::plan::KernelDescriptor;
use super::rings::{self, RingTables};
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;

/// The kernel and its constant tables.
#[derive(Debug)]
pub struct NormalsKernel {
    pub function: CudaFunction,
    config: LaunchConfig,
    slots: CudaSlice<u8>,
    first_domains: CudaSlice<u8>,
    rest_normals: CudaSlice<u8>,
    rest_tangents: Option<CudaSlice<u8>>,
    members: CudaSlice<u8>,
    ring_offsets: CudaSlice<u8>,
    rings: CudaSlice<u8>,
    group_normals: CudaSlice<u8>,
    corners: u32,
    rest_corners: u32,
    groups: u32,
}

impl NormalsKernel {
    pub fn new(device: &Device, scene: &Scene, kernel: &KernelDescriptor) -> Result<Self> {
        let slots = rings::slots(scene);
        let firsts = normal_tables::first_domains(slots.iter().map(|slot| slot.first), scene.layout.corners);
        let tangents = || upload(device, &normal_tables::rest_tangents(scene));
        let tables = RingTables::new(scene);
        Ok(Self {
            function: device.function(kernel.name, kernel.source.0, &kernel.defines)?,
            config: config(kernel),
            slots: upload(device, &slots)?,
            first_domains: upload(device, &firsts)?,
            rest_normals: upload(device, &normal_tables::rest_normals(scene))?,
            rest_tangents: scene.needs.normal_maps.then(tangents).transpose()?,
            members: upload(device, &tables.members)?,
            ring_offsets: upload(device, &tables.ring_offsets)?,
            rings: upload(device, &tables.rings)?,
            group_normals: upload(device, &tables.normals)?,
            corners: scene.layout.corners as u32,
            rest_corners: normal_tables::rest_corners(scene) as u32,
            groups: (tables.normals.len() / 3) as u32,
        })
    }

    /// Starts the kernel after the one that writes the positions. The header among `values` has the addresses of the
    /// positions, normals and tangents.
    pub fn launch(&self, device: &Device, values: InputAddresses) -> Result<()> {
        let args = NormalsArgs {
            header: values.header,
            slots: address(device, &self.slots),
            first_domains: address(device, &self.first_domains),
            rest_normals: address(device, &self.rest_normals),
            rest_tangents: self.rest_tangents.as_ref().map_or(0, |buffer| address(device, buffer)),
            transforms: values.transforms,
            transform_links: values.transform_links,
            frames: values.frames,
            change_steps: values.change_steps,
            members: address(device, &self.members),
            ring_offsets: address(device, &self.ring_offsets),
            rings: address(device, &self.rings),
            group_normals: address(device, &self.group_normals),
            corners: self.corners,
            rest_corners: self.rest_corners,
            groups: self.groups,
            reserved: 0,
        };
        // SAFETY: `NormalsArgs` is the kernel's only argument, and the kernel calls `await_previous` before it accesses
        // memory. The tables come from `normal_tables` and `rings`: members refer to groups, rings refer to vertices of their
        // shape, and slots lie inside the rest normals, tangents, positions and transforms of the same scene. The
        // header's outputs have the sizes that `OutputBuffers` checked. Tangents are read and written only by a kernel that
        // was compiled for a scene with normal maps.
        unsafe { dependent_launch::launch(device, &self.function, self.config, &args) }
    }
}
