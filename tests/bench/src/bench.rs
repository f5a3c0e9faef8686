//! Which variants this machine has, and the rates that they are held against.

use std::sync::Arc;

use serde::Serialize;

use super::Ingest;
use super::ingredients::Stock;
use super::loads::Load;
use super::offers;
use super::variant::{Driven, Label, Variant};
use crate::kernels;
use modalcast_compute::cpu::{CpuDeformer, read_rate};
use modalcast_compute::gpu::{CudaDeformer, Device};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{Backend, Deformer};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Deformation, Normals, Scene, State, Storage};

/// Rates measured in the same run, in 10^9 bytes a second; `None` where nothing measured them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Roofs {
    /// The best copy, bytes read and written.
    pub copy_gbs: Option<f64>,
    /// The best pure read.
    pub read_gbs: Option<f64>,
    /// A graph that does nothing, microseconds.
    pub empty_us: Option<f64>,
    /// Copies from page-locked host memory and back.
    pub pinned_h2d_gbs: Option<f64>,
    pub pinned_d2h_gbs: Option<f64>,
}

/// Whether a variant of that name is asked for.
pub type Wanted<'a> = &'a dyn Fn(&str) -> bool;

/// A variant, or why it could not be made.
pub type Offer = (Label, Result<Box<dyn Variant>>);

/// What can be measured.
pub trait Bench {
    /// The variants for a load; those that are not wanted need not be made.
    fn variants(&self, load: &Load, wanted: Wanted<'_>) -> Vec<Offer>;

    /// The rates of a backend's memory.
    fn roofs(&self, _backend: Backend) -> Roofs {
        Roofs::default()
    }

    /// How long a step's values take to the device.
    fn ingest(&self, _load: &Load, _replays: usize) -> Option<Ingest> {
        None
    }

    /// Steps whose vertices the host reads, one after the other and side by side; an error says why there is no answer.
    fn overlap(&self, _load: &Load, _states: &[State], _steps: usize) -> Option<Result<kernels::Overlap>> {
        None
    }

    /// How fast this machine's cores write what goes to the CUDA device.
    fn host_writes(&self, _replays: usize) -> Vec<kernels::HostWrite> {
        Vec::new()
    }

    /// What is missing here and why, in words.
    fn remarks(&self) -> Vec<String> {
        Vec::new()
    }
}

/// A deformer, or why it could not be made.
type Made = Result<Box<dyn Deformer>>;

/// Entries of U and x0 above which the reference is left out: its single thread would take minutes.
const MOST_OF_REFERENCE: usize = 1 << 23;

/// The deformers of this machine: CPU, the reference as its slow peer, and CUDA if a device opens.
#[derive(Debug)]
pub struct Machine {
    device: Result<Arc<Device>>,
    cuda: Roofs,
    cpu: Roofs,
}

/// What the read rate of all cores is measured on: larger than the caches of any one socket.
const READ: usize = 1 << 29;
const READS: usize = 5;

impl Machine {
    /// Looks for a CUDA device and a compiler that fits it, and measures what the memory of device and CPU can do.
    pub fn open() -> Self {
        let usable = |device: Arc<Device>| {
            device.check_compiler()?;
            let kernels::Roofs { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs } =
                kernels::roofs(&device)?;
            let [copy_gbs, read_gbs, empty_us] = [copy_gbs, read_gbs, empty_us].map(Some);
            let [pinned_h2d_gbs, pinned_d2h_gbs] = [pinned_h2d_gbs, pinned_d2h_gbs].map(Some);
            Ok((device, Roofs { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs }))
        };
        let cpu = Roofs { read_gbs: Some(read_rate(READ, READS)), ..Roofs::default() };
        match Device::open(0).and_then(usable) {
            Ok((device, cuda)) => Self { device: Ok(device), cuda, cpu },
            Err(error) => Self { device: Err(error), cuda: Roofs::default(), cpu },
        }
    }
}

impl Bench for Machine {
    fn variants(&self, load: &Load, wanted: Wanted<'_>) -> Vec<Offer> {
        let scene = &load.scene;
        let stock = Stock::new(scene);
        let driven = |name: &str, backend: Backend, deformation: Deformation, make: &dyn Fn(&Arc<Scene>) -> Made| {
            let label = Label { name: name.into(), backend, deformation };
            offer(wanted, label, |label| {
                let scene = stock.scene(deformation)?;
                Ok(Driven::sharing(label, &scene, stock.ingredients(&scene), make(&scene)?))
            })
        };
        let cpu = |scene: &Arc<Scene>| -> Made { Ok(Box::new(CpuDeformer::new(scene))) };
        let reference = |scene: &Arc<Scene>| -> Made { Ok(Box::new(ReferenceDeformer::new(scene))) };
        let plain = scene.deformation;
        let mut offers = vec![driven("cpu f32", Backend::Cpu, plain, &cpu)];
        for (name, short) in shortcuts(scene) {
            offers.push(driven(&format!("cpu {name}"), Backend::Cpu, short, &cpu));
        }
        if entries(scene) <= MOST_OF_REFERENCE {
            offers.push(driven("reference f64", Backend::Reference, plain, &reference));
        }
        if let Ok(device) = &self.device {
            // A whole step as the server makes it: q and T to the device, kernels, bounds back.
            let cuda = |scene: &Arc<Scene>| -> Made { Ok(Box::new(CudaDeformer::new(device, scene, None)?)) };
            offers.push(driven("cuda f32 step", Backend::Cuda, plain, &cuda));
            if let Some(exact) = exact_normals(scene) {
                offers.push(driven("cuda f32 step, exact normals", Backend::Cuda, exact, &cuda));
            }
            for (name, short) in shortcuts(scene).into_iter().filter(|(_, short)| offers::is_summed_otherwise(short)) {
                offers.push(driven(&format!("cuda {name} step"), Backend::Cuda, short, &cuda));
                offers.push(offers::positions(device, &stock, wanted, (format!("cuda {name} positions"), short)));
            }
            offers.extend(offers::trials(device, &stock, scene, wanted));
        }
        offers
    }

    fn roofs(&self, backend: Backend) -> Roofs {
        if backend == Backend::Cuda { self.cuda } else { self.cpu }
    }

    fn ingest(&self, load: &Load, replays: usize) -> Option<Ingest> {
        let device = self.device.as_ref().ok()?;
        let (bytes, timing) = kernels::ingest(device, &load.scene, &State::rest(&load.scene), replays).ok()?;
        let expected = bytes as f64 / (1e3 * self.cuda.pinned_h2d_gbs?);
        Some(Ingest { bytes, median_us: timing.median_us, of_pinned: timing.median_us / expected })
    }

    fn overlap(&self, load: &Load, states: &[State], steps: usize) -> Option<Result<kernels::Overlap>> {
        Some(kernels::overlap(self.device.as_ref().ok()?, &load.scene, states, steps))
    }

    fn host_writes(&self, replays: usize) -> Vec<kernels::HostWrite> {
        let writes = |device: &Arc<Device>| kernels::host_writes(device, replays).ok();
        self.device.as_ref().ok().and_then(writes).unwrap_or_default()
    }

    fn remarks(&self) -> Vec<String> {
        let missing = |error: &Error| format!("no CUDA variants: {error}");
        self.device.as_ref().err().map(missing).into_iter().collect()
    }
}

/// Budgets of mode truncation, as shares of the scene's diagonal.
const BUDGETS: [(&str, f64); 3] = [("1e-6", 1e-6), ("1e-5", 1e-5), ("1e-4", 1e-4)];

/// The choices between error and time that a scene of modes has, by name.
fn shortcuts(scene: &Scene) -> Vec<(String, Deformation)> {
    let plain = scene.deformation;
    if !scene.needs.modes || plain != Deformation::default() {
        return Vec::new();
    }
    let diagonal = scene.unit * scene.rest_bounds.diagonal();
    let store = |storage: &Storage| (storage.name().to_owned(), Deformation { storage: *storage, ..plain });
    let truncate = |(name, share): &(&str, f64)| {
        (format!("f32 truncated {name}"), Deformation { truncation: Some(share * diagonal), ..plain })
    };
    let compensated = ("f32 compensated".to_owned(), Deformation { compensated: true, ..plain });
    let exact = exact_normals(scene).map(|exact| ("f32 exact normals".to_owned(), exact));
    let stored = Storage::ALL[1..].iter().map(store);
    stored.chain(BUDGETS.iter().map(truncate)).chain([compensated]).chain(exact).collect()
}

/// The deformation with normals of the deformed surface, where that bends, has normals and is given rigid ones.
fn exact_normals(scene: &Scene) -> Option<Deformation> {
    let rigid = scene.needs.modes && offers::has_normals(scene) && scene.deformation.normals == Normals::Rigid;
    rigid.then_some(Deformation { normals: Normals::Exact, ..scene.deformation })
}

/// Makes a variant if it is wanted, or keeps why it could not be made.
pub fn offer<V: Variant + 'static>(wanted: Wanted<'_>, label: Label, make: impl FnOnce(Label) -> Result<V>) -> Offer {
    if !wanted(&label.name) {
        let given = label.name.clone();
        return (label, Err(Error::NotFound { what: "variant that is asked for", given }));
    }
    (label.clone(), make(label).map(|variant| Box::new(variant) as Box<dyn Variant>))
}

fn entries(scene: &Scene) -> usize {
    scene.layout.slots.iter().map(|slot| 3 * slot.vertices * (1 + slot.rank)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loads::{Kind, Size};

    #[test]
    fn every_machine_offers_the_cpu_and_says_why_it_has_no_cuda() {
        let machine = Machine::open();
        let load = Kind::C.build(Size::Quick).expect("built");
        let names: Vec<String> = machine.variants(&load, &|_| true).into_iter().map(|(label, _)| label.name).collect();
        for name in
            ["cpu f32", "cpu f16", "cpu int8", "cpu f32 truncated 1e-5", "cpu f32 exact normals", "reference f64"]
        {
            assert!(names.iter().any(|own| own == name), "{name} is not among {names:?}");
        }
        assert!(machine.roofs(Backend::Cpu).read_gbs.is_some_and(|rate| rate > 0.0));
        assert_eq!(machine.remarks().is_empty(), names.iter().any(|name| name.starts_with("cuda")));
        let remarks = machine.remarks();
        assert!(remarks.iter().all(|remark| remark.starts_with("no CUDA variants: ")), "{remarks:?}");
    }

    #[test]
    fn the_reference_is_left_out_where_it_would_take_minutes() {
        let large = Kind::Single { power: 18, rank: 20 }.build(Size::Full).expect("built");
        assert!(Machine::open().variants(&large, &|_| true).iter().all(|(label, _)| label.name != "reference f64"));
    }
}
