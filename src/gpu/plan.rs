//! Scene to what a step costs on the device: kernels with their defines, buffers in bytes, launches and copies. Pure.

use serde::Serialize;

use super::apply::most_changes;
use super::inputs::Sizes;
use super::layout::{BLOCK, Change, CornerSlot, Lane, NormalSlot, Tile};
use super::pack;
use super::rings::Counts;
use super::work::{Coordinates, Work};
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
pub(super) const KERNELS: [KernelSource; 5] = [
    KernelSource {
        name: "deform",
        source: include_str!("../../kernels/deform.cu"),
        features: &["MODES", "NARROW", "TRUNCATED", "COMPENSATED"],
    },
    KernelSource { name: "bounds", source: include_str!("../../kernels/bounds.cu"), features: &[] },
    KernelSource {
        name: "orient",
        source: include_str!("../../kernels/orient.cu"),
        features: &["NORMAL_MAPS", "SHEAR"],
    },
    KernelSource {
        name: "normals",
        source: include_str!("../../kernels/normals.cu"),
        features: &["NORMAL_MAPS", "SHEAR"],
    },
    KernelSource { name: "apply", source: include_str!("../../kernels/apply.cu"), features: &[] },
];

/// The macros that choose what U is stored in; none for f32.
pub(super) const STORAGES: [&str; 3] = ["STORE_F16", "STORE_BF16", "STORE_INT8"];

/// Tiles below which a lane takes one vertex instead of four, because the device would not be filled: eight warps for
/// each multiprocessor of a large device.
const FEW_TILES: usize = 1024;

/// A kernel as one scene compiles it; launched at most once a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Kernel {
    pub name: &'static str,
    /// Macros that switch parts of it on.
    pub defines: Vec<&'static str>,
    pub blocks: u32,
    pub threads: u32,
    #[serde(skip)]
    pub(super) source: &'static str,
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
    /// The work of each warp.
    Tiles,
    Lanes,
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
    /// Launched in this order, each once a step; `apply` only in steps that change few domains.
    pub kernels: Vec<Kernel>,
    pub buffers: Vec<Buffer>,
    /// Bytes to the device and from it in each step, besides the vertices themselves.
    pub bytes_in: u64,
    pub bytes_out: u64,
    /// Pinned bytes of the list of changed domains.
    pub bytes_of_changes: u64,
    pub left_out: Vec<LeftOut>,
}

/// What a scene costs.
pub fn plan(scene: &Scene) -> Plan {
    let needs = scene.needs;
    let layout = &scene.layout;
    let coordinates = Coordinates::new(scene);
    let work = Work::new(scene, &coordinates);
    let kernels = kernels(scene, &work);
    let rest_corners = pack::rest_corners(scene) as u64;
    let (vertices, corners) = (layout.vertices as u64, layout.corners as u64);
    let domains = scene.domains.len() as u64;
    let inputs = Sizes::of(scene, &coordinates).total();
    let corner_slot = if needs.exact_normals { size_of::<NormalSlot>() } else { size_of::<CornerSlot>() };
    let mut buffers = vec![
        (Role::Words, 16 * work.words),
        (Role::Rest, 48 * work.rest),
        (Role::Scales, 4 * work.scales),
        (Role::Tiles, (work.tiles.len() * size_of::<Tile>()) as u64),
        (Role::Lanes, (work.lanes.len() * size_of::<Lane>() + 4 * work.lane_scales.len()) as u64),
        (Role::Boxes, 24 * u64::from(kernels[0].blocks)),
        (Role::Stamps, 4 * domains),
        (Role::RestNormals, 12 * rest_corners),
        (Role::CornerSlots, domains * corner_slot as u64),
        (Role::CornerBlocks, 4 * (u64::from(blocks(layout.corners)) + 1)),
        (Role::Inputs, inputs),
        (Role::Positions, 12 * vertices),
        (Role::Normals, 12 * corners),
    ];
    if needs.normal_maps {
        buffers.push((Role::RestTangents, 16 * pack::tangent_count(scene) as u64));
        buffers.push((Role::Tangents, 16 * corners));
    }
    if needs.exact_normals {
        let counts = Counts::of(scene);
        buffers.push((Role::Members, 4 * counts.members));
        buffers.push((Role::Rings, 4 * (counts.groups + 1 + counts.rings)));
        buffers.push((Role::GroupNormals, 12 * counts.groups));
    }
    let changes = (size_of::<Change>() + 48) * most_changes(scene.domains.len()) + 4 * coordinates.total;
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
const fn storage_define(storage: Storage) -> Option<&'static str> {
    match storage {
        Storage::F32 => None,
        Storage::F16 => Some(STORAGES[0]),
        Storage::Bf16 => Some(STORAGES[1]),
        Storage::Int8 => Some(STORAGES[2]),
    }
}

fn kernels(scene: &Scene, work: &Work) -> Vec<Kernel> {
    let needs = scene.needs;
    let narrow = work.tiles.len() < FEW_TILES;
    let flags = [
        ("MODES", needs.modes),
        ("NARROW", narrow),
        ("TRUNCATED", needs.truncation),
        ("COMPENSATED", needs.compensated),
        ("NORMAL_MAPS", needs.normal_maps),
        ("SHEAR", needs.shear),
    ];
    let compiled = |kernel: KernelSource, blocks: usize, threads: u32| {
        let on = flags.iter().filter(|(name, on)| *on && kernel.features.contains(name)).map(|(name, _)| *name);
        let storage = storage_define(scene.deformation.storage).filter(|_| needs.modes && kernel.name == "deform");
        Kernel {
            name: kernel.name,
            defines: on.chain(storage).collect(),
            blocks: blocks as u32,
            threads,
            source: kernel.source,
        }
    };
    let [deform, bounds, orient, normals, apply] = KERNELS;
    let directions = if needs.exact_normals { normals } else { orient };
    let warps = work.tiles.len() * if narrow { 4 } else { 1 };
    let boxes = warps.div_ceil(BLOCK as usize).min(MOST_BLOCKS);
    let changes = most_changes(scene.domains.len()).div_ceil(BLOCK as usize / 32).clamp(1, MOST_BLOCKS);
    vec![
        compiled(deform, warps, TILE_QUADS as u32),
        compiled(bounds, boxes, BLOCK),
        compiled(directions, blocks(scene.layout.corners) as usize, BLOCK),
        compiled(apply, changes, BLOCK),
    ]
}

/// Blocks of the kernels that walk over lists: two for each multiprocessor of a large device.
const MOST_BLOCKS: usize = 264;

fn left_out(scene: &Scene, tangent_bytes: u64) -> Vec<LeftOut> {
    let needs = scene.needs;
    let more = (size_of::<NormalSlot>() - size_of::<CornerSlot>()) * scene.domains.len();
    let exact_normals = LeftOut {
        feature: "exact_normals",
        what: "`normals` in the place of `orient`, and its rings",
        bytes: Counts::bytes_of_possible_members(scene) + more as u64,
    };
    let all = [
        (needs.modes, LeftOut { feature: "modes", what: "the sum U q in `deform`", bytes: 0 }),
        (
            needs.normal_maps,
            LeftOut {
                feature: "normal_maps",
                what: "tangents in `orient` and their two buffers",
                bytes: tangent_bytes,
            },
        ),
        (needs.shear, LeftOut { feature: "shear", what: "the inverse transpose in `orient`", bytes: 0 }),
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

    /// The most kernel launches of one step, whatever the number of domains.
    pub const fn launches(&self) -> usize {
        self.kernels.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::pack::tests::{exact, scene, stored};
    use super::super::rings::Rings;
    use super::*;

    fn defines(plan: &Plan) -> Vec<(&str, Vec<&str>)> {
        plan.kernels.iter().map(|kernel| (kernel.name, kernel.defines.clone())).collect()
    }

    #[test]
    fn a_scene_without_modes_normal_maps_and_shear_compiles_none_of_their_branches() {
        let bare = plan(&scene(&[(7, 0), (300, 0)], false, true));
        assert_eq!(
            defines(&bare),
            [("deform", vec!["NARROW"]), ("bounds", vec![]), ("orient", vec![]), ("apply", vec![])]
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
        assert_eq!(full.kernels[0].defines, ["MODES", "NARROW"]);
        assert_eq!(full.kernels[2].defines, ["NORMAL_MAPS", "SHEAR"]);
        assert_eq!(full.bytes(Role::Tangents), 16 * 2 * (9 + 302));
        assert_eq!(full.bytes(Role::RestTangents), 16 * 302, "only the shape with a normal map");
        assert_eq!(full.bytes_in, 80 + 48 * 4 + 4 * 4);
        assert_eq!(full.left_out.len(), 3);
    }

    #[test]
    fn storage_decides_the_bytes_of_u_and_the_macro_that_reads_it() {
        let bytes = |storage| {
            let plan = plan(&stored(&[(300, 8)], storage));
            assert_eq!(plan.kernels[0].defines.last().copied(), storage_define(storage).or(Some("NARROW")));
            plan.bytes(Role::Words)
        };
        assert_eq!(Storage::ALL.map(bytes), [75 * 48 * 8, 75 * 48 * 4, 75 * 48 * 4, 75 * 48 * 2]);
    }

    #[test]
    fn exact_normals_take_the_place_of_rigid_ones_and_their_tables_are_planned() {
        let scene = exact(&[(7, 2), (300, 0), (513, 4)]);
        let (plan, rings) = (plan(&scene), Rings::new(&scene));
        assert_eq!((plan.kernels[2].name, plan.kernels[2].defines.as_slice()), ("normals", ["SHEAR"].as_slice()));
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
        assert_eq!(left_out.bytes, 4 * (9 + 515) + 8 * 6, "members, and eight bytes more per slot");
    }

    #[test]
    fn launches_do_not_grow_with_the_number_of_domains() {
        let (few, many) = (scene(&[(7, 1)], false, false), scene(&[(7, 1); 3000], false, false));
        assert_eq!((plan(&few).launches(), plan(&many).launches()), (4, 4));
    }

    #[test]
    fn planned_bytes_are_those_of_the_tables() {
        let scene = scene(&[(7, 2), (300, 0), (513, 4)], true, false);
        let plan = plan(&scene);
        let work = Work::new(&scene, &Coordinates::new(&scene));
        let corner_slots = pack::corner_slots(&scene);
        let corner_blocks = pack::first_domains(corner_slots.iter().map(|slot| slot.first), scene.layout.corners);
        for (role, bytes) in [
            (Role::Tiles, size_of_val(work.tiles.as_slice())),
            (Role::Lanes, size_of_val(work.lanes.as_slice())),
            (Role::CornerSlots, size_of_val(corner_slots.as_slice())),
            (Role::CornerBlocks, size_of_val(corner_blocks.as_slice())),
            (Role::RestNormals, size_of_val(pack::rest_normals(&scene).as_slice())),
            (Role::RestTangents, size_of_val(pack::rest_tangents(&scene).as_slice())),
        ] {
            assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
        }
        assert_eq!(plan.total_bytes(), plan.buffers.iter().map(|buffer| buffer.bytes).sum::<u64>());
    }
}
