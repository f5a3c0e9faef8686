//! The variants (ways to deform a scene) that this machine can run, and the memory bandwidths that they are compared
//! with.

use std::sync::Arc;

use serde::Serialize;

use super::UploadTiming;
use super::cpu_bandwidth::best_read_gbs;
use super::cuda_variants::{self, STEP_SUFFIX, StepVariant};
use super::error_model::ErrorModelCache;
use super::variant::{DeformerVariant, VariantCandidate, VariantFilter, VariantLabel, make_candidate};
use super::workloads::Workload;
use crate::kernels::{self, StepOutputs};
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{Backend, Deformer};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneState, StorageType};

/// Peak memory bandwidths of a backend in 10^9 bytes per second, and its launch overhead, measured in the same run as
/// the variants. `None` where a value was not measured.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MemoryBandwidth {
    /// Fastest copy: bytes read plus bytes written.
    pub copy_gbs: Option<f64>,
    /// Fastest pure read of several kernels, from memory, not from a cache.
    pub read_gbs: Option<f64>,
    /// Launch overhead: replay of a graph with one empty kernel, microseconds.
    pub empty_us: Option<f64>,
    /// Copies from pinned host memory to the device.
    pub pinned_h2d_gbs: Option<f64>,
    /// Copies from the device to pinned host memory.
    pub pinned_d2h_gbs: Option<f64>,
}

/// Creates the variants of a machine and measures its bandwidths. Tests implement it without hardware.
pub trait BenchTarget {
    /// The variants of a workload. `is_selected` takes a variant's name; a variant that it rejects need not be created.
    fn variants(&self, workload: &Workload, is_selected: VariantFilter<'_>) -> Vec<VariantCandidate>;

    /// Peak memory bandwidth of a backend.
    fn memory_bandwidth(&self, _backend: Backend) -> MemoryBandwidth {
        MemoryBandwidth::default()
    }

    /// Times the upload of a step's values to the device; `None` without a device.
    fn time_upload(&self, _workload: &Workload, _replays: usize) -> Option<UploadTiming> {
        None
    }

    /// Times steps with readback of the vertices, serially and overlapped. `None` without a device.
    ///
    /// # Errors
    /// Those of [`kernels::measure_overlap`].
    fn measure_overlap(
        &self,
        _workload: &Workload,
        _states: &[SceneState],
        _steps: usize,
    ) -> Option<Result<kernels::Overlap>> {
        None
    }

    /// Times of host writes into the pinned memory that is uploaded to the CUDA device; empty without a device.
    fn time_host_writes(&self, _replays: usize) -> Vec<kernels::HostWrite> {
        Vec::new()
    }

    /// Capabilities that this target lacks, each with the reason.
    fn remarks(&self) -> Vec<String> {
        Vec::new()
    }
}

/// A deformer, or the reason why it could not be created.
type DeformerResult = Result<Box<dyn Deformer>>;

/// Maximum count of numbers in U and x0 for which the reference is measured. On larger scenes, the single-threaded
/// reference would take minutes.
const MAX_REFERENCE_NUMBERS: usize = 1 << 23;

/// The variants of this machine: those of the CPU, of the slow f64 reference, and of CUDA if a device opens.
#[derive(Debug)]
pub struct LocalMachine {
    /// The CUDA device, or the reason why it could not be opened.
    device: Result<Arc<Device>>,
    cuda_bandwidth: MemoryBandwidth,
    cpu_bandwidth: MemoryBandwidth,
}

impl LocalMachine {
    /// Opens the first CUDA device, if it exists and NVRTC works, and measures the memory bandwidths of device and CPU.
    pub fn open() -> Self {
        let measure_device = |device: Arc<Device>| {
            device.check_compiler()?;
            let kernels::DeviceBandwidth { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs } =
                kernels::measure_bandwidth(&device)?;
            let [copy_gbs, read_gbs, empty_us] = [copy_gbs, read_gbs, empty_us].map(Some);
            let [pinned_h2d_gbs, pinned_d2h_gbs] = [pinned_h2d_gbs, pinned_d2h_gbs].map(Some);
            Ok((device, MemoryBandwidth { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs }))
        };
        let cpu_bandwidth = MemoryBandwidth { read_gbs: Some(best_read_gbs()), ..MemoryBandwidth::default() };
        match Device::open(0).and_then(measure_device) {
            Ok((device, cuda_bandwidth)) => Self { device: Ok(device), cuda_bandwidth, cpu_bandwidth },
            Err(error) => Self { device: Err(error), cuda_bandwidth: MemoryBandwidth::default(), cpu_bandwidth },
        }
    }
}

impl BenchTarget for LocalMachine {
    fn variants(&self, workload: &Workload, is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
        let scene = &workload.scene;
        let cache = ErrorModelCache::new(scene);
        let candidate = |name: &str,
                         backend: Backend,
                         deformation: DeformationSettings,
                         create: &dyn Fn(&Arc<Scene>) -> DeformerResult| {
            let label = VariantLabel { name: name.into(), backend, deformation };
            make_candidate(is_selected, label, |label| {
                let scene = cache.scene(deformation)?;
                Ok(DeformerVariant::with_error_model(label, &scene, cache.error_model(&scene), create(&scene)?))
            })
        };
        let cpu = |scene: &Arc<Scene>| -> DeformerResult { Ok(Box::new(CpuDeformer::new(scene))) };
        let reference = |scene: &Arc<Scene>| -> DeformerResult { Ok(Box::new(ReferenceDeformer::new(scene))) };
        let mut candidates = vec![candidate("cpu f32", Backend::Cpu, scene.deformation, &cpu)];
        for (name, deformation) in alternative_deformations(scene) {
            candidates.push(candidate(&format!("cpu {name}"), Backend::Cpu, deformation, &cpu));
        }
        if count_rest_and_mode_numbers(scene) <= MAX_REFERENCE_NUMBERS {
            candidates.push(candidate("reference f64", Backend::Reference, scene.deformation, &reference));
        }
        if let Ok(device) = &self.device {
            // A complete step of the server: upload of q and T, kernels, readback of the bounding boxes.
            let cuda = |scene: &Arc<Scene>| -> DeformerResult {
                let options = CudaDeformerOptions { batches: workload.batches, bounding_axes: scene.light_axes() };
                let no_gl_buffers = None;
                Ok(Box::new(CudaDeformer::new(device, scene, no_gl_buffers, options)?))
            };
            candidates.push(candidate("cuda f32 step", Backend::Cuda, scene.deformation, &cuda));
            if let Some(exact) = exact_normals(scene) {
                candidates.push(candidate("cuda f32 step, exact normals", Backend::Cuda, exact, &cuda));
            }
            // The alternative with exact normals is added above.
            for (name, deformation) in alternative_deformations(scene)
                .into_iter()
                .filter(|(_, deformation)| deformation.normals == scene.deformation.normals)
            {
                candidates.push(candidate(&format!("cuda {name}{STEP_SUFFIX}"), Backend::Cuda, deformation, &cuda));
                // `kernel_variants` adds the kernels of other storage types.
                if !deformation.compensated {
                    continue;
                }
                let variant = StepVariant {
                    name: format!("cuda {name} positions"),
                    deformation,
                    batches: workload.batches,
                    outputs: StepOutputs::Positions,
                };
                candidates.push(variant.candidate(device, &cache, is_selected));
            }
            candidates.extend(cuda_variants::kernel_variants(device, &cache, workload, is_selected));
        }
        candidates
    }

    fn memory_bandwidth(&self, backend: Backend) -> MemoryBandwidth {
        if backend == Backend::Cuda { self.cuda_bandwidth } else { self.cpu_bandwidth }
    }

    fn time_upload(&self, workload: &Workload, replays: usize) -> Option<UploadTiming> {
        let device = self.device.as_ref().ok()?;
        let (bytes, timing) =
            kernels::time_upload(device, &workload.scene, &SceneState::rest(&workload.scene), replays).ok()?;
        // 1 GB/s is 1e3 bytes per microsecond.
        let pinned_copy_us = bytes as f64 / (1e3 * self.cuda_bandwidth.pinned_h2d_gbs?);
        Some(UploadTiming { bytes, median_us: timing.median_us, of_pinned: timing.median_us / pinned_copy_us })
    }

    fn measure_overlap(
        &self,
        workload: &Workload,
        states: &[SceneState],
        steps: usize,
    ) -> Option<Result<kernels::Overlap>> {
        Some(kernels::measure_overlap(self.device.as_ref().ok()?, workload, states, steps))
    }

    fn time_host_writes(&self, replays: usize) -> Vec<kernels::HostWrite> {
        let time_writes = |device: &Arc<Device>| kernels::time_host_writes(device, replays).ok();
        self.device.as_ref().ok().and_then(time_writes).unwrap_or_default()
    }

    fn remarks(&self) -> Vec<String> {
        let explain = |error: &Error| format!("no CUDA variants: {error}");
        self.device.as_ref().err().map(explain).into_iter().collect()
    }
}

/// Deformations to measure in addition to the scene's own, by name: other storage types, compensated summation and
/// exact normals. Empty when the scene has no modes, or sets a deformation other than the default.
fn alternative_deformations(scene: &Scene) -> Vec<(String, DeformationSettings)> {
    let default = scene.deformation;
    if !scene.features.modes || default != DeformationSettings::default() {
        return Vec::new();
    }
    let with_storage =
        |storage: &StorageType| (storage.name().to_owned(), DeformationSettings { storage: *storage, ..default });
    let compensated = ("f32 compensated".to_owned(), DeformationSettings { compensated: true, ..default });
    let exact = exact_normals(scene).map(|exact| ("f32 exact normals".to_owned(), exact));
    // The first storage type is f32, the default.
    let stored = StorageType::ALL[1..].iter().map(with_storage);
    stored.chain([compensated]).chain(exact).collect()
}

/// The scene's deformation with exact instead of rigid normals. `None` when the scene has no modes, no normals, or
/// already exact normals.
fn exact_normals(scene: &Scene) -> Option<DeformationSettings> {
    let has_rigid_normals =
        scene.features.modes && cuda_variants::has_normals(scene) && scene.deformation.normals == NormalMethod::Rigid;
    has_rigid_normals.then_some(DeformationSettings { normals: NormalMethod::Exact, ..scene.deformation })
}

/// Count of numbers in U and x0 of all domains: x0 and each mode have three numbers per vertex.
fn count_rest_and_mode_numbers(scene: &Scene) -> usize {
    scene.layout.domains.iter().map(|domain_layout| 3 * domain_layout.vertices * (1 + domain_layout.rank)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workloads::{Size, WorkloadKind};

    #[test]
    fn offers_cpu_variants_and_explains_missing_cuda() {
        let machine = LocalMachine::open();
        let workload = WorkloadKind::TinyDomains.build(Size::Quick).expect("expected a workload");
        let names: Vec<String> =
            machine.variants(&workload, &|_| true).into_iter().map(|(label, _)| label.name).collect();
        for name in ["cpu f32", "cpu f16", "cpu int8", "cpu f32 compensated", "cpu f32 exact normals", "reference f64"]
        {
            assert!(names.iter().any(|variant_name| variant_name == name), "{name} is not among {names:?}");
        }
        assert!(machine.memory_bandwidth(Backend::Cpu).read_gbs.is_some_and(|rate| rate > 0.0));
        // There is a remark if and only if there is no CUDA variant.
        assert_eq!(machine.remarks().is_empty(), names.iter().any(|name| name.starts_with("cuda")));
        let remarks = machine.remarks();
        assert!(remarks.iter().all(|remark| remark.starts_with("no CUDA variants: ")), "{remarks:?}");
    }

    #[test]
    fn skips_reference_on_large_scenes() {
        // 20 modes and x0 have 21 x 3 x 2^18 = 16.5 M numbers, more than MAX_REFERENCE_NUMBERS = 8.4 M.
        let workload = WorkloadKind::Single { power: 18, rank: 20 }.build(Size::Full).expect("expected a workload");
        assert!(
            LocalMachine::open().variants(&workload, &|_| true).iter().all(|(label, _)| label.name != "reference f64")
        );
    }
}
