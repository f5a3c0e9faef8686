//! The variants that this machine can run, and the memory rates that they are compared with.

use std::sync::Arc;

use serde::Serialize;

use super::UploadTiming;
use super::cuda_variants::{self, StepVariant};
use super::error_model::ErrorModelCache;
use super::variant::{DeformerVariant, VariantCandidate, VariantFilter, VariantLabel, make_candidate};
use super::workloads::Workload;
use crate::kernels::{self, StepOutputs};
use modalcast_compute::cpu::{CpuDeformer, read_bandwidth};
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{Backend, Deformer};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneState, StorageType};

/// Memory rates measured in the same run, in 10^9 bytes per second; `None` where they were not measured.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MemoryBandwidth {
    /// Best copy rate: bytes read plus bytes written.
    pub copy_gbs: Option<f64>,
    /// Best rate of a pure read.
    pub read_gbs: Option<f64>,
    /// Replay of a graph with one empty kernel, microseconds.
    pub empty_us: Option<f64>,
    /// Copies from page-locked host memory to the device.
    pub pinned_h2d_gbs: Option<f64>,
    pub pinned_d2h_gbs: Option<f64>,
}

/// Source of variants and of reference rates; the tests have one of their own.
pub trait BenchTarget {
    /// The variants for a load. A variant that `wanted` rejects need not be created.
    fn variants(&self, load: &Workload, wanted: VariantFilter<'_>) -> Vec<VariantCandidate>;

    /// Memory rates of a backend.
    fn roofs(&self, _backend: Backend) -> MemoryBandwidth {
        MemoryBandwidth::default()
    }

    /// Upload of a step's values to the device; `None` without a device.
    fn ingest(&self, _load: &Workload, _replays: usize) -> Option<UploadTiming> {
        None
    }

    /// Runs steps with readback of the vertices, serially and overlapped. `None` without a device; the error is that of
    /// a failed run.
    fn overlap(&self, _load: &Workload, _states: &[SceneState], _steps: usize) -> Option<Result<kernels::Overlap>> {
        None
    }

    /// Rates at which this machine's cores write the memory that is uploaded to the CUDA device.
    fn host_writes(&self, _replays: usize) -> Vec<kernels::HostWrite> {
        Vec::new()
    }

    /// Missing capabilities and the reasons, for the reader.
    fn remarks(&self) -> Vec<String> {
        Vec::new()
    }
}

/// A deformer, or the reason why it could not be created.
type Made = Result<Box<dyn Deformer>>;

/// Scenes with more entries of U and x0 than this skip the reference: its single thread would take minutes.
const MOST_OF_REFERENCE: usize = 1 << 23;

/// The deformers of this machine: the CPU, the slow f64 reference, and CUDA if a device opens.
#[derive(Debug)]
pub struct LocalMachine {
    device: Result<Arc<Device>>,
    cuda: MemoryBandwidth,
    cpu: MemoryBandwidth,
}

/// Bytes over which the read rate of all cores is measured: more than the caches of any one socket hold.
const READ: usize = 1 << 29;
const READS: usize = 5;

impl LocalMachine {
    /// Looks for a CUDA device with a working compiler, and measures the memory rates of device and CPU.
    pub fn open() -> Self {
        let usable = |device: Arc<Device>| {
            device.check_compiler()?;
            let kernels::Roofs { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs } =
                kernels::roofs(&device)?;
            let [copy_gbs, read_gbs, empty_us] = [copy_gbs, read_gbs, empty_us].map(Some);
            let [pinned_h2d_gbs, pinned_d2h_gbs] = [pinned_h2d_gbs, pinned_d2h_gbs].map(Some);
            Ok((device, MemoryBandwidth { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs }))
        };
        let cpu = MemoryBandwidth { read_gbs: Some(read_bandwidth(READ, READS)), ..MemoryBandwidth::default() };
        match Device::open(0).and_then(usable) {
            Ok((device, cuda)) => Self { device: Ok(device), cuda, cpu },
            Err(error) => Self { device: Err(error), cuda: MemoryBandwidth::default(), cpu },
        }
    }
}

impl BenchTarget for LocalMachine {
    fn variants(&self, load: &Workload, wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
        let scene = &load.scene;
        let stock = ErrorModelCache::new(scene);
        let driven =
            |name: &str, backend: Backend, deformation: DeformationSettings, make: &dyn Fn(&Arc<Scene>) -> Made| {
                let label = VariantLabel { name: name.into(), backend, deformation };
                make_candidate(wanted, label, |label| {
                    let scene = stock.scene(deformation)?;
                    Ok(DeformerVariant::with_error_model(label, &scene, stock.error_model(&scene), make(&scene)?))
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
            // A whole step as the server runs it: upload of q and T, kernels, readback of the bounds.
            let cuda = |scene: &Arc<Scene>| -> Made {
                let options = CudaDeformerOptions { batches: load.batches, bounding_axes: scene.light_axes() };
                Ok(Box::new(CudaDeformer::new(device, scene, None, options)?))
            };
            offers.push(driven("cuda f32 step", Backend::Cuda, plain, &cuda));
            if let Some(exact) = exact_normals(scene) {
                offers.push(driven("cuda f32 step, exact normals", Backend::Cuda, exact, &cuda));
            }
            for (name, short) in shortcuts(scene).into_iter().filter(|(_, short)| cuda_variants::needs_other_sum(short))
            {
                offers.push(driven(&format!("cuda {name} step"), Backend::Cuda, short, &cuda));
                let variant = StepVariant {
                    name: format!("cuda {name} positions"),
                    deformation: short,
                    batches: load.batches,
                    outputs: StepOutputs::Positions,
                };
                offers.push(variant.candidate(device, &stock, wanted));
            }
            offers.extend(cuda_variants::kernel_variants(device, &stock, load, wanted));
        }
        offers
    }

    fn roofs(&self, backend: Backend) -> MemoryBandwidth {
        if backend == Backend::Cuda { self.cuda } else { self.cpu }
    }

    fn ingest(&self, load: &Workload, replays: usize) -> Option<UploadTiming> {
        let device = self.device.as_ref().ok()?;
        let (bytes, timing) =
            kernels::time_upload(device, &load.scene, &SceneState::rest(&load.scene), replays).ok()?;
        let expected = bytes as f64 / (1e3 * self.cuda.pinned_h2d_gbs?);
        Some(UploadTiming { bytes, median_us: timing.median_us, of_pinned: timing.median_us / expected })
    }

    fn overlap(&self, load: &Workload, states: &[SceneState], steps: usize) -> Option<Result<kernels::Overlap>> {
        Some(kernels::overlap(self.device.as_ref().ok()?, load, states, steps))
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

/// Error budgets of mode truncation, as fractions of the scene's diagonal.
const BUDGETS: [(&str, f64); 3] = [("1e-6", 1e-6), ("1e-5", 1e-5), ("1e-4", 1e-4)];

/// The approximate or compensated deformations that a scene with modes can choose, by name; empty when the scene itself
/// already chooses.
fn shortcuts(scene: &Scene) -> Vec<(String, DeformationSettings)> {
    let plain = scene.deformation;
    if !scene.features.modes || plain != DeformationSettings::default() {
        return Vec::new();
    }
    let diagonal = scene.unit * scene.rest_bounds.diagonal();
    let store = |storage: &StorageType| (storage.name().to_owned(), DeformationSettings { storage: *storage, ..plain });
    let truncate = |(name, share): &(&str, f64)| {
        (format!("f32 truncated {name}"), DeformationSettings { truncation: Some(share * diagonal), ..plain })
    };
    let compensated = ("f32 compensated".to_owned(), DeformationSettings { compensated: true, ..plain });
    let exact = exact_normals(scene).map(|exact| ("f32 exact normals".to_owned(), exact));
    let stored = StorageType::ALL[1..].iter().map(store);
    stored.chain(BUDGETS.iter().map(truncate)).chain([compensated]).chain(exact).collect()
}

/// The deformation with exact normals of the deformed surface, for scenes with modes and normals that use rigid
/// normals.
fn exact_normals(scene: &Scene) -> Option<DeformationSettings> {
    let rigid =
        scene.features.modes && cuda_variants::has_normals(scene) && scene.deformation.normals == NormalMethod::Rigid;
    rigid.then_some(DeformationSettings { normals: NormalMethod::Exact, ..scene.deformation })
}

fn entries(scene: &Scene) -> usize {
    scene.layout.domains.iter().map(|slot| 3 * slot.vertices * (1 + slot.rank)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workloads::{Size, WorkloadKind};

    #[test]
    fn offers_cpu_variants_and_explains_missing_cuda() {
        let provenance = LocalMachine::open();
        let load = WorkloadKind::TinyDomains.build(Size::Quick).expect("built");
        let names: Vec<String> =
            provenance.variants(&load, &|_| true).into_iter().map(|(label, _)| label.name).collect();
        for name in
            ["cpu f32", "cpu f16", "cpu int8", "cpu f32 truncated 1e-5", "cpu f32 exact normals", "reference f64"]
        {
            assert!(names.iter().any(|own| own == name), "{name} is not among {names:?}");
        }
        assert!(provenance.roofs(Backend::Cpu).read_gbs.is_some_and(|rate| rate > 0.0));
        assert_eq!(provenance.remarks().is_empty(), names.iter().any(|name| name.starts_with("cuda")));
        let remarks = provenance.remarks();
        assert!(remarks.iter().all(|remark| remark.starts_with("no CUDA variants: ")), "{remarks:?}");
    }

    #[test]
    fn skips_reference_on_large_scenes() {
        let large = WorkloadKind::Single { power: 18, rank: 20 }.build(Size::Full).expect("built");
        assert!(
            LocalMachine::open().variants(&large, &|_| true).iter().all(|(label, _)| label.name != "reference f64")
        );
    }
}
