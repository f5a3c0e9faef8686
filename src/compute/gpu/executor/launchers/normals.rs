//! Launches `kernels/normals.cu`: world normals and tangents of all corners, which follow the deformed triangles.

use cudarc::driver::{CudaFunction, LaunchConfig};

use crate::gpu::executor::inputs::StepInputs;
use crate::gpu::launch::{Device, DeviceBuffer, KernelDescriptor, LaunchOrder, launch_kernel};
use crate::gpu::tables::device_tables::{DeviceTables, NormalTables};
use crate::gpu::tables::layout::NormalsArgs;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;

/// The kernel and its constant tables, which `NormalTables` and `RingTables` describe. A smoothing group is the corners
/// of one vertex that share a normal. Its ring lists the vertices around it.
#[derive(Debug)]
pub struct NormalsKernel {
    function: CudaFunction,
    config: LaunchConfig,
    slots: DeviceBuffer,
    first_domains: DeviceBuffer,
    rest_normals: DeviceBuffer,
    rest_tangents: Option<DeviceBuffer>,
    corner_groups: DeviceBuffer,
    ring_offsets: DeviceBuffer,
    rings: DeviceBuffer,
    group_normals: DeviceBuffer,
    /// Number of corners of all domains.
    corner_count: u32,
    /// Number of corners of all shapes.
    rest_corner_count: u32,
    /// Number of smoothing groups of all shapes.
    group_count: u32,
}

impl NormalsKernel {
    /// Compiles the kernel and uploads its tables.
    ///
    /// # Errors
    /// As [`Device::function`]; `Fault` when the scene's normals do not follow the surface, or when the device has not
    /// enough memory.
    pub fn new(device: &Device, scene: &Scene, tables: &DeviceTables, kernel: &KernelDescriptor) -> Result<Self> {
        let missing_tables =
            || Error::Fault { stage: "normals", reason: "expected a scene whose normals follow the surface".into() };
        let NormalTables { slots, first_domains, rest_normals, rest_tangents, rings } =
            tables.normals.as_ref().ok_or_else(missing_tables)?;
        let upload_tangents = || DeviceBuffer::upload(device, rest_tangents);
        Ok(Self {
            function: kernel.compile(device)?,
            config: kernel.config(),
            slots: DeviceBuffer::upload(device, slots)?,
            first_domains: DeviceBuffer::upload(device, first_domains)?,
            rest_normals: DeviceBuffer::upload(device, rest_normals)?,
            rest_tangents: scene.features.normal_maps.then(upload_tangents).transpose()?,
            corner_groups: DeviceBuffer::upload(device, &rings.corner_groups)?,
            ring_offsets: DeviceBuffer::upload(device, &rings.ring_offsets)?,
            rings: DeviceBuffer::upload(device, &rings.rings)?,
            group_normals: DeviceBuffer::upload(device, &rings.group_normals)?,
            corner_count: scene.layout.corners as u32,
            rest_corner_count: (rest_normals.len() / 3) as u32,
            group_count: (rings.group_normals.len() / 3) as u32,
        })
    }

    /// The compiled function, for reports.
    pub const fn function(&self) -> &CudaFunction {
        &self.function
    }

    /// Starts the kernel. The caller has started the kernel that writes the positions.
    ///
    /// # Safety
    /// `inputs` belongs to the scene of this launcher. The header in `inputs` has the addresses of positions, normals
    /// and, with normal maps, tangents, with the sizes of this scene. `inputs` and these outputs exist until the kernel
    /// has ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn launch(&self, device: &Device, inputs: &StepInputs) -> Result<()> {
        let values = inputs.addresses();
        let args = NormalsArgs {
            header: values.header,
            slots: self.slots.address(),
            first_domains: self.first_domains.address(),
            rest_normals: self.rest_normals.address(),
            rest_tangents: self.rest_tangents.as_ref().map_or(0, DeviceBuffer::address),
            transforms: values.transforms,
            transform_links: values.transform_links,
            follower_frames: values.follower_frames,
            change_steps: values.change_steps,
            corner_groups: self.corner_groups.address(),
            ring_offsets: self.ring_offsets.address(),
            rings: self.rings.address(),
            group_normals: self.group_normals.address(),
            corner_count: self.corner_count,
            rest_corner_count: self.rest_corner_count,
            group_count: self.group_count,
            reserved: 0,
        };
        // SAFETY: the kernel's only argument is a `NormalsArgs`, and the kernel calls `wait_for_prerequisite_grids`
        // before it accesses memory. The tables come from `NormalTables`: corners refer to groups, rings refer to
        // vertices of their shape, and slots lie inside the rest normals, tangents, positions and transforms of the
        // same scene. Tangents are read and written only by a kernel that was compiled for a scene with normal maps.
        // The caller guarantees the outputs.
        unsafe { launch_kernel(device, &self.function, self.config, LaunchOrder::Dependent, &args) }
    }
}
