//! The kernels of a step: their sources, and the macros and grid sizes for a scene.
//!
//! A tile is the work of one warp of `deform`, up to 32 quads of four vertices. An item is a vertex or a corner.

use super::change_list::max_change_entries;
use super::device_tables::DeviceTables;
use super::layout::{BLOCK, WARP_THREADS};
use super::work::batches::{BatchTables, MAX_BATCH_SIZE};
use super::work::{WorkList, has_rigid_normals};
use crate::gpu::launch::{KernelDescriptor, KernelKind, KernelSource, KernelText};
use crate::storage::modes_per_chunk;
use modalcast_model::scene::{Scene, StorageType};

/// All kernels of a step.
pub(crate) const KERNELS: [KernelSource; 5] = [
    KernelSource {
        name: "deform",
        source: include_str!("../../../../kernels/deform.cu"),
        features: &[
            "MODES",
            "ONE_ITEM_PER_LANE",
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
        source: include_str!("../../../../kernels/batch.cu"),
        features: &["FOLLOWERS", "BATCH_8", "BATCH_4"],
    },
    KernelSource {
        name: "bounds",
        source: include_str!("../../../../kernels/bounds.cu"),
        features: &["ORIENTED_BOUNDS", "DOMAIN_BOXES"],
    },
    KernelSource { name: "apply", source: include_str!("../../../../kernels/apply.cu"), features: &["FOLLOWERS"] },
    KernelSource {
        name: "normals",
        source: include_str!("../../../../kernels/normals.cu"),
        features: &["NORMAL_MAPS", "SHEAR", "FOLLOWERS"],
    },
];

/// The macros that select the storage type of U; f32 has none.
pub(crate) const STORAGE_DEFINES: [&str; 3] = ["STORE_F16", "STORE_BF16", "STORE_INT8"];

/// Below this number of tiles, a lane of `deform` computes one item instead of four, and four warps share a tile: one
/// warp per tile would not fill the device. 1024 is about eight warps for each of 132 multiprocessors.
const MIN_FOUR_ITEM_TILES: usize = 1024;

/// Up to this number of tiles, `deform` has one warp per axis for each 32 vertices (AXIS_PER_WARP): the latency of memory
/// dominates, and three times as many lanes load all of U at once. A tile has four blocks, and 132 multiprocessors have
/// 660 resident blocks: with more tiles, some blocks would start late.
const MAX_AXIS_PER_WARP_TILES: usize = 160;

/// The macro that gives each axis of the sum U q a warp of its own; needs MODES and ONE_ITEM_PER_LANE.
pub(crate) const AXIS_PER_WARP: &str = "AXIS_PER_WARP";

/// Group sizes below [`MAX_BATCH_SIZE`]: the maximum number of domains of a group, and the macro that compiles `batch`
/// for it. In ascending order.
const SMALLER_BATCHES: [(usize, &str); 2] = [(4, "BATCH_4"), (8, "BATCH_8")];

/// Warps per block of `batch`.
pub(crate) const BATCH_WARPS: usize = 2;
/// Bytes per warp: `WarpStorage` (9984) and `WarpSlice` (72) in `kernels/batch_load.cuh`.
const WARP_BYTES: usize = 9984 + 72;
/// Bytes of a transform (48) and a `BatchMember` (16), per member.
const MEMBER_BYTES: usize = 64;

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
pub(crate) const fn has_one_item_per_lane(work: &WorkList) -> bool {
    work.full_step_tiles < MIN_FOUR_ITEM_TILES
}

/// Whether each axis of the sum U q has a warp of its own. The variant reads U as f32.
fn has_axis_per_warp(scene: &Scene, work: &WorkList) -> bool {
    scene.features.modes
        && scene.deformation.storage == StorageType::F32
        && work.full_step_tiles <= MAX_AXIS_PER_WARP_TILES
}

/// Threads per block of `deform`. Twin of the constant WARPS in `kernels/deform.cu`. The launcher compares the number
/// of threads with the compiled kernel. TILE_LIST selects the variant for the tile lists of partial steps.
fn block_threads(defines: &[&str]) -> u32 {
    let has_one_warp = ["MODES", "SHEAR", "TILE_LIST"].iter().any(|name| defines.contains(name));
    let warps = match (defines.contains(&AXIS_PER_WARP), has_one_warp) {
        (true, _) => 3,
        (false, true) => 1,
        (false, false) => 2,
    };
    WARP_THREADS * warps
}

/// Number of blocks of `deform` for a number of tiles.
pub(crate) fn deform_blocks(kernel: &KernelDescriptor, tile_count: usize) -> u32 {
    let slices = tile_count * if kernel.defines.contains(&"ONE_ITEM_PER_LANE") { 4 } else { 1 };
    let warps = slices * if kernel.defines.contains(&AXIS_PER_WARP) { 3 } else { 1 };
    warps.div_ceil((kernel.threads / WARP_THREADS) as usize) as u32
}

/// The kernels of a scene in launch order. Exception: `apply` is last in the list, but a partial step launches it
/// first.
pub(crate) fn plan_kernels(scene: &Scene, tables: &DeviceTables) -> Vec<KernelDescriptor> {
    let (features, work, segments) = (scene.features, &tables.work, &tables.segments);
    let [deform, batch, bounds, apply, normals] = KERNELS;
    let describe = |kind, kernel: &KernelSource, blocks: usize| {
        let flags = [
            ("NORMAL_MAPS", features.normal_maps),
            ("SHEAR", features.shear),
            ("FOLLOWERS", features.followers),
            ("ORIENTED_BOUNDS", tables.bounding_axes.is_some()),
            ("DOMAIN_BOXES", features.boxes),
        ];
        let is_defined = |(name, is_used): &&(&'static str, bool)| *is_used && kernel.features.contains(name);
        let defines = flags.iter().filter(is_defined).map(|(name, _)| *name).collect();
        let (blocks, source) = (blocks as u32, KernelText(kernel.source));
        KernelDescriptor { kind, name: kernel.name, defines, blocks, threads: BLOCK, source }
    };
    let box_blocks = (4 * work.tiles.len()).div_ceil(BLOCK as usize).min(MAX_GRID_BLOCKS / 4);
    // Eight threads reduce one segment. They mostly wait for memory, so more blocks hide the latency.
    let segment_blocks = segments.len().div_ceil(BLOCK as usize / 8).min(4 * MAX_GRID_BLOCKS);
    let bounds_blocks = if features.boxes { box_blocks.max(segment_blocks) } else { box_blocks };
    let batch = (!work.batched.blocks.is_empty()).then(|| describe_batch(scene, &work.batched, batch));
    let mut kernels: Vec<KernelDescriptor> = batch.into_iter().chain([describe_deform(scene, work, deform)]).collect();
    kernels.push(describe(KernelKind::Bounds, &bounds, bounds_blocks));
    if features.exact_normals {
        kernels.push(describe(KernelKind::Normals, &normals, scene.layout.corners.div_ceil(BLOCK as usize)));
    }
    let max_changes = max_change_entries(scene);
    if max_changes > 0 {
        let apply_blocks = max_changes.div_ceil((BLOCK / WARP_THREADS) as usize).min(MAX_GRID_BLOCKS);
        kernels.push(describe(KernelKind::Apply, &apply, apply_blocks));
    }
    kernels
}

/// The kernel `deform` of a scene.
fn describe_deform(scene: &Scene, work: &WorkList, source: KernelSource) -> KernelDescriptor {
    let defines = deform_defines(scene, work);
    let mut kernel = KernelDescriptor {
        kind: KernelKind::Deform,
        name: source.name,
        threads: block_threads(&defines),
        defines,
        blocks: 0,
        source: KernelText(source.source),
    };
    kernel.blocks = deform_blocks(&kernel, work.full_step_tiles);
    kernel
}

/// The macros of `deform`.
fn deform_defines(scene: &Scene, work: &WorkList) -> Vec<&'static str> {
    let (features, has_rigid_normals) = (scene.features, has_rigid_normals(scene));
    let flags = [
        ("MODES", features.modes),
        ("ONE_ITEM_PER_LANE", has_one_item_per_lane(work)),
        (AXIS_PER_WARP, has_axis_per_warp(scene, work)),
        ("COMPENSATED_SUM", features.compensated),
        ("DISPLACEMENTS", features.displacements),
        ("RIGID_NORMALS", has_rigid_normals),
        ("CORNER_OFFSETS", !work.corner_offsets.is_empty()),
        ("NORMAL_MAPS", has_rigid_normals && features.normal_maps),
        ("SHEAR", has_rigid_normals && features.shear),
        ("FOLLOWERS", features.followers),
    ];
    let defines = flags.iter().filter(|(_, is_used)| *is_used).map(|(name, _)| *name);
    defines.chain(storage_define(scene.deformation.storage).filter(|_| features.modes)).collect()
}

/// Two blocks on each of 132 multiprocessors, as many as an H200 has. The maximum grids of kernels that loop over lists
/// are multiples or fractions of this number.
const MAX_GRID_BLOCKS: usize = 264;

/// The kernel `batch` of a scene with batches.
fn describe_batch(scene: &Scene, batched: &BatchTables, source: KernelSource) -> KernelDescriptor {
    let size_define = SMALLER_BATCHES.iter().find(|(size, _)| batched.max_members <= *size).map(|(_, name)| *name);
    let followers_define = scene.features.followers.then_some("FOLLOWERS");
    let defines = storage_define(scene.deformation.storage).into_iter().chain(size_define).chain(followers_define);
    KernelDescriptor {
        kind: KernelKind::Batch,
        name: source.name,
        defines: defines.collect(),
        blocks: batched.blocks.len() as u32,
        threads: WARP_THREADS * BATCH_WARPS as u32,
        source: KernelText(source.source),
    }
}

/// Maximum group size of the kernel compiled with these macros.
fn batch_size(defines: &[&str]) -> usize {
    SMALLER_BATCHES.iter().find(|(_, name)| defines.contains(name)).map_or(MAX_BATCH_SIZE, |(size, _)| *size)
}

/// Shared memory of a block of `batch` in bytes: storage of each warp, T and the members, and q.
pub(crate) fn batch_shared_bytes(batched: &BatchTables, defines: &[&str]) -> usize {
    let is_defined = |storage: &StorageType| storage_define(*storage).is_some_and(|name| defines.contains(&name));
    let storage = StorageType::ALL.into_iter().find(is_defined).unwrap_or_default();
    let (batch_size, mode_count) = (batch_size(defines), batched.max_chunks * modes_per_chunk(storage));
    BATCH_WARPS * WARP_BYTES + MEMBER_BYTES * batch_size + 4 * batch_size * mode_count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_memory_holds_all_modes_of_a_batch() {
        let tables = |max_chunks| BatchTables { max_chunks, ..BatchTables::default() };
        // 64 KiB is the shared memory of the smallest supported device.
        assert!(batch_shared_bytes(&tables(modalcast_model::domain::MAX_RANK), &[]) <= 64 << 10);
        assert_eq!(batch_shared_bytes(&tables(0), &["BATCH_4"]), BATCH_WARPS * WARP_BYTES + 64 * 4);
        // Three chunks of four modes, for 16 members, four bytes each.
        let q_bytes = batch_shared_bytes(&tables(3), &["STORE_INT8"]) - batch_shared_bytes(&tables(0), &[]);
        assert_eq!(q_bytes, 4 * 16 * 12);
    }
}
