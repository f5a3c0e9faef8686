//! Trials on the CUDA device as variants, and the list of those that a load gets.

use std::sync::Arc;

use super::bench::{Offer, Wanted, offer};
use super::ingredients::{Ingredients, Stock};
use super::timing::{Cache, Timing};
use super::traffic::Part;
use super::variant::{Label, Variant};
use crate::kernels;
use crate::kernels::{BatchMma, Cublas, Extent, KernelFacts, Ours, Peer, Split, Thesis, Trial};
use modalcast_compute::gpu::Device;
use modalcast_model::deform::{Backend, Surface};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Batches, Deformation, Scene, State, Storage};

/// Makes a trial of a scene for some states.
type Make = Box<dyn Fn(&Device, &Arc<Scene>, &[State]) -> Result<Box<dyn Trial>>>;

/// The parts of a step that peers launch, and how their names tell.
const PARTS: [(kernels::Part, &str); 2] = [(kernels::Part::Uq, UQ), (kernels::Part::Whole, "")];

/// How the names of variants end that do less than all vertices of a step: such a time is no rival of a whole one.
const UQ: &str = " Uq";
const CHANGED: &str = ", 1 % changed";

/// Whether a variant of that name does only a part of the vertices' work.
pub(super) fn is_partial(name: &str) -> bool {
    [UQ, CHANGED].iter().any(|ending| name.ends_with(ending))
}

/// A trial as a variant. It is made once, when its states are known.
struct Tried {
    label: Label,
    scene: Arc<Scene>,
    ingredients: Ingredients,
    device: Arc<Device>,
    make: Make,
    trial: Option<Box<dyn Trial>>,
    surface: Surface,
}

/// All trials for a scene: ours in every storage type, and the thesis's kernels where they apply.
pub(super) fn trials(device: &Arc<Device>, stock: &Stock, scene: &Arc<Scene>, wanted: Wanted<'_>) -> Vec<Offer> {
    let stored = |storage: Storage, extent: Extent| -> Offer {
        // u alone comes from a kernel that batches do not have.
        let batches = if extent == Extent::Uq { Batches::Never } else { scene.deformation.batches };
        let deformation = Deformation { storage, batches, ..scene.deformation };
        let suffix = match extent {
            Extent::Uq => UQ,
            Extent::Positions => " positions",
            Extent::Whole => "",
        };
        ours(device, stock, wanted, (format!("cuda {}{suffix}", storage.name()), deformation, extent))
    };
    let storages: &[Storage] = if scene.needs.modes { &Storage::ALL } else { &[Storage::F32] };
    let mut offers: Vec<Offer> = storages.iter().map(|storage| stored(*storage, Extent::Positions)).collect();
    if has_normals(scene) {
        offers.extend(storages.iter().map(|storage| stored(*storage, Extent::Whole)));
    }
    for (name, kept) in readers(scene) {
        let extent = if has_normals(scene) { Extent::Whole } else { Extent::Positions };
        offers.push(ours(device, stock, wanted, (name, kept, extent)));
    }
    if scene.domains.len() >= MANY {
        offers.push(changed(device, scene, wanted));
    }
    if scene.needs.modes {
        offers.push(stored(Storage::F32, Extent::Uq));
        offers.extend(batch(device, stock, scene, wanted));
        offers.extend(thesis(device, scene, wanted));
        offers.extend(cublas(device, scene, wanted));
    }
    offers
}

/// What a scene may keep for readers, by name, where it keeps neither.
fn readers(scene: &Scene) -> Vec<(String, Deformation)> {
    let plain = scene.deformation;
    if plain.displacements || plain.boxes {
        return Vec::new();
    }
    let u = ("cuda f32, displacements kept".to_owned(), Deformation { displacements: true, ..plain });
    let boxes = ("cuda f32, boxes kept".to_owned(), Deformation { boxes: true, ..plain });
    vec![u, boxes]
}

/// Whether a deformation sums other modes than all, or in another way: its kernel then has its own rows.
pub(super) fn is_summed_otherwise(deformation: &Deformation) -> bool {
    deformation.truncation.is_some() || deformation.compensated
}

/// The kernel of positions for a scene that is deformed so. Every state is decided on its own where modes are left out:
/// no trial remembers the one before.
pub(super) fn positions(
    device: &Arc<Device>,
    stock: &Stock,
    wanted: Wanted<'_>,
    (name, deformation): (String, Deformation),
) -> Offer {
    ours(device, stock, wanted, (name, deformation, Extent::Positions))
}

fn ours(
    device: &Arc<Device>,
    stock: &Stock,
    wanted: Wanted<'_>,
    (name, deformation, extent): (String, Deformation, Extent),
) -> Offer {
    let label = Label { name, backend: Backend::Cuda, deformation };
    offer(wanted, label, |label| {
        let scene = stock.scene(deformation)?;
        let make: Make = Box::new(move |device, scene, states| Ok(Box::new(Ours::new(device, scene, states, extent)?)));
        Ok(Tried::sharing(label, &scene, device, (stock.ingredients(&scene), make)))
    })
}

/// Domains from which on a step that changes one in a hundred is measured.
const MANY: usize = 400;

/// A step that changes one domain in a hundred, spread over the list.
fn changed(device: &Arc<Device>, scene: &Arc<Scene>, wanted: Wanted<'_>) -> Offer {
    let list: Vec<u32> = (0..scene.domains.len() as u32).step_by(100).collect();
    let label = Label::new(format!("cuda f32 positions{CHANGED}"), Backend::Cuda, scene);
    let make: Make = Box::new(move |device, scene, states| {
        Ok(Box::new(Ours::of_changed(device, scene, states, (Extent::Positions, Some(&list)))?))
    });
    offer(wanted, label, |label| Ok(Tried::new(label, scene, device, make)))
}

/// Many q of one shape at once, in every storage type; f32 one after the other, for comparison; and by tensor cores where
/// U has 16 bits.
fn batch(device: &Arc<Device>, stock: &Stock, scene: &Arc<Scene>, wanted: Wanted<'_>) -> Vec<Offer> {
    if scene.shapes.len() > 1 || scene.domains.len() < 2 {
        return Vec::new();
    }
    let count = scene.domains.len();
    let of = |storage: Storage, batches: Batches| Deformation { storage, batches, ..scene.deformation };
    let one = |storage: Storage| {
        let name = format!("cuda batch of {count} {}", storage.name());
        positions(device, stock, wanted, (name, of(storage, Batches::Always)))
    };
    let apart = (format!("cuda {count} apart f32"), of(Storage::F32, Batches::Never));
    let products = |storage: Storage| {
        let deformation = Deformation { storage, ..scene.deformation };
        // Another order and rounding than the deformer's: its name says so.
        let name = format!("cuda batch of {count} {} mma", storage.name());
        offer(wanted, Label { name, backend: Backend::Cuda, deformation }, |label| {
            let scene = stock.scene(deformation)?;
            let make: Make = Box::new(|device, scene, states| Ok(Box::new(BatchMma::new(device, scene, states)?)));
            Ok(Tried::sharing(label, &scene, device, (stock.ingredients(&scene).with_products(), make)))
        })
    };
    let ours = Storage::ALL.into_iter().map(one).chain([positions(device, stock, wanted, apart)]);
    ours.chain([Storage::F16, Storage::Bf16].map(products)).collect()
}

/// cuBLAS as a peer: each of its ways to multiply that fits the scene, alone and with a plain vertex update.
fn cublas(device: &Arc<Device>, scene: &Arc<Scene>, wanted: Wanted<'_>) -> Vec<Offer> {
    let shared = scene.domains.len() > 1 && scene.shapes.len() == 1;
    let fits = |peer: &Peer| match peer {
        Peer::SgemvColumns | Peer::SgemvRows => scene.domains.len() == 1,
        Peer::Instances => shared,
        _ => scene.domains.len() > 1,
    };
    let made = |peer: Peer, (part, suffix): (kernels::Part, &str)| {
        let label = Label::new(format!("{}{suffix}", peer.name().replace('_', " ")), Backend::Cuda, scene);
        let make: Make =
            Box::new(move |device, scene, states| Ok(Box::new(Cublas::new(device, scene, states, (peer, part))?)));
        offer(wanted, label, |label| Ok(Tried::new(label, scene, device, make)))
    };
    let both = |peer: Peer| PARTS.map(|part| made(peer, part));
    Peer::ALL.into_iter().filter(fits).flat_map(both).collect()
}

/// The thesis's kernels: those for one domain, else the grouped ones in all their splits. They take up to 32 modes.
fn thesis(device: &Arc<Device>, scene: &Arc<Scene>, wanted: Wanted<'_>) -> Vec<Offer> {
    let made = |name: String, make: Make| {
        let label = Label::new(name, Backend::Cuda, scene);
        offer(wanted, label, |label| Ok(Tried::new(label, scene, device, make)))
    };
    let single = |(part, suffix): (kernels::Part, &str)| {
        let make: Make =
            Box::new(move |device, scene, states| Ok(Box::new(Thesis::single(device, scene, states, part)?)));
        made(format!("thesis single{suffix}"), make)
    };
    let multi = |split: Split, (part, suffix): (kernels::Part, &str)| {
        let make: Make =
            Box::new(move |device, scene, states| Ok(Box::new(Thesis::multi(device, scene, states, (split, part))?)));
        made(format!("thesis {} kernels{suffix}", split.widths().len()), make)
    };
    let largest = (0..scene.domains.len()).map(|domain| scene.rank_of(domain)).max().unwrap_or(0);
    // Unfolded triangles have no place for a vertex that no triangle names.
    let parts = if names_all(scene) { &PARTS[..] } else { &PARTS[..1] };
    match (scene.domains.len(), largest) {
        (1, _) => parts.iter().copied().map(single).collect(),
        (_, 0..=32) => Split::ALL
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

/// Whether some shape has more corners than the least that a mesh must have.
pub(super) fn has_normals(scene: &Scene) -> bool {
    scene.shapes.iter().any(|shape| shape.mesh.corners().vertices.len() > 3)
}

/// The formula of a part of a trial's bytes, where its name says which.
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

impl Tried {
    fn new(label: Label, scene: &Arc<Scene>, device: &Arc<Device>, make: Make) -> Self {
        Self::sharing(label, scene, device, (Ingredients::of(scene), make))
    }

    fn sharing(
        label: Label,
        scene: &Arc<Scene>,
        device: &Arc<Device>,
        (ingredients, make): (Ingredients, Make),
    ) -> Self {
        let (scene, device) = (Arc::clone(scene), Arc::clone(device));
        Self { label, scene, ingredients, device, make, trial: None, surface: Surface::default() }
    }

    fn trial(&self) -> Result<&dyn Trial> {
        let missing = || Error::Fault { stage: "trial", reason: format!("{} was not prepared", self.label.name) };
        self.trial.as_deref().ok_or_else(missing)
    }
}

impl Variant for Tried {
    fn label(&self) -> &Label {
        &self.label
    }

    fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    fn ingredients(&self) -> &Ingredients {
        &self.ingredients
    }

    fn traffic(&self) -> Vec<Part> {
        let parts = self.trial.as_ref().map_or_else(Vec::new, |trial| trial.bytes());
        parts.into_iter().map(|(name, bytes)| Part { name, formula: formula(name), bytes }).collect()
    }

    fn prepare(&mut self, states: &[State]) -> Result<()> {
        self.trial = Some((self.make)(&self.device, &self.scene, states)?);
        Ok(())
    }

    fn surface(&mut self, at: usize, state: &State) -> Result<&Surface> {
        self.ingredients.forget();
        self.ingredients.follow(state);
        let trial = self.trial()?;
        trial.complete(&self.device, at)?;
        trial.launch(&self.device, at)?;
        self.surface.positions = trial.positions(&self.device)?;
        Ok(&self.surface)
    }

    fn time(&mut self, _states: &[State], cache: Cache, replays: usize) -> Result<Option<Timing>> {
        let cache = match cache {
            Cache::Warm => kernels::Cache::Warm,
            Cache::Cold => kernels::Cache::Cold,
        };
        let kernels::Timing { median_us, q1_us, q3_us, replays } =
            kernels::time(&self.device, self.trial()?, cache, replays)?;
        Ok(Some(Timing { median_us, q1_us, q3_us, replays }))
    }

    fn kernels(&self) -> (usize, Vec<KernelFacts>) {
        self.trial.as_ref().map_or((0, Vec::new()), |trial| (trial.launches(), trial.kernels()))
    }
}
