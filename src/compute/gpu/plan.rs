//! The plan of a scene on the device: kernels with their macros, buffers in bytes, launches and copies. Pure.

use serde::Serialize;

use super::apply::most_changes;
use super::inputs::{Sizes, following};
use super::layout::{BLOCK, Change, Lane, NormalSlot, Piece, Tile};
use super::pack;
use super::rings::Counts;
use super::work::{Coordinates, Work, orients};
use super::{batch, boxes};
use crate::storage::TILE_QUADS;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, Storage};

/// A kernel source file and the macros that enable its optional features.
#[derive(Debug)]
pub(super) struct KernelSource {
    pub name: &'static str,
    pub source: &'static str,
    pub features: &'static [&'static str],
}

/// All kernels of a step.
pub(super) const KERNELS: [KernelSource; 5] = [
    KernelSource {
        name: "deform",
        source: include_str!("../../../kernels/deform.cu"),
        features: &[
            "MODES",
            "NARROW",
            "TRUNCATED",
            "COMPENSATED",
            "DISPLACEMENTS",
            "ORIENT",
            "SHIFTED",
            "NORMAL_MAPS",
            "SHEAR",
            "FOLLOWERS",
        ],
    },
    KernelSource {
        name: "batch",
        source: include_str!("../../../kernels/batch.cu"),
        features: &["FOLLOWERS", "BATCH_8", "BATCH_4"],
    },
    KernelSource { name: "bounds", source: include_str!("../../../kernels/bounds.cu"), features: &["LIGHT", "BOXES"] },
    KernelSource { name: "apply", source: include_str!("../../../kernels/apply.cu"), features: &["FOLLOWERS"] },
    KernelSource {
        name: "normals",
        source: include_str!("../../../kernels/normals.cu"),
        features: &["NORMAL_MAPS", "SHEAR", "FOLLOWERS"],
    },
];

/// The macros that select the storage type of U; f32 has none.
pub(super) const STORAGES: [&str; 3] = ["STORE_F16", "STORE_BF16", "STORE_INT8"];

/// Below this number of tiles a lane computes one vertex instead of four, because the tiles would not fill the device:
/// eight warps for each multiprocessor of a large device.
const FEW_TILES: usize = 1024;

/// Purpose of a kernel launch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Launch {
    /// Full steps only: domains that share a U, which is read once per group. Only in scenes with such domains.
    Batch,
    Deform,
    Bounds,
    /// Normals that follow the surface.
    Normals,
    /// Partial steps only, before all other launches. Only in scenes that can have partial steps.
    Apply,
}

/// A kernel as compiled for one scene; launched at most once per step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Kernel {
    pub launch: Launch,
    pub name: &'static str,
    /// Macros that enable optional features.
    pub defines: Vec<&'static str>,
    pub blocks: u32,
    pub threads: u32,
    #[serde(skip)]
    pub(super) source: Source,
}

/// The text of a kernel source file; `Debug` prints only its length.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Source(pub(super) &'static str);

impl std::fmt::Debug for Source {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "{} bytes", self.0.len())
    }
}

/// Content of a device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// U of every shape, in tiles.
    Words,
    /// x0 of every shape.
    Rest,
    /// Scales of U; only with `Int8`.
    Scales,
    /// The work of each warp, and the tile list of partial steps if the scene can have them.
    Tiles,
    Lanes,
    /// Per domain, offset from its first vertex to its first corner; only if an offset differs from zero.
    CornerShifts,
    /// Groups of domains, and the work of each block of `batch`.
    Batches,
    /// A bounding box of each warp's vertices.
    Boxes,
    /// The step that last changed each domain.
    Stamps,
    /// Transform root of each domain, and the frames of followers.
    Frames,
    RestNormals,
    RestTangents,
    /// The smoothing group of each corner; only if normals follow the surface.
    Members,
    /// Vertices around each smoothing group, and the offset of each group's ring.
    Rings,
    /// The geometric normal of each smoothing group at rest.
    GroupNormals,
    /// Offsets of each domain's corners.
    CornerSlots,
    /// The first domain of each block of corners.
    CornerBlocks,
    /// Header, transforms and q of a step.
    Inputs,
    Positions,
    Normals,
    Tangents,
    /// u; only if the scene keeps displacements.
    Displacements,
    /// The pieces of domains that `bounds` reduces to boxes, and their boxes; only if the scene keeps boxes.
    Pieces,
    DomainBoxes,
}

/// One device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Buffer {
    pub role: Role,
    pub bytes: u64,
}

/// An optional feature that the scene does not use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LeftOut {
    /// The flag of [`modalcast_model::scene::Needs`] that is off, or "batches".
    pub feature: &'static str,
    /// What is not compiled, computed or stored.
    pub what: &'static str,
    /// Device bytes saved, as far as they are known: the length of rings is unknown until they are built.
    pub bytes: u64,
}

/// What the CUDA deformer compiles, allocates and launches for a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Plan {
    /// The kernels of the scene in launch order, except `apply`, which is last here and first in a partial step.
    pub kernels: Vec<Kernel>,
    pub buffers: Vec<Buffer>,
    /// Bytes that each step copies to the device and back, without the vertices.
    pub bytes_in: u64,
    pub bytes_out: u64,
    /// Pinned bytes of the lists of a partial step; 0 for a scene whose steps are always full.
    pub bytes_of_changes: u64,
    pub left_out: Vec<LeftOut>,
}

/// Tables of the scene on the device, built once for the plan and the upload.
#[derive(Debug)]
pub struct Tables {
    pub(super) coordinates: Coordinates,
    pub(super) work: Work,
    /// The parts of domains that `bounds` reduces to boxes.
    pub(super) pieces: Vec<Piece>,
}

impl Tables {
    pub fn new(scene: &Scene) -> Self {
        let coordinates = Coordinates::new(scene);
        let work = Work::new(scene, &coordinates);
        Self { pieces: boxes::pieces(scene, &work), work, coordinates }
    }
}

/// The plan of a scene.
pub fn plan(scene: &Scene) -> Plan {
    plan_of(scene, &Tables::new(scene))
}

/// The plan of a scene from existing tables.
pub fn plan_of(scene: &Scene, Tables { coordinates, work, pieces }: &Tables) -> Plan {
    let needs = scene.needs;
    let layout = &scene.layout;
    let kernels = kernels(scene, work, pieces);
    let lists = most_changes(scene) > 0;
    let rest_corners = pack::rest_corners(scene) as u64;
    let (vertices, corners) = (layout.vertices as u64, layout.corners as u64);
    let domains = scene.domains.len() as u64;
    let inputs = Sizes::of(scene, coordinates).total();
    let directed = if orients(scene) { work.quads.end - work.quads.directed } else { 0 };
    let mut buffers = vec![
        (Role::Words, 16 * work.words),
        (Role::Rest, 48 * work.quads.rest),
        (Role::Scales, 4 * work.scales),
        (Role::Tiles, ((size_of::<Tile>() + if lists { 4 } else { 0 }) * work.tiles.len()) as u64),
        (Role::Lanes, (work.lanes.len() * size_of::<Lane>() + 4 * work.lane_scales.len()) as u64),
        (Role::CornerShifts, 4 * work.corner_shifts.len() as u64),
        (Role::Boxes, 96 * work.tiles.len() as u64),
        (Role::Stamps, 4 * domains),
        (Role::RestNormals, if needs.exact_normals { 12 * rest_corners } else { 48 * directed }),
        (Role::Inputs, inputs),
        (Role::Positions, 12 * vertices),
        (Role::Normals, 12 * corners),
    ];
    if needs.normal_maps {
        let rigid = 64 * directed;
        let bytes = if needs.exact_normals { 16 * pack::tangent_count(scene) as u64 } else { rigid };
        buffers.push((Role::RestTangents, bytes));
        buffers.push((Role::Tangents, 16 * corners));
    }
    if needs.displacements {
        buffers.push((Role::Displacements, 12 * vertices));
    }
    if !work.batched.blocks.is_empty() {
        buffers.push((Role::Batches, batch::bytes(&work.batched)));
    }
    let (pieces, domain_boxes) = boxes::bytes(pieces.len());
    if needs.boxes {
        buffers.extend([(Role::Pieces, pieces), (Role::DomainBoxes, domain_boxes)]);
    }
    if needs.exact_normals {
        let counts = Counts::of(scene);
        buffers.push((Role::CornerSlots, domains * size_of::<NormalSlot>() as u64));
        buffers.push((Role::CornerBlocks, 4 * (u64::from(blocks(layout.corners)) + 1)));
        buffers.push((Role::Members, 4 * counts.members));
        buffers.push((Role::Rings, 4 * (counts.groups + 1 + counts.rings)));
        buffers.push((Role::GroupNormals, 12 * counts.groups));
    }
    if needs.followers {
        let frames = size_of_val(scene.movers.frames()) + size_of_val(following(scene).as_slice());
        buffers.push((Role::Frames, frames as u64));
    }
    let changes = match most_changes(scene) {
        0 => 0,
        most => (size_of::<Change>() + 48) * most + 4 * (coordinates.total + work.tiles.len()),
    };
    Plan {
        kernels,
        buffers: buffers.into_iter().map(|(role, bytes)| Buffer { role, bytes }).collect(),
        bytes_in: inputs,
        bytes_out: if scene.light_axes().is_some() { 48 } else { 24 },
        bytes_of_changes: changes as u64,
        left_out: left_out(
            scene,
            !work.batched.blocks.is_empty(),
            [16 * (rest_corners + corners), 12 * vertices, pieces + domain_boxes],
        ),
    }
}

/// The macro of a storage type.
pub const fn storage_define(storage: Storage) -> Option<&'static str> {
    match storage {
        Storage::F32 => None,
        Storage::F16 => Some(STORAGES[0]),
        Storage::Bf16 => Some(STORAGES[1]),
        Storage::Int8 => Some(STORAGES[2]),
    }
}

/// Whether a lane computes one item instead of four.
pub(super) const fn is_narrow(work: &Work) -> bool {
    work.launched < FEW_TILES
}

/// Threads per block of `deform`: 32 WARPS of its source, which the launcher verifies.
fn threads_of(defines: &[&str]) -> u32 {
    let one = ["MODES", "SHEAR", "LISTED"].iter().any(|macro_name| defines.contains(macro_name));
    TILE_QUADS as u32 * if one { 1 } else { 2 }
}

fn kernels(scene: &Scene, work: &Work, pieces: &[Piece]) -> Vec<Kernel> {
    let needs = scene.needs;
    let [deform, batch, bounds, apply, normals] = KERNELS;
    let defines = deform_defines(scene, work);
    let threads = threads_of(&defines);
    let launch = Launch::Deform;
    let mut deform = Kernel { launch, name: deform.name, defines, blocks: 0, threads, source: Source(deform.source) };
    deform.blocks = super::deform::blocks(&deform, work.launched);
    let walk = |launch, kernel: &KernelSource, blocks: usize| {
        let defines = [
            ("NORMAL_MAPS", needs.normal_maps),
            ("SHEAR", needs.shear),
            ("FOLLOWERS", needs.followers),
            ("LIGHT", scene.light_axes().is_some()),
            ("BOXES", needs.boxes),
        ];
        let on = defines.iter().filter(|(name, on)| *on && kernel.features.contains(name));
        let (defines, blocks) = (on.map(|(name, _)| *name).collect(), blocks as u32);
        Kernel { launch, name: kernel.name, defines, blocks, threads: BLOCK, source: Source(kernel.source) }
    };
    let few = (4 * work.tiles.len()).div_ceil(BLOCK as usize).min(MOST_BLOCKS / 4);
    // Eight threads reduce one piece of a domain and mostly wait for memory, so more blocks hide the latency.
    let many = pieces.len().div_ceil(BLOCK as usize / 8).min(4 * MOST_BLOCKS);
    let boxes = if needs.boxes { few.max(many) } else { few };
    let batch = (!work.batched.blocks.is_empty()).then(|| batch::kernel(scene, &work.batched, batch));
    let mut kernels: Vec<Kernel> = batch.into_iter().chain([deform]).collect();
    kernels.push(walk(Launch::Bounds, &bounds, boxes));
    if needs.exact_normals {
        kernels.push(walk(Launch::Normals, &normals, blocks(scene.layout.corners) as usize));
    }
    let changes = most_changes(scene);
    if changes > 0 {
        kernels.push(walk(Launch::Apply, &apply, changes.div_ceil(BLOCK as usize / 32).min(MOST_BLOCKS)));
    }
    kernels
}

/// The macros of `deform`.
fn deform_defines(scene: &Scene, work: &Work) -> Vec<&'static str> {
    let (needs, orients) = (scene.needs, orients(scene));
    let flags = [
        ("MODES", needs.modes),
        ("NARROW", is_narrow(work)),
        ("TRUNCATED", needs.truncation),
        ("COMPENSATED", needs.compensated),
        ("DISPLACEMENTS", needs.displacements),
        ("ORIENT", orients),
        ("SHIFTED", !work.corner_shifts.is_empty()),
        ("NORMAL_MAPS", orients && needs.normal_maps),
        ("SHEAR", orients && needs.shear),
        ("FOLLOWERS", needs.followers),
    ];
    let on = flags.iter().filter(|(_, on)| *on).map(|(name, _)| *name);
    on.chain(storage_define(scene.deformation.storage).filter(|_| needs.modes)).collect()
}

/// Maximum number of blocks of the kernels that loop over lists: two per multiprocessor of a large device.
const MOST_BLOCKS: usize = 264;

fn left_out(scene: &Scene, batched: bool, [tangents, displacements, boxes]: [u64; 3]) -> Vec<LeftOut> {
    let needs = scene.needs;
    let more = size_of::<NormalSlot>() * scene.domains.len();
    let exact_normals = LeftOut {
        feature: "exact_normals",
        what: "`normals` behind `deform`, and its rings",
        bytes: Counts::bytes_of_possible_members(scene) + more as u64,
    };
    let all = [
        (needs.modes, LeftOut { feature: "modes", what: "the sum U q in `deform`", bytes: 0 }),
        (
            needs.normal_maps,
            LeftOut { feature: "normal_maps", what: "tangents and their two buffers", bytes: tangents },
        ),
        (needs.shear, LeftOut { feature: "shear", what: "the inverse transpose", bytes: 0 }),
        (needs.truncation, LeftOut { feature: "truncation", what: "lists of modes in `deform`", bytes: 0 }),
        (needs.exact_normals, exact_normals),
        (needs.compensated, LeftOut { feature: "compensated", what: "the compensation in `deform`", bytes: 0 }),
        (needs.followers, LeftOut { feature: "followers", what: "frames, and products of transforms", bytes: 0 }),
        (
            needs.displacements,
            LeftOut { feature: "displacements", what: "u as an output of `deform`", bytes: displacements },
        ),
        (scene.light_axes().is_some(), LeftOut { feature: "shadows", what: "bounds in light space", bytes: 0 }),
        (needs.boxes, LeftOut { feature: "boxes", what: "a box of each domain in `bounds`", bytes: boxes }),
    ];
    let batches = LeftOut { feature: "batches", what: "`batch`, and groups of domains", bytes: 0 };
    let all = all.into_iter().chain([(batched, batches)]);
    all.filter(|(needed, _)| !needed).map(|(_, part)| part).collect()
}

/// Number of blocks that cover so many corners.
fn blocks(items: usize) -> u32 {
    items.div_ceil(BLOCK as usize) as u32
}

impl Plan {
    /// Bytes of a buffer; 0 when the scene does not have it.
    pub fn bytes(&self, role: Role) -> u64 {
        self.buffers.iter().filter(|buffer| buffer.role == role).map(|buffer| buffer.bytes).sum()
    }

    /// Bytes of all buffers, outputs included.
    pub fn total_bytes(&self) -> u64 {
        self.buffers.iter().map(|buffer| buffer.bytes).sum()
    }

    /// The kernel of a launch, if the scene has it.
    pub fn kernel(&self, launch: Launch) -> Option<&Kernel> {
        self.kernels.iter().find(|kernel| kernel.launch == launch)
    }

    /// The kernel of a launch that every scene has.
    pub fn needed(&self, launch: Launch) -> Result<&Kernel> {
        let missing = || Error::Fault { stage: "plan", reason: format!("no kernel for {launch:?}") };
        self.kernel(launch).ok_or_else(missing)
    }

    /// Maximum number of kernel launches of one step, for any number of domains.
    pub fn launches(&self) -> usize {
        // A full step may launch `batch` but not `apply`; a partial step may launch `apply` but not `batch`.
        let whole = self.kernels.iter().filter(|kernel| kernel.launch != Launch::Apply).count();
        let listed = self.kernels.iter().filter(|kernel| kernel.launch != Launch::Batch).count();
        if self.kernel(Launch::Apply).is_some() { whole.max(listed) } else { whole }
    }
}

#[cfg(test)]
mod tests;
