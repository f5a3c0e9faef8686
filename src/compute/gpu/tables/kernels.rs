//! The kernels of a step: their sources, and the macros and grids that a scene needs. Pure.

use super::change_list::max_change_entries;
use super::device_tables::DeviceTables;
use super::layout::BLOCK;
use super::work::batches::{BatchTables, MAX_BATCH_SIZE};
use super::work::{WorkList, has_rigid_normals};
use crate::gpu::launch::{KernelDescriptor, KernelKind, KernelSource, KernelText};
use crate::storage::{TILE_QUADS, modes_per_chunk};
use modalcast_model::scene::{Scene, StorageType};

/// All kernels of a step.
pub(crate) const KERNELS: [KernelSource; 5] = [
    KernelSource {
        name: "deform",
        source: include_str!("../../../../kernels/deform.cu"),
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

/// Below this number of tiles a lane computes one vertex instead of four, because the tiles would not fill the device:
/// eight warps for each multiprocessor of a large device.
const MIN_FOUR_ITEM_TILES: usize = 1024;

/// Smaller maximum group sizes (vectors q_b) that the kernel can be compiled for, with their macros; the default is
/// [`MAX_BATCH_SIZE`].
const SMALLER_BATCHES: [(usize, &str); 2] = [(4, "BATCH_4"), (8, "BATCH_8")];

/// Warps per block of `batch`, and bytes of shared memory: per warp, and per vector without its q.
pub(crate) const BATCH_WARPS: usize = 2;
const WARP_BYTES: usize = 9984 + 72;
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

/// Threads per block of `deform`: 32 WARPS of its source, which the launcher verifies.
fn block_threads(defines: &[&str]) -> u32 {
    let one = ["MODES", "SHEAR", "TILE_LIST"].iter().any(|macro_name| defines.contains(macro_name));
    TILE_QUADS as u32 * if one { 1 } else { 2 }
}

/// Number of blocks of `deform` for so many tiles.
pub(crate) fn deform_blocks(kernel: &KernelDescriptor, tiles: usize) -> u32 {
    let warps = tiles * if kernel.defines.contains(&"ONE_ITEM_PER_LANE") { 4 } else { 1 };
    warps.div_ceil(kernel.threads as usize / TILE_QUADS) as u32
}

/// The kernels of a scene in launch order, except `apply`, which is last.
pub(crate) fn kernels(scene: &Scene, tables: &DeviceTables) -> Vec<KernelDescriptor> {
    let (features, work, segments) = (scene.features, &tables.work, &tables.segments);
    let [deform, batch, bounds, apply, normals] = KERNELS;
    let defines = deform_defines(scene, work);
    let threads = block_threads(&defines);
    let kind = KernelKind::Deform;
    let mut deform =
        KernelDescriptor { kind, name: deform.name, defines, blocks: 0, threads, source: KernelText(deform.source) };
    deform.blocks = deform_blocks(&deform, work.full_step_tiles);
    let walk = |kind, kernel: &KernelSource, blocks: usize| {
        let defines = [
            ("NORMAL_MAPS", features.normal_maps),
            ("SHEAR", features.shear),
            ("FOLLOWERS", features.followers),
            ("ORIENTED_BOUNDS", tables.bounding_axes.is_some()),
            ("DOMAIN_BOXES", features.boxes),
        ];
        let on = defines.iter().filter(|(name, on)| *on && kernel.features.contains(name));
        let (defines, blocks) = (on.map(|(name, _)| *name).collect(), blocks as u32);
        KernelDescriptor { kind, name: kernel.name, defines, blocks, threads: BLOCK, source: KernelText(kernel.source) }
    };
    let few = (4 * work.tiles.len()).div_ceil(BLOCK as usize).min(MAX_GRID_BLOCKS / 4);
    // Eight threads reduce one piece of a domain and mostly wait for memory, so more blocks hide the latency.
    let many = segments.len().div_ceil(BLOCK as usize / 8).min(4 * MAX_GRID_BLOCKS);
    let boxes = if features.boxes { few.max(many) } else { few };
    let batch = (!work.batched.blocks.is_empty()).then(|| batch_kernel(scene, &work.batched, batch));
    let mut kernels: Vec<KernelDescriptor> = batch.into_iter().chain([deform]).collect();
    kernels.push(walk(KernelKind::Bounds, &bounds, boxes));
    if features.exact_normals {
        kernels.push(walk(KernelKind::Normals, &normals, scene.layout.corners.div_ceil(BLOCK as usize)));
    }
    let changes = max_change_entries(scene);
    if changes > 0 {
        kernels.push(walk(KernelKind::Apply, &apply, changes.div_ceil(BLOCK as usize / 32).min(MAX_GRID_BLOCKS)));
    }
    kernels
}

/// The macros of `deform`.
fn deform_defines(scene: &Scene, work: &WorkList) -> Vec<&'static str> {
    let (features, has_rigid_normals) = (scene.features, has_rigid_normals(scene));
    let flags = [
        ("MODES", features.modes),
        ("ONE_ITEM_PER_LANE", has_one_item_per_lane(work)),
        ("MODE_TRUNCATION", features.truncation),
        ("COMPENSATED_SUM", features.compensated),
        ("DISPLACEMENTS", features.displacements),
        ("RIGID_NORMALS", has_rigid_normals),
        ("CORNER_OFFSETS", !work.corner_offsets.is_empty()),
        ("NORMAL_MAPS", has_rigid_normals && features.normal_maps),
        ("SHEAR", has_rigid_normals && features.shear),
        ("FOLLOWERS", features.followers),
    ];
    let on = flags.iter().filter(|(_, on)| *on).map(|(name, _)| *name);
    on.chain(storage_define(scene.deformation.storage).filter(|_| features.modes)).collect()
}

/// Maximum number of blocks of the kernels that loop over lists: two per multiprocessor of a large device.
const MAX_GRID_BLOCKS: usize = 264;

/// The kernel of a scene with batches.
fn batch_kernel(scene: &Scene, batched: &BatchTables, source: KernelSource) -> KernelDescriptor {
    let vectors = SMALLER_BATCHES.iter().find(|(vectors, _)| batched.max_members <= *vectors).map(|(_, name)| *name);
    let follows = scene.features.followers.then_some("FOLLOWERS");
    KernelDescriptor {
        kind: KernelKind::Batch,
        name: source.name,
        defines: storage_define(scene.deformation.storage).into_iter().chain(vectors).chain(follows).collect(),
        blocks: batched.blocks.len() as u32,
        threads: 32 * BATCH_WARPS as u32,
        source: KernelText(source.source),
    }
}

/// Maximum group size of the kernel compiled with these macros.
fn batch_size_of(defines: &[&str]) -> usize {
    SMALLER_BATCHES.iter().find(|(_, name)| defines.contains(name)).map_or(MAX_BATCH_SIZE, |(vectors, _)| *vectors)
}

/// Shared memory of a block of `batch` in bytes: the part of each warp, T and the members of all vectors, and q.
pub(crate) fn batch_shared_bytes(batched: &BatchTables, defines: &[&str]) -> usize {
    let storage =
        StorageType::ALL.into_iter().find(|storage| storage_define(*storage).is_some_and(|own| defines.contains(&own)));
    let (vectors, modes) = (batch_size_of(defines), batched.chunks * modes_per_chunk(storage.unwrap_or_default()));
    BATCH_WARPS * WARP_BYTES + MEMBER_BYTES * vectors + 4 * vectors * modes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_memory_holds_all_modes_of_every_batch() {
        let longest = BatchTables { chunks: modalcast_model::domain::MAX_RANK, ..BatchTables::default() };
        // 64 KiB is the shared memory of the smallest supported device.
        assert!(batch_shared_bytes(&longest, &[]) <= 64 << 10);
        assert_eq!(batch_shared_bytes(&BatchTables::default(), &["BATCH_4"]), BATCH_WARPS * WARP_BYTES + 64 * 4);
        let chunks = BatchTables { chunks: 3, ..BatchTables::default() };
        assert_eq!(
            batch_shared_bytes(&chunks, &["STORE_INT8"]) - batch_shared_bytes(&BatchTables::default(), &[]),
            4 * 16 * 12
        );
    }
}
