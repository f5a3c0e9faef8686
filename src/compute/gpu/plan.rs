//! The plan of a scene on the device: kernels with their macros, buffers in bytes, launches and copies. Pure.

use serde::Serialize;

use super::apply::max_change_entries;
use super::inputs::{InputSizes, transform_links};
use super::layout::{BLOCK, BoxSegment, Change, MixedQuad, NormalSlot, WarpTile};
use super::normal_tables;
use super::rings::RingCounts;
use super::work::{CoordinateLayout, WorkList, has_rigid_normals};
use super::{batch, boxes};
use crate::storage::TILE_QUADS;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, StorageType};

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
            "ONE_ITEM_PER_LANE",
            "MODE_TRUNCATION",
            "COMPENSATED_SUM",
            "DISPLACEMENTS",
            "RIGID_NORMALS",
            "CORNER_OFFSETS",
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
    KernelSource {
        name: "bounds",
        source: include_str!("../../../kernels/bounds.cu"),
        features: &["LIGHT_BOUNDS", "DOMAIN_BOXES"],
    },
    KernelSource { name: "apply", source: include_str!("../../../kernels/apply.cu"), features: &["FOLLOWERS"] },
    KernelSource {
        name: "normals",
        source: include_str!("../../../kernels/normals.cu"),
        features: &["NORMAL_MAPS", "SHEAR", "FOLLOWERS"],
    },
];

/// The macros that select the storage type of U; f32 has none.
pub(super) const STORAGE_DEFINES: [&str; 3] = ["STORE_F16", "STORE_BF16", "STORE_INT8"];

/// Below this number of tiles a lane computes one vertex instead of four, because the tiles would not fill the device:
/// eight warps for each multiprocessor of a large device.
const MIN_FOUR_ITEM_TILES: usize = 1024;

/// Purpose of a kernel launch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KernelKind {
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
pub struct KernelDescriptor {
    pub kind: KernelKind,
    pub name: &'static str,
    /// Macros that enable optional features.
    pub defines: Vec<&'static str>,
    pub blocks: u32,
    pub threads: u32,
    #[serde(skip)]
    pub(super) source: KernelText,
}

/// The text of a kernel source file; `Debug` prints only its length.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct KernelText(pub(super) &'static str);

impl std::fmt::Debug for KernelText {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "{} bytes", self.0.len())
    }
}

/// Content of a device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BufferRole {
    /// U of every shape, in tiles.
    ModeWords,
    /// x0 of every shape.
    RestPositions,
    /// Scales of U; only with `Int8`.
    Scales,
    /// The work of each warp, and the tile list of partial steps if the scene can have them.
    WarpTiles,
    MixedQuads,
    /// Per domain, offset from its first vertex to its first corner; only if an offset differs from zero.
    CornerOffsets,
    /// Groups of domains, and the work of each block of `batch`.
    Batches,
    /// A bounding box of each warp's vertices.
    WarpBoxes,
    /// The step that last changed each domain.
    ChangeSteps,
    /// Transform root of each domain, and the frames of followers.
    FollowerFrames,
    RestNormals,
    RestTangents,
    /// The smoothing group of each corner; only if normals follow the surface.
    CornerGroups,
    /// Vertices around each smoothing group, and the offset of each group's ring.
    RingTables,
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
    BoxSegments,
    DomainBoxes,
}

/// One device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct BufferDescriptor {
    pub role: BufferRole,
    pub bytes: u64,
}

/// An optional feature that the scene does not use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct OmittedFeature {
    /// The flag of [`modalcast_model::scene::SceneFeatures`] that is off, or "batches".
    pub feature: &'static str,
    /// Features that are not compiled, computed or stored.
    pub what: &'static str,
    /// Device bytes saved, as far as they are known: the length of rings is unknown until they are built.
    pub bytes: u64,
}

/// What the CUDA deformer compiles, allocates and launches for a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DeformPlan {
    /// The kernels of the scene in launch order, except `apply`, which is last here and first in a partial step.
    pub kernels: Vec<KernelDescriptor>,
    pub buffers: Vec<BufferDescriptor>,
    /// Bytes that each step copies to the device and back, without the vertices.
    pub bytes_in: u64,
    pub bytes_out: u64,
    /// Pinned bytes of the lists of a partial step; 0 for a scene whose steps are always full.
    pub change_list_bytes: u64,
    pub omitted: Vec<OmittedFeature>,
}

/// Tables of the scene on the device, built once for the plan and the upload.
#[derive(Debug)]
pub struct DeviceTables {
    pub(super) coordinates: CoordinateLayout,
    pub(super) work: WorkList,
    /// The parts of domains that `bounds` reduces to boxes.
    pub(super) segments: Vec<BoxSegment>,
}

impl DeviceTables {
    pub fn new(scene: &Scene) -> Self {
        let coordinates = CoordinateLayout::new(scene);
        let work = WorkList::new(scene, &coordinates);
        Self { segments: boxes::segments(scene, &work), work, coordinates }
    }
}

/// The plan of a scene.
pub fn plan(scene: &Scene) -> DeformPlan {
    plan_from_tables(scene, &DeviceTables::new(scene))
}

/// The plan of a scene from existing tables.
pub fn plan_from_tables(scene: &Scene, DeviceTables { coordinates, work, segments }: &DeviceTables) -> DeformPlan {
    let needs = scene.needs;
    let layout = &scene.layout;
    let kernels = kernels(scene, work, segments);
    let lists = max_change_entries(scene) > 0;
    let rest_corners = normal_tables::rest_corners(scene) as u64;
    let (vertices, corners) = (layout.vertices as u64, layout.corners as u64);
    let domains = scene.domains.len() as u64;
    let inputs = InputSizes::of(scene, coordinates).total();
    let first_with_normals = if has_rigid_normals(scene) { work.quads.end - work.quads.first_with_normals } else { 0 };
    let mut buffers = vec![
        (BufferRole::ModeWords, 16 * work.words),
        (BufferRole::RestPositions, 48 * work.quads.rest),
        (BufferRole::Scales, 4 * work.scales),
        (BufferRole::WarpTiles, ((size_of::<WarpTile>() + if lists { 4 } else { 0 }) * work.tiles.len()) as u64),
        (
            BufferRole::MixedQuads,
            (work.mixed_quads.len() * size_of::<MixedQuad>() + 4 * work.mixed_quad_scales.len()) as u64,
        ),
        (BufferRole::CornerOffsets, 4 * work.corner_offsets.len() as u64),
        (BufferRole::WarpBoxes, 96 * work.tiles.len() as u64),
        (BufferRole::ChangeSteps, 4 * domains),
        (BufferRole::RestNormals, if needs.exact_normals { 12 * rest_corners } else { 48 * first_with_normals }),
        (BufferRole::Inputs, inputs),
        (BufferRole::Positions, 12 * vertices),
        (BufferRole::Normals, 12 * corners),
    ];
    if needs.normal_maps {
        let rigid = 64 * first_with_normals;
        let bytes = if needs.exact_normals { 16 * normal_tables::tangent_count(scene) as u64 } else { rigid };
        buffers.push((BufferRole::RestTangents, bytes));
        buffers.push((BufferRole::Tangents, 16 * corners));
    }
    if needs.displacements {
        buffers.push((BufferRole::Displacements, 12 * vertices));
    }
    if !work.batched.blocks.is_empty() {
        buffers.push((BufferRole::Batches, batch::bytes(&work.batched)));
    }
    let (segments, domain_boxes) = boxes::bytes(segments.len());
    if needs.boxes {
        buffers.extend([(BufferRole::BoxSegments, segments), (BufferRole::DomainBoxes, domain_boxes)]);
    }
    if needs.exact_normals {
        let counts = RingCounts::of(scene);
        buffers.push((BufferRole::CornerSlots, domains * size_of::<NormalSlot>() as u64));
        buffers.push((BufferRole::CornerBlocks, 4 * (u64::from(blocks(layout.corners)) + 1)));
        buffers.push((BufferRole::CornerGroups, 4 * counts.members));
        buffers.push((BufferRole::RingTables, 4 * (counts.groups + 1 + counts.rings)));
        buffers.push((BufferRole::GroupNormals, 12 * counts.groups));
    }
    if needs.followers {
        let frames = size_of_val(scene.movers.frames()) + size_of_val(transform_links(scene).as_slice());
        buffers.push((BufferRole::FollowerFrames, frames as u64));
    }
    let changes = match max_change_entries(scene) {
        0 => 0,
        most => (size_of::<Change>() + 48) * most + 4 * (coordinates.total + work.tiles.len()),
    };
    DeformPlan {
        kernels,
        buffers: buffers.into_iter().map(|(role, bytes)| BufferDescriptor { role, bytes }).collect(),
        bytes_in: inputs,
        bytes_out: if scene.light_axes().is_some() { 48 } else { 24 },
        change_list_bytes: changes as u64,
        omitted: omitted(
            scene,
            !work.batched.blocks.is_empty(),
            [16 * (rest_corners + corners), 12 * vertices, segments + domain_boxes],
        ),
    }
}

/// The macro of a storage type.
pub const fn storage_define(storage: StorageType) -> Option<&'static str> {
    match storage {
        StorageType::F32 => None,
        StorageType::F16 => Some(STORAGE_DEFINES[0]),
        StorageType::Bf16 => Some(STORAGE_DEFINES[1]),
        StorageType::Int8 => Some(STORAGE_DEFINES[2]),
    }
}

/// Whether a lane computes one item instead of four.
pub(super) const fn has_one_item_per_lane(work: &WorkList) -> bool {
    work.full_step_tiles < MIN_FOUR_ITEM_TILES
}

/// Threads per block of `deform`: 32 WARPS of its source, which the launcher verifies.
fn block_threads(defines: &[&str]) -> u32 {
    let one = ["MODES", "SHEAR", "TILE_LIST"].iter().any(|macro_name| defines.contains(macro_name));
    TILE_QUADS as u32 * if one { 1 } else { 2 }
}

fn kernels(scene: &Scene, work: &WorkList, segments: &[BoxSegment]) -> Vec<KernelDescriptor> {
    let needs = scene.needs;
    let [deform, batch, bounds, apply, normals] = KERNELS;
    let defines = deform_defines(scene, work);
    let threads = block_threads(&defines);
    let kind = KernelKind::Deform;
    let mut deform =
        KernelDescriptor { kind, name: deform.name, defines, blocks: 0, threads, source: KernelText(deform.source) };
    deform.blocks = super::deform::blocks(&deform, work.full_step_tiles);
    let walk = |kind, kernel: &KernelSource, blocks: usize| {
        let defines = [
            ("NORMAL_MAPS", needs.normal_maps),
            ("SHEAR", needs.shear),
            ("FOLLOWERS", needs.followers),
            ("LIGHT_BOUNDS", scene.light_axes().is_some()),
            ("DOMAIN_BOXES", needs.boxes),
        ];
        let on = defines.iter().filter(|(name, on)| *on && kernel.features.contains(name));
        let (defines, blocks) = (on.map(|(name, _)| *name).collect(), blocks as u32);
        KernelDescriptor { kind, name: kernel.name, defines, blocks, threads: BLOCK, source: KernelText(kernel.source) }
    };
    let few = (4 * work.tiles.len()).div_ceil(BLOCK as usize).min(MAX_GRID_BLOCKS / 4);
    // Eight threads reduce one piece of a domain and mostly wait for memory, so more blocks hide the latency.
    let many = segments.len().div_ceil(BLOCK as usize / 8).min(4 * MAX_GRID_BLOCKS);
    let boxes = if needs.boxes { few.max(many) } else { few };
    let batch = (!work.batched.blocks.is_empty()).then(|| batch::kernel(scene, &work.batched, batch));
    let mut kernels: Vec<KernelDescriptor> = batch.into_iter().chain([deform]).collect();
    kernels.push(walk(KernelKind::Bounds, &bounds, boxes));
    if needs.exact_normals {
        kernels.push(walk(KernelKind::Normals, &normals, blocks(scene.layout.corners) as usize));
    }
    let changes = max_change_entries(scene);
    if changes > 0 {
        kernels.push(walk(KernelKind::Apply, &apply, changes.div_ceil(BLOCK as usize / 32).min(MAX_GRID_BLOCKS)));
    }
    kernels
}

/// The macros of `deform`.
fn deform_defines(scene: &Scene, work: &WorkList) -> Vec<&'static str> {
    let (needs, has_rigid_normals) = (scene.needs, has_rigid_normals(scene));
    let flags = [
        ("MODES", needs.modes),
        ("ONE_ITEM_PER_LANE", has_one_item_per_lane(work)),
        ("MODE_TRUNCATION", needs.truncation),
        ("COMPENSATED_SUM", needs.compensated),
        ("DISPLACEMENTS", needs.displacements),
        ("RIGID_NORMALS", has_rigid_normals),
        ("CORNER_OFFSETS", !work.corner_offsets.is_empty()),
        ("NORMAL_MAPS", has_rigid_normals && needs.normal_maps),
        ("SHEAR", has_rigid_normals && needs.shear),
        ("FOLLOWERS", needs.followers),
    ];
    let on = flags.iter().filter(|(_, on)| *on).map(|(name, _)| *name);
    on.chain(storage_define(scene.deformation.storage).filter(|_| needs.modes)).collect()
}

/// Maximum number of blocks of the kernels that loop over lists: two per multiprocessor of a large device.
const MAX_GRID_BLOCKS: usize = 264;

fn omitted(scene: &Scene, batched: bool, [tangents, displacements, boxes]: [u64; 3]) -> Vec<OmittedFeature> {
    let needs = scene.needs;
    let more = size_of::<NormalSlot>() * scene.domains.len();
    let exact_normals = OmittedFeature {
        feature: "exact_normals",
        what: "`normals` behind `deform`, and its rings",
        bytes: RingCounts::possible_corner_group_bytes(scene) + more as u64,
    };
    let all = [
        (needs.modes, OmittedFeature { feature: "modes", what: "the sum U q in `deform`", bytes: 0 }),
        (
            needs.normal_maps,
            OmittedFeature { feature: "normal_maps", what: "tangents and their two buffers", bytes: tangents },
        ),
        (needs.shear, OmittedFeature { feature: "shear", what: "the inverse transpose", bytes: 0 }),
        (needs.truncation, OmittedFeature { feature: "truncation", what: "lists of modes in `deform`", bytes: 0 }),
        (needs.exact_normals, exact_normals),
        (needs.compensated, OmittedFeature { feature: "compensated", what: "the compensation in `deform`", bytes: 0 }),
        (
            needs.followers,
            OmittedFeature { feature: "followers", what: "frames, and products of transforms", bytes: 0 },
        ),
        (
            needs.displacements,
            OmittedFeature { feature: "displacements", what: "u as an output of `deform`", bytes: displacements },
        ),
        (scene.light_axes().is_some(), OmittedFeature { feature: "shadows", what: "bounds in light space", bytes: 0 }),
        (needs.boxes, OmittedFeature { feature: "boxes", what: "a box of each domain in `bounds`", bytes: boxes }),
    ];
    let batches = OmittedFeature { feature: "batches", what: "`batch`, and groups of domains", bytes: 0 };
    let all = all.into_iter().chain([(batched, batches)]);
    all.filter(|(require_kernel, _)| !require_kernel).map(|(_, part)| part).collect()
}

/// Number of blocks that cover so many corners.
fn blocks(items: usize) -> u32 {
    items.div_ceil(BLOCK as usize) as u32
}

impl DeformPlan {
    /// Bytes of a buffer; 0 when the scene does not have it.
    pub fn bytes(&self, role: BufferRole) -> u64 {
        self.buffers.iter().filter(|buffer| buffer.role == role).map(|buffer| buffer.bytes).sum()
    }

    /// Bytes of all buffers, outputs included.
    pub fn total_bytes(&self) -> u64 {
        self.buffers.iter().map(|buffer| buffer.bytes).sum()
    }

    /// The kernel of a launch, if the scene has it.
    pub fn kernel(&self, kind: KernelKind) -> Option<&KernelDescriptor> {
        self.kernels.iter().find(|kernel| kernel.kind == kind)
    }

    /// The kernel of a launch that every scene has.
    pub fn require_kernel(&self, kind: KernelKind) -> Result<&KernelDescriptor> {
        let missing = || Error::Fault { stage: "plan", reason: format!("no kernel for {kind:?}") };
        self.kernel(kind).ok_or_else(missing)
    }

    /// Maximum number of kernel launches of one step, for any number of domains.
    pub fn launches(&self) -> usize {
        // A full step may launch `batch` but not `apply`; a partial step may launch `apply` but not `batch`.
        let whole = self.kernels.iter().filter(|kernel| kernel.kind != KernelKind::Apply).count();
        let listed = self.kernels.iter().filter(|kernel| kernel.kind != KernelKind::Batch).count();
        if self.kernel(KernelKind::Apply).is_some() { whole.max(listed) } else { whole }
    }
}

#[cfg(test)]
mod tests;
