//! Scene to what a step costs on the device: kernels with their defines, buffers in bytes, launches and copies. Pure.

use serde::Serialize;

use super::apply::most_changes;
use super::inputs::Sizes;
use super::layout::{BLOCK, Change, Lane, NormalSlot, Tile};
use super::pack;
use super::rings::Counts;
use super::work::{Coordinates, Work, orients};
use crate::error::{Error, Result};
use crate::scene::{Scene, Storage};
use crate::storage::TILE_QUADS;

/// A kernel file and the macros that switch parts of it on.
#[derive(Debug)]
pub(super) struct KernelSource {
    pub name: &'static str,
    pub source: &'static str,
    pub features: &'static [&'static str],
}

/// All kernels there are.
pub(super) const KERNELS: [KernelSource; 4] = [
    KernelSource {
        name: "deform",
        source: include_str!("../../kernels/deform.cu"),
        features: &["MODES", "NARROW", "TRUNCATED", "COMPENSATED", "ORIENT", "SHIFTED", "NORMAL_MAPS", "SHEAR"],
    },
    KernelSource { name: "bounds", source: include_str!("../../kernels/bounds.cu"), features: &[] },
    KernelSource { name: "apply", source: include_str!("../../kernels/apply.cu"), features: &[] },
    KernelSource {
        name: "normals",
        source: include_str!("../../kernels/normals.cu"),
        features: &["NORMAL_MAPS", "SHEAR"],
    },
];

/// The macros that choose what U is stored in; none for f32.
pub(super) const STORAGES: [&str; 3] = ["STORE_F16", "STORE_BF16", "STORE_INT8"];

/// Tiles below which a lane takes one vertex instead of four, because the device would not be filled: eight warps for
/// each multiprocessor of a large device.
const FEW_TILES: usize = 1024;

/// What a launch is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Launch {
    Deform,
    Bounds,
    /// Normals that follow the surface.
    Normals,
    /// In steps that change few domains, before all others; in scenes where there can be such steps.
    Apply,
}

/// A kernel as one scene compiles it; launched at most once a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Kernel {
    pub launch: Launch,
    pub name: &'static str,
    /// Macros that switch parts of it on.
    pub defines: Vec<&'static str>,
    pub blocks: u32,
    pub threads: u32,
    #[serde(skip)]
    pub(super) source: Source,
}

/// The text of a kernel file; its name says enough where a kernel is shown.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Source(pub(super) &'static str);

impl std::fmt::Debug for Source {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "{} bytes", self.0.len())
    }
}

/// What a device buffer holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// U of every shape, in tiles.
    Words,
    /// x0 of every shape.
    Rest,
    /// Scales of U, with `Int8`.
    Scales,
    /// The work of each warp, and a list of some of it where there can be lists.
    Tiles,
    Lanes,
    /// From vertices to corners, per domain; where they differ.
    CornerShifts,
    /// A box of each warp's vertices.
    Boxes,
    /// The step that last changed each domain.
    Stamps,
    RestNormals,
    RestTangents,
    /// The smoothing group of each corner, where normals follow the surface.
    Members,
    /// Vertices around each group, and where they begin.
    Rings,
    /// The geometric normal of each group at rest.
    GroupNormals,
    /// Where each domain's corners lie.
    CornerSlots,
    /// The first domain of each block of corners.
    CornerBlocks,
    /// Header, transforms and q of a step.
    Inputs,
    Positions,
    Normals,
    Tangents,
}

/// One device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Buffer {
    pub role: Role,
    pub bytes: u64,
}

/// A part that the scene does without.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LeftOut {
    /// The flag of [`crate::scene::Needs`] that is off.
    pub feature: &'static str,
    /// What is not compiled, computed or stored.
    pub what: &'static str,
    /// Device bytes that are not allocated, as far as they are known: rings that are not made have no length.
    pub bytes: u64,
}

/// What the CUDA deformer compiles, allocates and launches for a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Plan {
    /// Those that the scene has, in the order in which a step launches them; `apply` is first where it is launched.
    pub kernels: Vec<Kernel>,
    pub buffers: Vec<Buffer>,
    /// Bytes to the device and from it in each step, besides the vertices themselves.
    pub bytes_in: u64,
    pub bytes_out: u64,
    /// Pinned bytes of the list of changed domains; 0 for a scene whose steps are always whole.
    pub bytes_of_changes: u64,
    pub left_out: Vec<LeftOut>,
}

/// Where everything lies: made once, planned from and then uploaded.
#[derive(Debug)]
pub(super) struct Tables {
    pub coordinates: Coordinates,
    pub work: Work,
}

impl Tables {
    pub(super) fn new(scene: &Scene) -> Self {
        let coordinates = Coordinates::new(scene);
        Self { work: Work::new(scene, &coordinates), coordinates }
    }
}

/// What a scene costs.
pub fn plan(scene: &Scene) -> Plan {
    plan_of(scene, &Tables::new(scene))
}

/// The same from tables that are there.
pub(super) fn plan_of(scene: &Scene, Tables { coordinates, work }: &Tables) -> Plan {
    let needs = scene.needs;
    let layout = &scene.layout;
    let kernels = kernels(scene, work);
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
    if needs.exact_normals {
        let counts = Counts::of(scene);
        buffers.push((Role::CornerSlots, domains * size_of::<NormalSlot>() as u64));
        buffers.push((Role::CornerBlocks, 4 * (u64::from(blocks(layout.corners)) + 1)));
        buffers.push((Role::Members, 4 * counts.members));
        buffers.push((Role::Rings, 4 * (counts.groups + 1 + counts.rings)));
        buffers.push((Role::GroupNormals, 12 * counts.groups));
    }
    let changes = match most_changes(scene) {
        0 => 0,
        most => (size_of::<Change>() + 48) * most + 4 * (coordinates.total + work.tiles.len()),
    };
    Plan {
        kernels,
        buffers: buffers.into_iter().map(|(role, bytes)| Buffer { role, bytes }).collect(),
        bytes_in: inputs,
        bytes_out: 24,
        bytes_of_changes: changes as u64,
        left_out: left_out(scene, 16 * (rest_corners + corners)),
    }
}

/// The macro of a storage type.
pub(super) const fn storage_define(storage: Storage) -> Option<&'static str> {
    match storage {
        Storage::F32 => None,
        Storage::F16 => Some(STORAGES[0]),
        Storage::Bf16 => Some(STORAGES[1]),
        Storage::Int8 => Some(STORAGES[2]),
    }
}

/// Whether a lane takes one item instead of four.
pub(super) const fn is_narrow(work: &Work) -> bool {
    work.tiles.len() < FEW_TILES
}

/// Threads of a block of `deform`: WARPS in its source, which the launcher compares.
fn threads_of(defines: &[&str]) -> u32 {
    let one = ["MODES", "SHEAR", "LISTED"].iter().any(|macro_name| defines.contains(macro_name));
    TILE_QUADS as u32 * if one { 1 } else { 2 }
}

fn kernels(scene: &Scene, work: &Work) -> Vec<Kernel> {
    let needs = scene.needs;
    let [deform, bounds, apply, normals] = KERNELS;
    let defines = deform_defines(scene, work);
    let threads = threads_of(&defines);
    let warps = work.tiles.len() * if is_narrow(work) { 4 } else { 1 };
    let blocks_of_tiles = warps.div_ceil(threads as usize / TILE_QUADS) as u32;
    let launch = Launch::Deform;
    let deform =
        Kernel { launch, name: deform.name, defines, blocks: blocks_of_tiles, threads, source: Source(deform.source) };
    let walk = |launch, kernel: &KernelSource, blocks: usize| {
        let defines = [("NORMAL_MAPS", needs.normal_maps), ("SHEAR", needs.shear)];
        let on = defines.iter().filter(|(name, on)| *on && kernel.features.contains(name));
        let (defines, blocks) = (on.map(|(name, _)| *name).collect(), blocks as u32);
        Kernel { launch, name: kernel.name, defines, blocks, threads: BLOCK, source: Source(kernel.source) }
    };
    let boxes = (4 * work.tiles.len()).div_ceil(BLOCK as usize).min(MOST_BLOCKS / 4);
    let mut kernels = vec![deform, walk(Launch::Bounds, &bounds, boxes)];
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
        ("ORIENT", orients),
        ("SHIFTED", !work.corner_shifts.is_empty()),
        ("NORMAL_MAPS", orients && needs.normal_maps),
        ("SHEAR", orients && needs.shear),
    ];
    let on = flags.iter().filter(|(_, on)| *on).map(|(name, _)| *name);
    on.chain(storage_define(scene.deformation.storage).filter(|_| needs.modes)).collect()
}

/// Blocks of the kernels that walk over lists: two for each multiprocessor of a large device.
const MOST_BLOCKS: usize = 264;

fn left_out(scene: &Scene, tangent_bytes: u64) -> Vec<LeftOut> {
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
            LeftOut { feature: "normal_maps", what: "tangents and their two buffers", bytes: tangent_bytes },
        ),
        (needs.shear, LeftOut { feature: "shear", what: "the inverse transpose", bytes: 0 }),
        (needs.truncation, LeftOut { feature: "truncation", what: "lists of modes in `deform`", bytes: 0 }),
        (needs.exact_normals, exact_normals),
        (needs.compensated, LeftOut { feature: "compensated", what: "the compensation in `deform`", bytes: 0 }),
    ];
    all.into_iter().filter(|(needed, _)| !needed).map(|(_, part)| part).collect()
}

/// Blocks that cover so many corners.
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
    pub(super) fn needed(&self, launch: Launch) -> Result<&Kernel> {
        let missing = || Error::Fault { stage: "plan", reason: format!("no kernel for {launch:?}") };
        self.kernel(launch).ok_or_else(missing)
    }

    /// The most kernel launches of one step, whatever the number of domains.
    pub const fn launches(&self) -> usize {
        self.kernels.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::pack::tests::{deformed, exact, scene, stored};
    use super::super::rings::Rings;
    use super::*;
    use crate::scene::Deformation;

    fn defines(plan: &Plan) -> Vec<(&str, Vec<&str>)> {
        plan.kernels.iter().map(|kernel| (kernel.name, kernel.defines.clone())).collect()
    }

    #[test]
    fn a_scene_without_modes_normal_maps_and_shear_compiles_none_of_their_branches() {
        let bare = plan(&scene(&[(7, 0), (300, 0)], false, true));
        assert_eq!(
            defines(&bare),
            [("deform", vec!["NARROW", "ORIENT", "SHIFTED"]), ("bounds", vec![]), ("apply", vec![])]
        );
        assert_eq!(bare.bytes(Role::Tangents) + bare.bytes(Role::RestTangents), 0);
        assert_eq!((bare.bytes(Role::Words), bare.bytes(Role::Scales)), (0, 0));
        assert_eq!(bare.bytes_in, 80 + 48 * 4, "a header and four transforms, no q");
        let left_out: Vec<_> = bare.left_out.iter().map(|part| part.feature).collect();
        assert_eq!(left_out, ["modes", "normal_maps", "shear", "truncation", "exact_normals", "compensated"]);
        assert_eq!(bare.left_out[1].bytes, 16 * (311 + 622), "rest and world tangents of every corner");
    }

    #[test]
    fn a_scene_that_needs_more_leaves_less_out() {
        let full = plan(&scene(&[(7, 2), (300, 0)], true, false));
        assert_eq!(full.kernels[0].defines, ["MODES", "NARROW", "ORIENT", "SHIFTED", "NORMAL_MAPS", "SHEAR"]);
        assert_eq!(full.bytes(Role::Tangents), 16 * 2 * (9 + 302));
        assert_eq!(full.bytes(Role::RestTangents), 64 * (3 + 76), "a quad of four corners each");
        assert_eq!(full.bytes_in, 80 + 48 * 4 + 4 * 4);
        assert_eq!(full.left_out.len(), 3);
    }

    #[test]
    fn storage_decides_the_bytes_of_u_and_the_macro_that_reads_it() {
        let bytes = |storage| {
            let plan = plan(&stored(&[(300, 8)], storage));
            assert_eq!(plan.kernels[0].defines.last().copied(), storage_define(storage).or(Some("SHEAR")));
            plan.bytes(Role::Words)
        };
        assert_eq!(Storage::ALL.map(bytes), [75 * 48 * 8, 75 * 48 * 4, 75 * 48 * 4, 75 * 48 * 2]);
    }

    #[test]
    fn exact_normals_come_behind_the_positions_and_their_tables_are_planned() {
        let scene = exact(&[(7, 2), (300, 0), (513, 4)]);
        let (plan, rings) = (plan(&scene), Rings::new(&scene));
        let normals = plan.kernel(Launch::Normals).expect("asked for");
        assert_eq!((normals.name, normals.defines.as_slice()), ("normals", ["SHEAR"].as_slice()));
        assert_eq!(plan.kernels[0].defines, ["MODES", "NARROW"]);
        assert_eq!(plan.launches(), 4);
        for (role, bytes) in [
            (Role::CornerSlots, size_of_val(super::super::rings::slots(&scene).as_slice())),
            (Role::Members, size_of_val(rings.members.as_slice())),
            (Role::Rings, size_of_val(rings.begins.as_slice()) + size_of_val(rings.rings.as_slice())),
            (Role::GroupNormals, size_of_val(rings.normals.as_slice())),
        ] {
            assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
        }
        assert_eq!(plan.bytes(Role::Members), 4 * (9 + 515), "the shape without modes has no groups");
        let rigid = super::plan(&stored(&[(7, 2), (300, 0), (513, 4)], Storage::F32));
        assert_eq!(rigid.bytes(Role::Members) + rigid.bytes(Role::Rings) + rigid.bytes(Role::GroupNormals), 0);
        let left_out = rigid.left_out.iter().find(|part| part.feature == "exact_normals").expect("left out");
        assert_eq!(left_out.bytes, 4 * (9 + 515) + 20 * 6, "members and slots");
    }

    #[test]
    fn launches_do_not_grow_with_the_number_of_domains() {
        let (few, many) = (scene(&[(7, 1)], false, false), scene(&[(7, 1); 3000], false, false));
        assert_eq!((plan(&few).launches(), plan(&many).launches()), (2, 3));
    }

    #[test]
    fn a_scene_whose_steps_are_always_whole_plans_nothing_for_lists() {
        let lists = |scene: &Scene| {
            let plan = plan(scene);
            assert_eq!(plan.kernel(Launch::Apply).is_some(), plan.bytes_of_changes > 0);
            plan.bytes_of_changes > 0
        };
        // Two instances of each shape.
        assert!(!lists(&scene(&[(7, 1)], false, false)), "a quarter of two domains is none");
        assert!(lists(&scene(&[(7, 1), (7, 1)], false, false)));
        let truncated = Deformation { truncation: Some(0.1), ..Deformation::default() };
        assert!(!lists(&deformed(&[(7, 1), (7, 1)], truncated)), "the kept modes go with the whole state");
    }

    #[test]
    fn planned_bytes_are_those_of_the_tables() {
        let scene = scene(&[(7, 2), (300, 0), (513, 4)], true, false);
        let plan = plan(&scene);
        let work = Work::new(&scene, &Coordinates::new(&scene));
        for (role, bytes) in [
            (Role::Tiles, size_of_val(work.tiles.as_slice()) + 4 * work.tiles.len()),
            (Role::Lanes, size_of_val(work.lanes.as_slice())),
            (Role::CornerShifts, size_of_val(work.corner_shifts.as_slice())),
        ] {
            assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
        }
        assert_eq!(plan.total_bytes(), plan.buffers.iter().map(|buffer| buffer.bytes).sum::<u64>());
    }
}
