//! Lists the CUDA kernel benchmarks that a workload supports, as variants of the report.

use std::sync::Arc;

use rayon::slice::ParallelSliceMut as _;

use super::error_model::{ErrorModel, ErrorModelCache};
use super::memory_traffic::Operand;
use super::timing::{CacheState, Timing};
use super::variant::{Variant, VariantCandidate, VariantFilter, VariantLabel, make_candidate};
use crate::kernels;
use crate::kernels::{
    ArrayTraffic, BatchMmaBenchmark, BenchmarkStep, CublasBenchmark, CublasMethod, DeformerBenchmark, KernelAttributes,
    KernelBenchmark, KernelSplit, StepOutputs, ThesisBenchmark,
};
use crate::workloads::Workload;
use modalcast_compute::gpu::Device;
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::deform::{Backend, DeformedSurface};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

/// Creates a kernel benchmark of a scene for the given states.
type BenchmarkFactory = Box<dyn Fn(&Device, &Arc<Scene>, &[SceneState]) -> Result<Box<dyn KernelBenchmark>>>;

/// Name suffix of variants that compute only u = U q.
const UQ_SUFFIX: &str = " Uq";
/// Name suffix of variants that are complete steps on a device.
pub(super) const STEP_SUFFIX: &str = " step";
/// Name suffix of the variant that changes one domain in a hundred.
const ONE_PERCENT_CHANGED: &str = ", 1 % changed";
/// Name suffix of the thesis's steps in a scene with vertices that no triangle refers to. The thesis's vertex update
/// writes triangle corners, so it omits these vertices.
pub(super) const TRIANGLE_VERTICES: &str = ", triangle vertices";

/// The parts of a step for which cuBLAS is measured, each with the name suffix of its variant.
const PARTS: [(kernels::StepPart, &str); 2] = [(kernels::StepPart::Uq, UQ_SUFFIX), (kernels::StepPart::Whole, "")];

/// Whether the variant of this name computes only a part of a step. Its time is not comparable with whole steps.
pub(super) fn is_partial_step(name: &str) -> bool {
    [UQ_SUFFIX, ONE_PERCENT_CHANGED, TRIANGLE_VERTICES].iter().any(|ending| name.ends_with(ending))
}

/// Whether the variant of this name does all that the server does for a step: on the CPU a call of the deformer, on a
/// device also the copies of q and T to the device and of bounding boxes to the host.
pub(super) fn is_complete_step(backend: Backend, name: &str) -> bool {
    match backend {
        Backend::Cpu => true,
        Backend::Cuda => name.ends_with(STEP_SUFFIX) || name.contains(&format!("{STEP_SUFFIX},")),
        Backend::Reference => false,
    }
}

/// A kernel benchmark as a variant. [`Variant::prepare`] creates the benchmark, because it needs the states.
struct BenchmarkVariant {
    label: VariantLabel,
    scene: Arc<Scene>,
    error_model: ErrorModel,
    device: Arc<Device>,
    create_benchmark: BenchmarkFactory,
    /// The vertices that the benchmark computes; `None` for all.
    computed_vertices: Option<Vec<u32>>,
    /// Present after [`Variant::prepare`].
    benchmark: Option<Box<dyn KernelBenchmark>>,
    surface: DeformedSurface,
}

/// All kernel benchmarks of a scene as variants: the server's kernels in every storage type, and those kernels of the
/// thesis and of cuBLAS that support the scene.
pub(super) fn kernel_variants(
    device: &Arc<Device>,
    cache: &ErrorModelCache,
    workload: &Workload,
    is_selected: VariantFilter<'_>,
) -> Vec<VariantCandidate> {
    let scene = &workload.scene;
    let candidate_for = |storage: StorageType, outputs: StepOutputs| -> VariantCandidate {
        // The kernel that computes u alone does not support batches.
        let batches = if outputs == StepOutputs::Uq { BatchPolicy::Never } else { workload.batches };
        let suffix = match outputs {
            StepOutputs::Uq => UQ_SUFFIX,
            StepOutputs::Positions => " positions",
            // Positions, normals and tangents.
            StepOutputs::Whole => "",
        };
        let name = format!("cuda {}{suffix}", storage.name());
        let deformation = DeformationSettings { storage, ..scene.deformation };
        StepVariant { name, deformation, batches, outputs }.candidate(device, cache, is_selected)
    };
    let storages: &[StorageType] = if scene.features.modes { &StorageType::ALL } else { &[StorageType::F32] };
    let mut candidates: Vec<VariantCandidate> =
        storages.iter().map(|storage| candidate_for(*storage, StepOutputs::Positions)).collect();
    if has_normals(scene) {
        candidates.extend(storages.iter().map(|storage| candidate_for(*storage, StepOutputs::Whole)));
    }
    for (name, deformation) in with_extra_outputs(scene) {
        let outputs = if has_normals(scene) { StepOutputs::Whole } else { StepOutputs::Positions };
        let variant = StepVariant { name, deformation, batches: workload.batches, outputs };
        candidates.push(variant.candidate(device, cache, is_selected));
    }
    if scene.domains.len() >= MIN_DOMAINS_FOR_ONE_PERCENT {
        candidates.push(one_percent_changed(device, workload, is_selected));
    }
    if scene.features.modes {
        candidates.push(candidate_for(StorageType::F32, StepOutputs::Uq));
        candidates.extend(batch_variants(device, cache, scene, is_selected));
        candidates.extend(thesis_variants(device, scene, is_selected));
        candidates.extend(cublas_variants(device, scene, is_selected));
    }
    candidates
}

/// Deformations with displacements or boxes as an additional output, by name. Empty when the scene already has one of
/// these outputs.
fn with_extra_outputs(scene: &Scene) -> Vec<(String, DeformationSettings)> {
    let default = scene.deformation;
    if default.displacements || default.boxes {
        return Vec::new();
    }
    let with_displacements =
        ("cuda f32, displacements kept".to_owned(), DeformationSettings { displacements: true, ..default });
    let with_boxes = ("cuda f32, boxes kept".to_owned(), DeformationSettings { boxes: true, ..default });
    vec![with_displacements, with_boxes]
}

/// Settings of a variant that times the deformer's kernels on steps that change all domains.
pub(super) struct StepVariant {
    pub name: String,
    pub deformation: DeformationSettings,
    pub batches: BatchPolicy,
    pub outputs: StepOutputs,
}

impl StepVariant {
    pub(super) fn candidate(
        self,
        device: &Arc<Device>,
        cache: &ErrorModelCache,
        is_selected: VariantFilter<'_>,
    ) -> VariantCandidate {
        let Self { name, deformation, batches, outputs } = self;
        make_candidate(is_selected, VariantLabel { name, backend: Backend::Cuda, deformation }, |label| {
            let scene = cache.scene(deformation)?;
            let step = BenchmarkStep { outputs, batches, changed: None };
            let create: BenchmarkFactory = Box::new(move |device, scene, states| {
                Ok(Box::new(DeformerBenchmark::new(device, scene, states, step)?))
            });
            Ok(BenchmarkVariant::with_error_model(label, &scene, device, (cache.error_model(&scene), create)))
        })
    }
}

/// Minimum number of domains for [`one_percent_changed`], so that at least four domains change.
const MIN_DOMAINS_FOR_ONE_PERCENT: usize = 400;

/// A variant whose steps change every hundredth domain.
fn one_percent_changed(device: &Arc<Device>, workload: &Workload, is_selected: VariantFilter<'_>) -> VariantCandidate {
    let (scene, batches) = (&workload.scene, workload.batches);
    let changed_domains: Vec<u32> = (0..scene.domains.len() as u32).step_by(100).collect();
    let label = VariantLabel::new(format!("cuda f32 positions{ONE_PERCENT_CHANGED}"), Backend::Cuda, scene);
    let create: BenchmarkFactory = Box::new(move |device, scene, states| {
        let step = BenchmarkStep { outputs: StepOutputs::Positions, batches, changed: Some(&changed_domains) };
        Ok(Box::new(DeformerBenchmark::new(device, scene, states, step)?))
    });
    make_candidate(is_selected, label, |label| Ok(BenchmarkVariant::new(label, scene, device, create)))
}

/// Variants that multiply one U by the q of all its domains: batched in every storage type, unbatched in f32 for
/// comparison, and by tensor cores where U is stored in 16 bits. Empty unless there are several domains and all share
/// one shape.
fn batch_variants(
    device: &Arc<Device>,
    cache: &ErrorModelCache,
    scene: &Arc<Scene>,
    is_selected: VariantFilter<'_>,
) -> Vec<VariantCandidate> {
    if scene.shapes.len() > 1 || scene.domains.len() < 2 {
        return Vec::new();
    }
    let count = scene.domains.len();
    let positions_candidate = |name: String, storage: StorageType, batches: BatchPolicy| {
        let deformation = DeformationSettings { storage, ..scene.deformation };
        StepVariant { name, deformation, batches, outputs: StepOutputs::Positions }.candidate(
            device,
            cache,
            is_selected,
        )
    };
    let batched = |storage: StorageType| {
        positions_candidate(format!("cuda batch of {count} {}", storage.name()), storage, BatchPolicy::Always)
    };
    let unbatched = positions_candidate(format!("cuda {count} unbatched f32"), StorageType::F32, BatchPolicy::Never);
    let tensor_core = |storage: StorageType| {
        let deformation = DeformationSettings { storage, ..scene.deformation };
        // "mma" marks tensor cores, whose summation order and rounding differ from the deformer's.
        let name = format!("cuda batch of {count} {} mma", storage.name());
        make_candidate(is_selected, VariantLabel { name, backend: Backend::Cuda, deformation }, |label| {
            let scene = cache.scene(deformation)?;
            let create: BenchmarkFactory =
                Box::new(|device, scene, states| Ok(Box::new(BatchMmaBenchmark::new(device, scene, states)?)));
            Ok(BenchmarkVariant::with_error_model(
                label,
                &scene,
                device,
                (cache.error_model(&scene).with_tensor_cores(), create),
            ))
        })
    };
    let deformer_variants = StorageType::ALL.into_iter().map(batched).chain([unbatched]);
    deformer_variants.chain([StorageType::F16, StorageType::Bf16].map(tensor_core)).collect()
}

/// Two variants of each cuBLAS method that supports the scene: u = U q only, and u = U q followed by a separate kernel
/// for x = T (x0 + u).
fn cublas_variants(device: &Arc<Device>, scene: &Arc<Scene>, is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
    let is_instanced = scene.domains.len() > 1 && scene.shapes.len() == 1;
    let supports_scene = |method: &CublasMethod| match method {
        CublasMethod::SgemvColumns | CublasMethod::SgemvRows => scene.domains.len() == 1,
        CublasMethod::Instances => is_instanced,
        _ => scene.domains.len() > 1,
    };
    let candidate = |method: CublasMethod, (part, suffix): (kernels::StepPart, &str)| {
        let label = VariantLabel::new(format!("{}{suffix}", method.name().replace('_', " ")), Backend::Cuda, scene);
        let create: BenchmarkFactory = Box::new(move |device, scene, states| {
            Ok(Box::new(CublasBenchmark::new(device, scene, states, (method, part))?))
        });
        make_candidate(is_selected, label, |label| Ok(BenchmarkVariant::new(label, scene, device, create)))
    };
    let candidates_of = |method: CublasMethod| PARTS.map(|part| candidate(method, part));
    CublasMethod::ALL.into_iter().filter(supports_scene).flat_map(candidates_of).collect()
}

/// The kernels of the thesis. A scene of one domain uses the single-domain kernel. A scene of several domains uses the
/// grouped kernels, which support up to 32 modes, in every split of the domains among 1, 2 or 4 kernels.
fn thesis_variants(device: &Arc<Device>, scene: &Arc<Scene>, is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
    // The Uq kernels compute all vertices; the vertex update computes those of triangles.
    let candidate = |name: String, part: kernels::StepPart, create: BenchmarkFactory| {
        let computed_vertices = (part == kernels::StepPart::Whole).then(|| vertices_of_triangles(scene)).flatten();
        let label = VariantLabel::new(name, Backend::Cuda, scene);
        let make =
            |label| Ok(BenchmarkVariant { computed_vertices, ..BenchmarkVariant::new(label, scene, device, create) });
        make_candidate(is_selected, label, make)
    };
    let single = |(part, suffix): (kernels::StepPart, &str)| {
        let create: BenchmarkFactory =
            Box::new(move |device, scene, states| Ok(Box::new(ThesisBenchmark::single(device, scene, states, part)?)));
        candidate(format!("thesis single{suffix}"), part, create)
    };
    let multi = |split: KernelSplit, (part, suffix): (kernels::StepPart, &str)| {
        let create: BenchmarkFactory = Box::new(move |device, scene, states| {
            Ok(Box::new(ThesisBenchmark::multi(device, scene, states, (split, part))?))
        });
        candidate(format!("thesis {} kernels{suffix}", split.widths().len()), part, create)
    };
    let max_rank = (0..scene.domains.len()).map(|domain| scene.rank_of(domain)).max().unwrap_or(0);
    let parts = thesis_parts(scene);
    match (scene.domains.len(), max_rank) {
        (1, _) => parts.into_iter().map(single).collect(),
        (_, 0..=32) => KernelSplit::ALL
            .into_iter()
            .flat_map(|split| parts.iter().map(move |part| (split, *part)))
            .map(|(split, part)| multi(split, part))
            .collect(),
        _ => Vec::new(),
    }
}

/// The parts of a step for which the kernels of the thesis are measured, each with the name suffix of its variant. A
/// scene whose triangles are placeholders has no vertex update.
fn thesis_parts(scene: &Scene) -> Vec<(kernels::StepPart, &'static str)> {
    let update_suffix = match vertices_of_triangles(scene) {
        None => Some(""),
        Some(_) => has_normals(scene).then_some(TRIANGLE_VERTICES),
    };
    let uq = (kernels::StepPart::Uq, UQ_SUFFIX);
    std::iter::once(uq).chain(update_suffix.map(|suffix| (kernels::StepPart::Whole, suffix))).collect()
}

/// Ascending indices of the vertices that triangles refer to; `None` if these are all vertices.
fn vertices_of_triangles(scene: &Scene) -> Option<Vec<u32>> {
    let mut vertices = scene.triangle_vertices().into_flattened();
    vertices.par_sort_unstable();
    vertices.dedup();
    (vertices.len() < scene.layout.vertices).then_some(vertices)
}

/// Whether the scene has normals to compute. A mesh needs at least one triangle, so a workload that measures only
/// positions has shapes with a placeholder triangle. A shape with more than its three corners has normals to compute.
pub(super) fn has_normals(scene: &Scene) -> bool {
    scene.shapes.iter().any(|shape| shape.mesh.corners().vertices.len() > 3)
}

/// Formula of the memory traffic of an array in bytes, for the report: n vertices and r modes of a domain, d domains.
/// "As packed" means the bytes of the array on the device.
fn traffic_formula(array: &str) -> &'static str {
    match array {
        "U" => "as packed: entries of all modes and vertices, filled up to tiles",
        "q" => "4 x sum r",
        "T" => "48 x d",
        "x0" | "u or x" | "x" => "12 x sum n",
        _ => "as packed",
    }
}

impl BenchmarkVariant {
    /// A variant whose error model follows from the scene.
    fn new(label: VariantLabel, scene: &Arc<Scene>, device: &Arc<Device>, create: BenchmarkFactory) -> Self {
        Self::with_error_model(label, scene, device, (ErrorModel::of(scene), create))
    }

    fn with_error_model(
        label: VariantLabel,
        scene: &Arc<Scene>,
        device: &Arc<Device>,
        (error_model, create): (ErrorModel, BenchmarkFactory),
    ) -> Self {
        let (scene, device) = (Arc::clone(scene), Arc::clone(device));
        Self {
            label,
            scene,
            error_model,
            device,
            create_benchmark: create,
            computed_vertices: None,
            benchmark: None,
            surface: DeformedSurface::default(),
        }
    }

    /// The benchmark that [`Variant::prepare`] created.
    fn benchmark(&self) -> Result<&dyn KernelBenchmark> {
        let unprepared =
            || Error::Fault { stage: "benchmark", reason: format!("{} was not prepared", self.label.name) };
        self.benchmark.as_deref().ok_or_else(unprepared)
    }
}

impl Variant for BenchmarkVariant {
    fn label(&self) -> &VariantLabel {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn error_model(&self) -> &ErrorModel {
        &self.error_model
    }

    fn computed_vertices(&self) -> Option<&[u32]> {
        self.computed_vertices.as_deref()
    }

    fn traffic(&self) -> Vec<Operand> {
        let traffic = self.benchmark.as_ref().map_or_else(Vec::new, |benchmark| benchmark.traffic());
        let operand = |ArrayTraffic { array, bytes }| Operand { name: array, formula: traffic_formula(array), bytes };
        traffic.into_iter().map(operand).collect()
    }

    fn prepare(&mut self, states: &[SceneState]) -> Result<()> {
        self.benchmark = Some((self.create_benchmark)(&self.device, &self.scene, states)?);
        Ok(())
    }

    fn surface(&mut self, state_index: usize, _state: &SceneState) -> Result<&DeformedSurface> {
        let benchmark = self.benchmark()?;
        // A step that changes few domains computes only these. The other domains must also be at this state.
        benchmark.compute_skipped_domains(&self.device, state_index)?;
        benchmark.launch(&self.device, state_index)?;
        self.surface.positions = benchmark.positions(&self.device)?;
        Ok(&self.surface)
    }

    fn time(&mut self, _states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>> {
        kernels::time_steps(&self.device, self.benchmark()?, cache, replays).map(Some)
    }

    fn launches_per_step(&self) -> usize {
        self.benchmark.as_ref().map_or(0, |benchmark| benchmark.launches_per_step())
    }

    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        self.benchmark.as_ref().map_or_else(Vec::new, |benchmark| benchmark.kernel_attributes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::StepPart;
    use crate::workloads::{Size, WorkloadKind};

    #[test]
    fn the_vertex_update_of_the_thesis_is_measured_where_triangles_are_no_placeholders() {
        let parts_of = |kind: WorkloadKind| thesis_parts(&kind.build(Size::Quick).expect("expected a load").scene);
        let uq = (StepPart::Uq, UQ_SUFFIX);
        assert_eq!(parts_of(WorkloadKind::TinyDomains), [uq, (StepPart::Whole, "")]);
        assert_eq!(parts_of(WorkloadKind::Plant(0)), [uq, (StepPart::Whole, TRIANGLE_VERTICES)]);
        assert_eq!(parts_of(WorkloadKind::Batch), [uq]);
    }
}
