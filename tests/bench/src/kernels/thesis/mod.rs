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

pub use group::{Lanes, Split, idle_in_warp, lanes};

use std::sync::Arc;

use cudarc::driver::CudaSlice;

use super::trial::{KernelFacts, Trial};
use super::turns::{Part, Turns};
use group::{packed_q, places_of_u};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::memory::{address, download, room};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, State};
use thesis_multi::Multi;
use thesis_single::Single;
use thesis_update::{Update, matrices};

/// The kernels that compute u.
#[derive(Debug)]
enum Uq {
    Single(Single),
    Multi(Multi),
}

/// The kernels of the thesis for a scene, with the inputs of several steps.
#[derive(Debug)]
pub struct Thesis {
    name: String,
    uq: Uq,
    update: Option<Update>,
    u: CudaSlice<u8>,
    /// First vertex of each domain's u (`None` without modes), and the number of vertices that have a u.
    places: (Vec<Option<u32>>, usize),
    turns: Turns,
    vertices: usize,
    /// Bytes of the packed q per step.
    q_bytes: u64,
}

impl Thesis {
    /// The single-domain kernel, followed by the vertex update for [`Part::Whole`].
    ///
    /// # Errors
    /// `Invalid` when the scene is not one domain with modes, or there is no state; `Unavailable` when NVRTC is
    /// missing; `Fault` when the device fails.
    pub fn single(device: &Device, scene: &Arc<Scene>, states: &[State], part: Part) -> Result<Self> {
        let uq = Uq::Single(Single::new(device, scene)?);
        Self::new(device, scene, states, (part.named("thesis_single"), uq, part))
    }

    /// The grouped kernels, followed by the vertex update for [`Part::Whole`].
    ///
    /// # Errors
    /// `Invalid` when a domain has more than 32 modes, [`Part::Uq`] is requested and no domain has modes, or there is
    /// no state; `Unavailable` when NVRTC is missing; `Fault` when the device fails.
    pub fn multi(device: &Device, scene: &Arc<Scene>, states: &[State], (split, part): (Split, Part)) -> Result<Self> {
        if part == Part::Uq && !scene.needs.modes {
            return Err(invalid("modes", "some, for u = U q alone", 0));
        }
        let uq = Uq::Multi(Multi::new(device, scene, split)?);
        let name = part.named(&format!("thesis_multi_{}", split.widths().len()));
        Self::new(device, scene, states, (name, uq, part))
    }

    fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[State],
        (name, uq, part): (String, Uq, Part),
    ) -> Result<Self> {
        let places = places_of_u(scene);
        let update = (part == Part::Whole).then(|| Update::new(device, scene)).transpose()?;
        Ok(Self {
            name,
            uq,
            update,
            u: room(device, 16 * places.1 as u64)?,
            places,
            turns: Turns::new(device, scene, states, |state| [packed_q(scene, state), matrices(scene, state)])?,
            vertices: scene.layout.vertices,
            q_bytes: scene.layout.slots.iter().map(|slot| 4 * slot.rank.next_multiple_of(4) as u64).sum(),
        })
    }
}

impl Trial for Thesis {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn turns(&self) -> usize {
        self.turns.count()
    }

    fn launch(&self, device: &Device, turn: usize) -> Result<()> {
        let (values, u) = (self.turns.start(device, turn), address(device, &self.u));
        match &self.uq {
            Uq::Single(single) => single.launch(device, values.q, u)?,
            Uq::Multi(multi) => multi.launch(device, values.q, u)?,
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
        // SAFETY: the buffer has a float4 for each vertex that has a u.
        unsafe { download(device, address(device, &self.u), &mut u) }?;
        Ok(self.turns.finish_on_host(|domain, vertex| {
            let [x, y, z, _] = places[domain].map_or([0.0; 4], |first| u[first as usize + vertex]);
            [x, y, z]
        }))
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        let mut bytes = match &self.uq {
            Uq::Single(single) => single.bytes(),
            Uq::Multi(multi) => multi.bytes(self.q_bytes),
        };
        bytes.extend(self.update.iter().flat_map(Update::bytes));
        bytes
    }

    fn launches(&self) -> usize {
        let uq = match &self.uq {
            Uq::Single(_) => 1,
            Uq::Multi(multi) => multi.launches(),
        };
        uq + usize::from(self.update.is_some())
    }

    fn kernels(&self) -> Vec<KernelFacts> {
        let mut facts = match &self.uq {
            Uq::Single(single) => vec![single.facts().clone()],
            Uq::Multi(multi) => multi.facts(),
        };
        facts.extend(self.update.iter().map(|update| update.facts().clone()));
        facts
    }
}
