//! BASELINE. The kernels of chapter 3.2 of the thesis, implemented as the thesis describes them, for comparison with
//! the server's kernels.
//!
//! | file | chapter | contents |
//! |---|---|---|
//! | [`thesis_single`] | 3.2.1 | u = U q of one domain, four multiplications per thread |
//! | [`group`], [`thesis_multi`] | 3.2.2 | u = U q of many domains, in groups of lanes |
//! | [`thesis_update`] | 3.2.3 | x = T (x0 + u), normals and tangents, of triangles that share no vertices |
//!
//! Unlike in the thesis, u stays in device memory. In mapped host memory, the PCIe bus would limit the times.

mod group;
mod thesis_multi;
mod thesis_single;
mod thesis_update;

pub use group::{KernelSplit, LaneCounts, count_lanes, idle_lanes_per_warp};

use std::sync::Arc;

use super::input_sets::{InputSets, StepPart};
use super::kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
use group::{DisplacementLayout, pack_q};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};
use thesis_multi::MultiDomainKernel;
use thesis_single::SingleDomainKernel;
use thesis_update::{UpdateKernel, transform_matrices};

/// The kernels that compute u = U q.
#[derive(Debug)]
enum UqKernel {
    Single(SingleDomainKernel),
    Multi(MultiDomainKernel),
}

/// The kernels of the thesis for a scene, with the inputs of several steps.
#[derive(Debug)]
pub struct ThesisBenchmark {
    name: String,
    uq: UqKernel,
    update: Option<UpdateKernel>,
    u: DeviceBuffer,
    displacements: DisplacementLayout,
    input_sets: InputSets,
    vertices: usize,
    /// Bytes of the packed q per step.
    q_bytes: u64,
}

impl ThesisBenchmark {
    /// The single-domain kernel, followed by the vertex update for [`StepPart::Whole`].
    ///
    /// # Errors
    /// `Invalid` when the scene is not one domain with modes, or there is no state; `Unavailable` when NVRTC is
    /// missing; `Fault` when the device fails.
    pub fn single(device: &Device, scene: &Arc<Scene>, states: &[SceneState], part: StepPart) -> Result<Self> {
        let uq = UqKernel::Single(SingleDomainKernel::new(device, scene)?);
        Self::new(device, scene, states, (part.benchmark_name("thesis_single"), uq, part))
    }

    /// The kernels for many domains, followed by the vertex update for [`StepPart::Whole`].
    ///
    /// # Errors
    /// `Invalid` when a domain has more than 32 modes, no domain has modes but [`StepPart::Uq`] is requested, or there
    /// is no state; `Unavailable` when NVRTC is missing; `Fault` when the device fails.
    pub fn multi(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (split, part): (KernelSplit, StepPart),
    ) -> Result<Self> {
        if part == StepPart::Uq && !scene.features.modes {
            return Err(invalid("modes", "at least 1 for u = U q alone", 0));
        }
        let uq = UqKernel::Multi(MultiDomainKernel::new(device, scene, split)?);
        let name = part.benchmark_name(&format!("thesis_multi_{}", split.widths().len()));
        Self::new(device, scene, states, (name, uq, part))
    }

    fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (name, uq, part): (String, UqKernel, StepPart),
    ) -> Result<Self> {
        let displacements = DisplacementLayout::of(scene);
        let update = (part == StepPart::Whole).then(|| UpdateKernel::new(device, scene)).transpose()?;
        Ok(Self {
            name,
            uq,
            update,
            u: DeviceBuffer::zeroed(device, 16 * displacements.vertex_count as u64)?,
            displacements,
            input_sets: InputSets::new(device, scene, states, |state| {
                [pack_q(scene, state), transform_matrices(scene, state)]
            })?,
            vertices: scene.layout.vertices,
            q_bytes: scene
                .layout
                .domains
                .iter()
                .map(|domain_layout| 4 * domain_layout.rank.next_multiple_of(4) as u64)
                .sum(),
        })
    }
}

impl KernelBenchmark for ThesisBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn input_set_count(&self) -> usize {
        self.input_sets.count()
    }

    fn launch(&self, device: &Device, input_set: usize) -> Result<()> {
        let (inputs, u) = (self.input_sets.select(input_set), self.u.address());
        match &self.uq {
            UqKernel::Single(single) => single.launch(device, inputs.q, u)?,
            UqKernel::Multi(multi) => multi.launch(device, inputs.q, u)?,
        }
        self.update.as_ref().map_or(Ok(()), |update| update.launch(device, inputs.transforms, u))
    }

    /// For [`StepPart::Whole`], a vertex that no triangle refers to is NaN, because the vertex update computes the
    /// vertices of triangles only.
    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        if let Some(update) = &self.update {
            return update.positions(device, self.vertices);
        }
        let DisplacementLayout { first_vertices, vertex_count } = &self.displacements;
        let mut u = vec![[0.0_f32; 4]; *vertex_count];
        self.u.read(device, 0, &mut u)?;
        Ok(self.input_sets.compute_positions_on_host(|domain, vertex| {
            let [x, y, z, _] = first_vertices[domain].map_or([0.0; 4], |first| u[first as usize + vertex]);
            [x, y, z]
        }))
    }

    fn traffic(&self) -> Vec<ArrayTraffic> {
        let mut traffic = match &self.uq {
            UqKernel::Single(single) => single.traffic(),
            UqKernel::Multi(multi) => multi.traffic(self.q_bytes),
        };
        traffic.extend(self.update.iter().flat_map(UpdateKernel::traffic));
        traffic
    }

    fn launches_per_step(&self) -> usize {
        let uq_launches = match &self.uq {
            UqKernel::Single(_) => 1,
            UqKernel::Multi(multi) => multi.launches_per_step(),
        };
        uq_launches + usize::from(self.update.is_some())
    }

    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        let mut attributes = match &self.uq {
            UqKernel::Single(single) => vec![single.attributes().clone()],
            UqKernel::Multi(multi) => multi.attributes(),
        };
        attributes.extend(self.update.iter().map(|update| update.attributes().clone()));
        attributes
    }
}
