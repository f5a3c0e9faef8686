//! Which variants this machine has, and the rates that they are held against.

use std::sync::Arc;

use serde::Serialize;

use super::loads::Load;
use super::variant::{Driven, Label, Variant};
use crate::cpu::CpuDeformer;
use crate::deform::Backend;
use crate::error::{Error, Result};
use crate::gpu::{CudaDeformer, Device};
use crate::reference::ReferenceDeformer;
use crate::scene::Scene;

/// Rates measured in the same run, in 10^9 bytes a second; `None` where nothing measured them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Roofs {
    /// The best copy, bytes read and written.
    pub copy_gbs: Option<f64>,
    /// The best pure read.
    pub read_gbs: Option<f64>,
}

/// A variant, or why it could not be made.
pub type Offer = (Label, Result<Box<dyn Variant>>);

/// What can be measured.
pub trait Bench {
    /// The variants for a load.
    fn variants(&self, load: &Load) -> Vec<Offer>;

    /// The rates of a backend's memory.
    fn roofs(&self, _backend: Backend) -> Roofs {
        Roofs::default()
    }

    /// What is missing here and why, in words.
    fn remarks(&self) -> Vec<String> {
        Vec::new()
    }
}

/// Entries of U and x0 above which the reference is left out: its single thread would take minutes.
const MOST_OF_REFERENCE: usize = 1 << 23;

/// The deformers of this machine: CPU, the reference as its slow peer, and CUDA if a device opens.
#[derive(Debug)]
pub struct Machine {
    device: Result<Arc<Device>>,
}

impl Machine {
    /// Looks for a CUDA device and a compiler that fits it.
    pub fn open() -> Self {
        let usable = |device: Arc<Device>| device.check_compiler().map(|()| device);
        Self { device: Device::open(0).and_then(usable) }
    }
}

impl Bench for Machine {
    fn variants(&self, load: &Load) -> Vec<Offer> {
        let scene = &load.scene;
        let cpu = Label::new("cpu f32", Backend::Cpu, scene);
        let mut offers = vec![offer(cpu, |label| Ok(Driven::new(label, scene, CpuDeformer::new(scene))))];
        if entries(scene) <= MOST_OF_REFERENCE {
            let reference = Label::new("reference f64", Backend::Reference, scene);
            offers.push(offer(reference, |label| Ok(Driven::new(label, scene, ReferenceDeformer::new(scene)))));
        }
        if let Ok(device) = &self.device {
            offers.extend(cuda(device, scene));
        }
        offers
    }

    fn remarks(&self) -> Vec<String> {
        let missing = |error: &Error| format!("no CUDA variants: {error}");
        self.device.as_ref().err().map(missing).into_iter().collect()
    }
}

/// The CUDA variants of a scene.
fn cuda(device: &Arc<Device>, scene: &Arc<Scene>) -> Vec<Offer> {
    // A whole step as the server makes it: q and T to the device, kernels, bounds back.
    let step = Label::new("cuda f32 step", Backend::Cuda, scene);
    vec![offer(step, |label| Ok(Driven::new(label, scene, CudaDeformer::new(device, scene, None)?)))]
}

/// Makes a variant, or keeps why it could not be made.
pub fn offer<V: Variant + 'static>(label: Label, make: impl FnOnce(Label) -> Result<V>) -> Offer {
    (label.clone(), make(label).map(|variant| Box::new(variant) as Box<dyn Variant>))
}

fn entries(scene: &Scene) -> usize {
    scene.layout.slots.iter().map(|slot| 3 * slot.vertices * (1 + slot.rank)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::loads::{Kind, Size};

    #[test]
    fn every_machine_offers_the_cpu_and_says_why_it_has_no_cuda() {
        let machine = Machine::open();
        let load = Kind::C.build(Size::Quick).expect("built");
        let names: Vec<String> = machine.variants(&load).into_iter().map(|(label, _)| label.name).collect();
        assert!(names.starts_with(&["cpu f32".into(), "reference f64".into()]), "{names:?}");
        assert_eq!(machine.remarks().is_empty(), names.iter().any(|name| name.starts_with("cuda")));
        let remarks = machine.remarks();
        assert!(remarks.iter().all(|remark| remark.starts_with("no CUDA variants: ")), "{remarks:?}");
    }

    #[test]
    fn the_reference_is_left_out_where_it_would_take_minutes() {
        let large = Kind::Single { power: 18, rank: 20 }.build(Size::Full).expect("built");
        assert!(Machine::open().variants(&large).iter().all(|(label, _)| label.name != "reference f64"));
    }
}
