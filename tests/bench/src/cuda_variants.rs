//! CUDA benchmark kernels as variants, and the selection of variants for a load.

use std::sync::Arc;

use super::error_model::{ErrorModel, ErrorModelCache};
use super::memory_traffic::Operand;
use super::timing::{CacheState, Timing};
use super::variant::{Variant, VariantCandidate, VariantFilter, VariantLabel, make_candidate};
use crate::kernels;
use crate::kernels::{
    BatchMmaBenchmark, CublasBenchmark, CublasMethod, DeformerBenchmark, KernelAttributes, KernelBenchmark,
    KernelSplit, StepOutputs, ThesisBenchmark,
};
use modalcast_compute::gpu::Device;
use modalcast_model::deform::{Backend, DeformedSurface};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{BatchPolicy, DeformationSettings, Scene, SceneState, StorageType};

/// Creates a trial of a scene for the given states.
type Make = Box<dyn Fn(&Device, &Arc<Scene>, &[SceneState]) -> Result<Box<dyn KernelBenchmark>>>;

/// The parts of a step that competing kernels launch, and the suffixes of their names.
const PARTS: [(kernels::Part, &str); 2] = [(kernels::Part::Uq, UQ), (kernels::Part::Whole, "")];

/// Name suffixes of variants that compute only a part of a step; their times are not comparable with whole steps.
const UQ: &str = " Uq";
const CHANGED: &str = ", 1 % changed";

/// Whether a variant of this name computes only a part of a step.
pub(super) fn is_partial(name: &str) -> bool {
    [UQ, CHANGED].iter().any(|ending| name.ends_with(ending))
}

/// A trial as a variant. It is created in [`Variant::prepare`], when the states are known.
struct BenchmarkVariant {
    label: VariantLabel,
    scene: Arc<Scene>,
    ingredients: ErrorModel,
    device: Arc<Device>,
    make: Make,
    trial: Option<Box<dyn KernelBenchmark>>,
    surface: DeformedSurface,
}

/// All trials for a scene: our kernels in every storage type, and the competing kernels that support the scene.
pub(super) fn trials(
    device: &Arc<Device>,
    stock: &ErrorModelCache,
    scene: &Arc<Scene>,
    wanted: VariantFilter<'_>,
) -> Vec<VariantCandidate> {
    let stored = |storage: StorageType, extent: StepOutputs| -> VariantCandidate {
        // The kernel that computes u alone does not support batches.
        let batches = if extent == StepOutputs::Uq { BatchPolicy::Never } else { scene.deformation.batches };
        let deformation = DeformationSettings { storage, batches, ..scene.deformation };
        let suffix = match extent {
            StepOutputs::Uq => UQ,
            StepOutputs::Positions => " positions",
            StepOutputs::Whole => "",
        };
        ours(device, stock, wanted, (format!("cuda {}{suffix}", storage.name()), deformation, extent))
    };
    let storages: &[StorageType] = if scene.needs.modes { &StorageType::ALL } else { &[StorageType::F32] };
    let mut offers: Vec<VariantCandidate> =
        storages.iter().map(|storage| stored(*storage, StepOutputs::Positions)).collect();
    if has_normals(scene) {
        offers.extend(storages.iter().map(|storage| stored(*storage, StepOutputs::Whole)));
    }
    for (name, kept) in readers(scene) {
        let extent = if has_normals(scene) { StepOutputs::Whole } else { StepOutputs::Positions };
        offers.push(ours(device, stock, wanted, (name, kept, extent)));
    }
    if scene.domains.len() >= MANY {
        offers.push(changed(device, scene, wanted));
    }
    if scene.needs.modes {
        offers.push(stored(StorageType::F32, StepOutputs::Uq));
        offers.extend(batch(device, stock, scene, wanted));
        offers.extend(thesis(device, scene, wanted));
        offers.extend(cublas(device, scene, wanted));
    }
    offers
}

/// Deformations that keep additional outputs for readers, by name; empty when the scene already keeps one of them.
fn readers(scene: &Scene) -> Vec<(String, DeformationSettings)> {
    let plain = scene.deformation;
    if plain.displacements || plain.boxes {
        return Vec::new();
    }
    let u = ("cuda f32, displacements kept".to_owned(), DeformationSettings { displacements: true, ..plain });
    let boxes = ("cuda f32, boxes kept".to_owned(), DeformationSettings { boxes: true, ..plain });
    vec![u, boxes]
}

/// Whether a deformation truncates modes or sums with compensation, so that its kernel needs rows of its own.
pub(super) fn is_summed_otherwise(deformation: &DeformationSettings) -> bool {
    deformation.truncation.is_some() || deformation.compensated
}

/// The positions kernel of a scene with this deformation. With truncation every state is decided independently, because
/// trials have no history.
pub(super) fn positions(
    device: &Arc<Device>,
    stock: &ErrorModelCache,
    wanted: VariantFilter<'_>,
    (name, deformation): (String, DeformationSettings),
) -> VariantCandidate {
    ours(device, stock, wanted, (name, deformation, StepOutputs::Positions))
}

fn ours(
    device: &Arc<Device>,
    stock: &ErrorModelCache,
    wanted: VariantFilter<'_>,
    (name, deformation, extent): (String, DeformationSettings, StepOutputs),
) -> VariantCandidate {
    let label = VariantLabel { name, backend: Backend::Cuda, deformation };
    make_candidate(wanted, label, |label| {
        let scene = stock.scene(deformation)?;
        let make: Make =
            Box::new(move |device, scene, states| Ok(Box::new(DeformerBenchmark::new(device, scene, states, extent)?)));
        Ok(BenchmarkVariant::sharing(label, &scene, device, (stock.ingredients(&scene), make)))
    })
}

/// Minimum of domains for which a step that changes one domain in a hundred is measured.
const MANY: usize = 400;

/// A step that changes one domain in a hundred, evenly distributed over the domains.
fn changed(device: &Arc<Device>, scene: &Arc<Scene>, wanted: VariantFilter<'_>) -> VariantCandidate {
    let list: Vec<u32> = (0..scene.domains.len() as u32).step_by(100).collect();
    let label = VariantLabel::new(format!("cuda f32 positions{CHANGED}"), Backend::Cuda, scene);
    let make: Make = Box::new(move |device, scene, states| {
        Ok(Box::new(DeformerBenchmark::of_changed(device, scene, states, (StepOutputs::Positions, Some(&list)))?))
    });
    make_candidate(wanted, label, |label| Ok(BenchmarkVariant::new(label, scene, device, make)))
}

/// Batched products of many q with one shape: in every storage type, in f32 without batches for comparison, and by
/// tensor cores where U has 16 bits.
fn batch(
    device: &Arc<Device>,
    stock: &ErrorModelCache,
    scene: &Arc<Scene>,
    wanted: VariantFilter<'_>,
) -> Vec<VariantCandidate> {
    if scene.shapes.len() > 1 || scene.domains.len() < 2 {
        return Vec::new();
    }
    let count = scene.domains.len();
    let of = |storage: StorageType, batches: BatchPolicy| DeformationSettings { storage, batches, ..scene.deformation };
    let one = |storage: StorageType| {
        let name = format!("cuda batch of {count} {}", storage.name());
        positions(device, stock, wanted, (name, of(storage, BatchPolicy::Always)))
    };
    let apart = (format!("cuda {count} apart f32"), of(StorageType::F32, BatchPolicy::Never));
    let products = |storage: StorageType| {
        let deformation = DeformationSettings { storage, ..scene.deformation };
        // Summation order and rounding differ from the deformer's, so the name marks it.
        let name = format!("cuda batch of {count} {} mma", storage.name());
        make_candidate(wanted, VariantLabel { name, backend: Backend::Cuda, deformation }, |label| {
            let scene = stock.scene(deformation)?;
            let make: Make =
                Box::new(|device, scene, states| Ok(Box::new(BatchMmaBenchmark::new(device, scene, states)?)));
            Ok(BenchmarkVariant::sharing(label, &scene, device, (stock.ingredients(&scene).with_products(), make)))
        })
    };
    let ours = StorageType::ALL.into_iter().map(one).chain([positions(device, stock, wanted, apart)]);
    ours.chain([StorageType::F16, StorageType::Bf16].map(products)).collect()
}

/// cuBLAS: each kind of product that fits the scene, alone and with a plain vertex update.
fn cublas(device: &Arc<Device>, scene: &Arc<Scene>, wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
    let shared = scene.domains.len() > 1 && scene.shapes.len() == 1;
    let fits = |peer: &CublasMethod| match peer {
        CublasMethod::SgemvColumns | CublasMethod::SgemvRows => scene.domains.len() == 1,
        CublasMethod::Instances => shared,
        _ => scene.domains.len() > 1,
    };
    let made = |peer: CublasMethod, (part, suffix): (kernels::Part, &str)| {
        let label = VariantLabel::new(format!("{}{suffix}", peer.name().replace('_', " ")), Backend::Cuda, scene);
        let make: Make = Box::new(move |device, scene, states| {
            Ok(Box::new(CublasBenchmark::new(device, scene, states, (peer, part))?))
        });
        make_candidate(wanted, label, |label| Ok(BenchmarkVariant::new(label, scene, device, make)))
    };
    let both = |peer: CublasMethod| PARTS.map(|part| made(peer, part));
    CublasMethod::ALL.into_iter().filter(fits).flat_map(both).collect()
}

/// The thesis's kernels: the single-domain kernel, or the grouped ones in all splits, which support up to 32 modes.
fn thesis(device: &Arc<Device>, scene: &Arc<Scene>, wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
    let made = |name: String, make: Make| {
        let label = VariantLabel::new(name, Backend::Cuda, scene);
        make_candidate(wanted, label, |label| Ok(BenchmarkVariant::new(label, scene, device, make)))
    };
    let single = |(part, suffix): (kernels::Part, &str)| {
        let make: Make =
            Box::new(move |device, scene, states| Ok(Box::new(ThesisBenchmark::single(device, scene, states, part)?)));
        made(format!("thesis single{suffix}"), make)
    };
    let multi = |split: KernelSplit, (part, suffix): (kernels::Part, &str)| {
        let make: Make = Box::new(move |device, scene, states| {
            Ok(Box::new(ThesisBenchmark::multi(device, scene, states, (split, part))?))
        });
        made(format!("thesis {} kernels{suffix}", split.widths().len()), make)
    };
    let largest = (0..scene.domains.len()).map(|domain| scene.rank_of(domain)).max().unwrap_or(0);
    // Unfolded triangles do not contain a vertex that no triangle refers to.
    let parts = if names_all(scene) { &PARTS[..] } else { &PARTS[..1] };
    match (scene.domains.len(), largest) {
        (1, _) => parts.iter().copied().map(single).collect(),
        (_, 0..=32) => KernelSplit::ALL
            .into_iter()
            .flat_map(|split| parts.iter().map(move |part| (split, *part)))
            .map(|(split, part)| multi(split, part))
            .collect(),
        _ => Vec::new(),
    }
}

/// Whether every vertex of every shape is a corner of some triangle.
fn names_all(scene: &Scene) -> bool {
    scene.shapes.iter().all(|shape| {
        let mut named = vec![false; shape.mesh.rest().len()];
        for corner in shape.mesh.triangles().as_flattened() {
            named[shape.mesh.corners().vertices[*corner as usize] as usize] = true;
        }
        named.into_iter().all(|named| named)
    })
}

/// Whether some shape has more than the minimum of three corners, and so real normals.
pub(super) fn has_normals(scene: &Scene) -> bool {
    scene.shapes.iter().any(|shape| shape.mesh.corners().vertices.len() > 3)
}

/// The formula of a part of a trial's bytes, by the part's name.
fn formula(name: &str) -> &'static str {
    match name {
        "U" => "as packed: entries of all modes and vertices, filled up to tiles",
        "U kept" => "as packed: the share of modes that are kept, mean over the domains and states that are timed",
        "q" => "4 x sum r",
        "T" => "48 x d",
        "x0" | "u or x" | "x" => "12 x sum n",
        _ => "as packed",
    }
}

impl BenchmarkVariant {
    fn new(label: VariantLabel, scene: &Arc<Scene>, device: &Arc<Device>, make: Make) -> Self {
        Self::sharing(label, scene, device, (ErrorModel::of(scene), make))
    }

    fn sharing(
        label: VariantLabel,
        scene: &Arc<Scene>,
        device: &Arc<Device>,
        (ingredients, make): (ErrorModel, Make),
    ) -> Self {
        let (scene, device) = (Arc::clone(scene), Arc::clone(device));
        Self { label, scene, ingredients, device, make, trial: None, surface: DeformedSurface::default() }
    }

    fn trial(&self) -> Result<&dyn KernelBenchmark> {
        let missing = || Error::Fault { stage: "trial", reason: format!("{} was not prepared", self.label.name) };
        self.trial.as_deref().ok_or_else(missing)
    }
}

impl Variant for BenchmarkVariant {
    fn label(&self) -> &VariantLabel {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn ingredients(&self) -> &ErrorModel {
        &self.ingredients
    }

    fn traffic(&self) -> Vec<Operand> {
        let parts = self.trial.as_ref().map_or_else(Vec::new, |trial| trial.bytes());
        parts.into_iter().map(|(name, bytes)| Operand { name, formula: formula(name), bytes }).collect()
    }

    fn prepare(&mut self, states: &[SceneState]) -> Result<()> {
        self.trial = Some((self.make)(&self.device, &self.scene, states)?);
        Ok(())
    }

    fn surface(&mut self, at: usize, state: &SceneState) -> Result<&DeformedSurface> {
        self.ingredients.reset();
        self.ingredients.follow(state);
        let trial = self.trial()?;
        trial.complete(&self.device, at)?;
        trial.launch(&self.device, at)?;
        self.surface.positions = trial.positions(&self.device)?;
        Ok(&self.surface)
    }

    fn time(&mut self, _states: &[SceneState], cache: CacheState, replays: usize) -> Result<Option<Timing>> {
        kernels::time(&self.device, self.trial()?, cache, replays).map(Some)
    }

    fn kernels(&self) -> (usize, Vec<KernelAttributes>) {
        self.trial.as_ref().map_or((0, Vec::new()), |trial| (trial.launches(), trial.kernels()))
    }
}
