//! BASELINE. The kernels of the thesis's chapter 3.2 as its text describes them, for comparison with ours. Only
//! benchmarks use them.
//!
//! | file | chapter | contents |
//! |---|---|---|
//! | [`thesis_single`] | 3.2.1 | u = U q of one domain, four multiplications per thread |
//! | [`group`], [`thesis_multi`] | 3.2.2 | u = U q of many domains, in groups of lanes |
//! | [`thesis_update`] | 3.2.3 | x = T (x0 + u), normals and tangents, of unfolded triangles |
//!
//! Here u stays in device memory. The text maps it into host memory, which over PCIe would measure the bus.

mod group;
mod thesis_multi;
mod thesis_single;
mod thesis_update;

pub use group::{KernelSplit, LaneCounts, count_lanes, idle_lanes_per_warp};

use std::sync::Arc;

use super::input_sets::{InputSets, Part};
use super::kernel_benchmark::{KernelAttributes, KernelBenchmark};
use group::{packed_q, places_of_u};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};
use thesis_multi::MultiDomainKernel;
use thesis_single::SingleDomainKernel;
use thesis_update::{UpdateKernel, matrices};

/// The kernels that compute u.
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
    /// First vertex of each domain's u (`None` without modes), and the number of vertices that have a u.
    places: (Vec<Option<u32>>, usize),
    turns: InputSets,
    vertices: usize,
    /// Bytes of the packed q per step.
    q_bytes: u64,
}

impl ThesisBenchmark {
    /// The single-domain kernel, followed by the vertex update for [`Part::Whole`].
    ///
    /// # Errors
    /// `Invalid` when the scene is not one domain with modes, or there is no state; `Unavailable` when NVRTC is
    /// missing; `Fault` when the device fails.
    pub fn single(device: &Device, scene: &Arc<Scene>, states: &[SceneState], part: Part) -> Result<Self> {
        let uq = UqKernel::Single(SingleDomainKernel::new(device, scene)?);
        Self::new(device, scene, states, (part.named("thesis_single"), uq, part))
    }

    /// The grouped kernels, followed by the vertex update for [`Part::Whole`].
    ///
    /// # Errors
    /// `Invalid` when a domain has more than 32 modes, `Part::UqKernel` is requested and no domain has modes, or there is
    /// no state; `Unavailable` when NVRTC is missing; `Fault` when the device fails.
    pub fn multi(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (split, part): (KernelSplit, Part),
    ) -> Result<Self> {
        if part == Part::Uq && !scene.needs.modes {
            return Err(invalid("modes", "some, for u = U q alone", 0));
        }
        let uq = UqKernel::Multi(MultiDomainKernel::new(device, scene, split)?);
        let name = part.named(&format!("thesis_multi_{}", split.widths().len()));
        Self::new(device, scene, states, (name, uq, part))
    }

    fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (name, uq, part): (String, UqKernel, Part),
    ) -> Result<Self> {
        let places = places_of_u(scene);
        let update = (part == Part::Whole).then(|| UpdateKernel::new(device, scene)).transpose()?;
        Ok(Self {
            name,
            uq,
            update,
            u: DeviceBuffer::zeroed(device, 16 * places.1 as u64)?,
            places,
            turns: InputSets::new(device, scene, states, |state| [packed_q(scene, state), matrices(scene, state)])?,
            vertices: scene.layout.vertices,
            q_bytes: scene.layout.slots.iter().map(|slot| 4 * slot.rank.next_multiple_of(4) as u64).sum(),
        })
    }
}

impl KernelBenchmark for ThesisBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn turns(&self) -> usize {
        self.turns.count()
    }

    fn launch(&self, device: &Device, turn: usize) -> Result<()> {
        let (values, u) = (self.turns.start(turn), self.u.address());
        match &self.uq {
            UqKernel::Single(single) => single.launch(device, values.q, u)?,
            UqKernel::Multi(multi) => multi.launch(device, values.q, u)?,
        }
        self.update.as_ref().map_or(Ok(()), |update| update.launch(device, values.transforms, u))
    }

    /// For [`Part::Whole`], a vertex that no triangle refers to is NaN, because unfolded triangles do not contain it.
    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        if let Some(update) = &self.update {
            return update.positions(device, self.vertices);
        }
        let (places, count) = &self.places;
        let mut u = vec![[0.0_f32; 4]; *count];
        self.u.read(device, 0, &mut u)?;
        Ok(self.turns.finish_on_host(|domain, vertex| {
            let [x, y, z, _] = places[domain].map_or([0.0; 4], |first| u[first as usize + vertex]);
            [x, y, z]
        }))
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        let mut bytes = match &self.uq {
            UqKernel::Single(single) => single.bytes(),
            UqKernel::Multi(multi) => multi.bytes(self.q_bytes),
        };
        bytes.extend(self.update.iter().flat_map(UpdateKernel::bytes));
        bytes
    }

    fn launches(&self) -> usize {
        let uq = match &self.uq {
            UqKernel::Single(_) => 1,
            UqKernel::Multi(multi) => multi.launches(),
        };
        uq + usize::from(self.update.is_some())
    }

    fn kernels(&self) -> Vec<KernelAttributes> {
        let mut facts = match &self.uq {
            UqKernel::Single(single) => vec![single.facts().clone()],
            UqKernel::Multi(multi) => multi.facts(),
        };
        facts.extend(self.update.iter().map(|update| update.facts().clone()));
        facts
    }
}
