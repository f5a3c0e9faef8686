//! Launches `kernels/batch_mma.cu`: x = T_b (x0 + U q_b) for up to 32 domains b of one shape, by tensor cores.
//!
//! The server does not use this kernel, because its summation order differs from that of `deform`, and because it
//! rounds each coordinate of q to a pair of 16-bit numbers.
//!
//! As in `storage`, a quad is four consecutive vertices, a tile is up to 32 quads, and a chunk is two modes, because U
//! has 16 bits per entry. In this file and in the kernel, `step` is the index of a matrix product of 16 modes, not a
//! step of the simulation.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::input_sets::{InputAddresses, InputSets};
use super::kernel_benchmark::{ArrayTraffic, BenchmarkSource, CompiledKernel, KernelAttributes, KernelBenchmark};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::launchers::storage_define;
use modalcast_compute::storage::{QUAD, SplitCoordinates, TiledModes};
use modalcast_model::error::{Error, Result, fault_in, invalid};
use modalcast_model::scene::{Scene, SceneState, StorageType};

pub(super) const SOURCE: BenchmarkSource = BenchmarkSource {
    text: include_str!("../../kernels/batch_mma.cu"),
    functions: &["batch_mma"],
    define_sets: &[
        &["STORE_F16"],
        &["STORE_BF16"],
        &["STORE_F16", "BATCH_8"],
        &["STORE_BF16", "BATCH_8"],
        &["STORE_F16", "BATCH_32"],
        &["STORE_BF16", "BATCH_32"],
    ],
};

/// Maximum number of domains per launch.
const MAX_DOMAINS: usize = 32;
/// Warps per block. A block computes one tile.
const WARPS: usize = 4;
/// Modes per step, which is one matrix product (the k of m16n8k16).
const STEP_MODES: usize = 16;
/// The first compute capability whose tensor cores have the instruction m16n8k16.
const AMPERE: (i32, i32) = (8, 0);

/// Arguments of `batch_mma`; pointers are device addresses. The kernel file describes the arrays.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct BatchMmaArgs {
    words: u64,
    rest: u64,
    transforms: u64,
    inverse_scales: u64,
    split_q: u64,
    positions: u64,
    first_vertices: [u32; MAX_DOMAINS],
    domains: u32,
    vertices: u32,
    chunks: u32,
    is_aligned: u32,
}

const _: () = assert!(size_of::<BatchMmaArgs>() == 192, "BatchMmaArgs differs from kernels/batch_mma.cu");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for BatchMmaArgs {}

/// The kernel for a scene whose domains share one shape, with several input sets.
#[derive(Debug)]
pub struct BatchMmaBenchmark {
    name: String,
    compiled: CompiledKernel,
    /// U, in packed words of 16 bytes.
    words: DeviceBuffer,
    /// x0.
    rest: DeviceBuffer,
    positions: DeviceBuffer,
    input_sets: InputSets,
    /// Kernel arguments with null addresses; [`Self::fill_args`] returns a copy with addresses.
    args: BatchMmaArgs,
    /// Number of domains that the kernel was compiled for.
    batch_size: usize,
    tiles: u32,
    traffic: Vec<ArrayTraffic>,
}

impl BatchMmaBenchmark {
    /// Packs and uploads the shape and the values of each state. U is stored in the scene's 16-bit type.
    ///
    /// # Errors
    /// `Invalid` when the scene is not 1 to 32 domains of one shape, has followers, does not store U in 16 bits or
    /// requests compensated sums, or when there is no state; `Unavailable` when the device's compute capability is
    /// below 8.0 or NVRTC is missing; `Fault` when the device fails.
    pub fn new(device: &Device, scene: &Arc<Scene>, states: &[SceneState]) -> Result<Self> {
        check_scene(scene)?;
        let storage = scene.deformation.storage;
        if !matches!(storage, StorageType::F16 | StorageType::Bf16) {
            return Err(invalid("deform.storage", "f16 or bf16 for tensor cores", storage.name()));
        }
        check_device(device)?;
        let (batch_size, define) = select_batch_size(scene.domains.len());
        let defines: Vec<&str> = storage_define(storage).into_iter().chain(define).collect();
        let tiles = TiledModes::new(scene.shape_of(0), storage);
        Ok(Self {
            name: format!("batch_mma{}_{}", scene.domains.len(), storage.name()),
            compiled: CompiledKernel::new(device, &SOURCE, &defines)?,
            words: DeviceBuffer::upload(device, tiles.packed_words())?,
            rest: DeviceBuffer::upload(device, tiles.rest())?,
            positions: DeviceBuffer::zeroed(device, 12 * scene.layout.vertices as u64)?,
            input_sets: InputSets::new(device, scene, states, |state| {
                let split_q = split_coordinates(scene, state, &tiles);
                [
                    bytemuck::cast_vec(pack_fragments(&split_q, tiles.rank(), batch_size)),
                    pack_transforms_and_scales(state, &split_q, batch_size),
                ]
            })?,
            args: args_without_addresses(scene, tiles.chunks()),
            batch_size,
            tiles: tiles.count() as u32,
            traffic: minimum_traffic(scene, &tiles),
        })
    }

    fn fill_args(&self, inputs: InputAddresses) -> BatchMmaArgs {
        BatchMmaArgs {
            words: self.words.address(),
            rest: self.rest.address(),
            transforms: inputs.transforms,
            // The inverse scales follow the transforms, which have 48 bytes per domain.
            inverse_scales: inputs.transforms + 48 * self.batch_size as u64,
            split_q: inputs.q,
            positions: self.positions.address(),
            ..self.args
        }
    }
}

impl KernelBenchmark for BatchMmaBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn input_set_count(&self) -> usize {
        self.input_sets.count()
    }

    fn launch(&self, device: &Device, input_set: usize) -> Result<()> {
        let args = self.fill_args(self.input_sets.select(input_set));
        let mut launch = device.stream().launch_builder(&self.compiled.function);
        let config =
            LaunchConfig { grid_dim: (self.tiles, 1, 1), block_dim: (32 * WARPS as u32, 1, 1), shared_mem_bytes: 0 };
        // SAFETY: `BatchMmaArgs` is the kernel's only argument. U and x0 belong to the scene's only shape, and each
        // tile has one block. Split q, T and inverse scales have entries for as many domains as the kernel was compiled
        // for, and split q holds whole steps of modes. `positions` has room for all vertices of every domain.
        unsafe { launch.arg(&args).launch(config) }.map_err(fault_in("batch_mma"))?;
        Ok(())
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let mut positions = vec![0.0_f32; 3 * (self.args.vertices * self.args.domains) as usize];
        self.positions.read(device, 0, &mut positions)?;
        Ok(positions)
    }

    fn traffic(&self) -> Vec<ArrayTraffic> {
        self.traffic.clone()
    }

    fn launches_per_step(&self) -> usize {
        1
    }

    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        vec![self.compiled.attributes.clone()]
    }
}

/// Checks that the scene is one shape used by at most [`MAX_DOMAINS`] domains, without compensated sums and followers.
///
/// # Errors
/// `Invalid` otherwise.
fn check_scene(scene: &Scene) -> Result<()> {
    let (count, shape) = (scene.domains.len(), scene.domains[0].shape);
    if count > MAX_DOMAINS {
        return Err(invalid("scene.domains", format!("at most {MAX_DOMAINS}"), count));
    }
    if let Some(other_domain) = scene.domains.iter().position(|domain| domain.shape != shape) {
        return Err(invalid(
            format!("domain {other_domain}: shape"),
            format!("{shape}, the shape of domain 0"),
            scene.domains[other_domain].shape,
        ));
    }
    if scene.deformation.compensated {
        return Err(invalid("deform.compensated", "false for tensor cores", true));
    }
    if scene.features.followers {
        return Err(invalid("follows", "no followers for tensor cores", true));
    }
    Ok(())
}

fn check_device(device: &Device) -> Result<()> {
    let (major, minor) = device.capability();
    if (major, minor) >= AMPERE {
        return Ok(());
    }
    let reason = format!("{} has compute capability {major}.{minor}", device.name());
    let remedy = "Use a device of compute capability 8.0 or above".into();
    Err(Error::Unavailable { what: "a batch by tensor cores", reason, remedy })
}

/// The smallest compiled batch size for this number of domains, and the macro that selects it. Without a macro, the
/// kernel has a batch size of 16.
const fn select_batch_size(domains: usize) -> (usize, Option<&'static str>) {
    match domains {
        0..=8 => (8, Some("BATCH_8")),
        9..=16 => (16, None),
        _ => (32, Some("BATCH_32")),
    }
}

/// q of each domain, multiplied by the factors by which `TiledModes` divided the modes. Each coordinate is split into a
/// pair of 16-bit numbers: the rounded coordinate and the rounded remainder.
fn split_coordinates(scene: &Scene, state: &SceneState, tiles: &TiledModes) -> Vec<SplitCoordinates> {
    let split_domain = |domain: usize| {
        let scaled_q = state.q_of(scene, domain).iter().zip(tiles.factors()).map(|(q, factor)| q * factor);
        SplitCoordinates::new(&scaled_q.collect::<Vec<_>>(), tiles.storage())
    };
    (0..scene.domains.len()).map(split_domain).collect()
}

/// The fragments of q (the parts of a matrix that single lanes hold) in the order in which lanes read them:
/// [step][group of 8 domains][lane][4 words]. A word holds the 16-bit numbers of two neighboring modes. Numbers beyond
/// the last domain or mode are zero.
fn pack_fragments(split_q: &[SplitCoordinates], rank: usize, batch_size: usize) -> Vec<u32> {
    let steps = rank.div_ceil(STEP_MODES);
    // A step has a pair of 16-bit numbers for each domain and mode: one word of 32 bits.
    let mut words = Vec::with_capacity(steps * batch_size * STEP_MODES);
    for (step, group) in (0..steps).flat_map(|step| (0..batch_size / 8).map(move |group| (step, group))) {
        for lane in 0..32 {
            let (domain, first_mode) = (8 * group + lane / 4, STEP_MODES * step + 2 * (lane % 4));
            // Index 0 of a pair is the rounded coordinate, index 1 the rounded remainder.
            let number_bits = |mode: usize, pair_index: usize| {
                let domain_q = split_q.get(domain).filter(|_| mode < rank);
                u32::from(domain_q.map_or(0, |domain_q| domain_q.pair(mode)[pair_index]))
            };
            let word = |mode: usize, pair_index: usize| {
                number_bits(mode, pair_index) | number_bits(mode + 1, pair_index) << 16
            };
            words.extend([word(first_mode, 0), word(first_mode + 8, 0), word(first_mode, 1), word(first_mode + 8, 1)]);
        }
    }
    words
}

/// The transforms of all domains, 12 numbers each, then one scale per domain that undoes the scaling of q. Entries
/// beyond the last domain are zero.
fn pack_transforms_and_scales(state: &SceneState, split_q: &[SplitCoordinates], batch_size: usize) -> Vec<f32> {
    let mut numbers: Vec<f32> = bytemuck::cast_slice(&state.transforms).to_vec();
    numbers.resize(12 * batch_size, 0.0);
    numbers.extend(split_q.iter().map(SplitCoordinates::inverse_scale));
    numbers.resize(13 * batch_size, 0.0);
    numbers
}

/// The kernel arguments with null addresses.
fn args_without_addresses(scene: &Scene, chunks: usize) -> BatchMmaArgs {
    let domain_layouts = &scene.layout.domains;
    let mut args = BatchMmaArgs {
        domains: domain_layouts.len() as u32,
        vertices: domain_layouts[0].vertices as u32,
        chunks: chunks as u32,
        // Positions of four vertices have 48 bytes, a multiple of 16.
        is_aligned: u32::from(
            domain_layouts.iter().all(|domain_layout| domain_layout.first_vertex.is_multiple_of(QUAD)),
        ),
        ..BatchMmaArgs::zeroed()
    };
    args.first_vertices
        .iter_mut()
        .zip(domain_layouts)
        .for_each(|(first, domain_layout)| *first = domain_layout.first_vertex as u32);
    args
}

/// Minimum memory traffic of a launch, in bytes.
fn minimum_traffic(scene: &Scene, tiles: &TiledModes) -> Vec<ArrayTraffic> {
    let (domains, vertices) = (scene.domains.len() as u64, scene.layout.vertices as u64);
    // A quad of x0 and a T have 12 f32 each, 48 bytes. A position has 3 f32, 12 bytes.
    vec![
        ArrayTraffic::new("U", tiles.bytes().len() as u64),
        ArrayTraffic::new("x0", 48 * tiles.quads() as u64),
        ArrayTraffic::new("q", 4 * domains * tiles.rank() as u64),
        ArrayTraffic::new("T", 48 * domains),
        ArrayTraffic::new("x", 12 * vertices),
    ]
}

#[cfg(test)]
mod warp;

#[cfg(test)]
mod tests {
    use super::super::kernel_benchmark::tests::compile_all;
    use super::warp::{KernelInputs, StoreRange, WARP_QUADS, stage_positions, store_staged, sum_modes};
    use super::*;
    use modalcast_compute::storage::TILE_QUADS;
    use modalcast_compute::testing::{TestRng, position_of, scene_and_state};
    use modalcast_model::scene::SceneParts;

    /// A scene whose domains share one random shape, and a random state. All numbers are from -1 to 1.
    fn instanced_scene(vertices: usize, rank: usize, domains: usize, storage: StorageType) -> (Arc<Scene>, SceneState) {
        let (single_scene, _) = scene_and_state(&[(vertices, rank, 1)]);
        let mut parts = SceneParts::named("instances");
        parts.shapes = vec![single_scene.shapes[0].clone()];
        parts.materials = single_scene.materials.clone();
        parts.domains = vec![single_scene.domains[0].clone(); domains];
        parts.deformation.storage = storage;
        let scene = Scene::new(parts).expect("a valid scene");
        let (mut random, mut state) = (TestRng(domains as u64), SceneState::rest(&scene));
        state.q.iter_mut().for_each(|coordinate| *coordinate = random.next());
        state.transforms.iter_mut().for_each(|transform| transform.0 = [0; 12].map(|_| random.next()));
        (scene, state)
    }

    /// Vertices of the shape, modes and domains of each test scene.
    const SIZES: [(usize, usize, usize); 14] = [
        (1, 3, 1),
        (4, 1, 16),
        (63, 13, 2),
        (64, 4, 16),
        (65, 16, 3),
        (127, 0, 4),
        (128, 32, 16),
        (129, 5, 8),
        (192, 17, 5),
        (256, 33, 7),
        (261, 12, 9),
        (320, 50, 13),
        (70, 31, 32),
        (33, 40, 17),
    ];

    /// CPU twin of `batch_mma`: the same algorithm in Rust, warp by warp. It uses the kernel's fragments, staging
    /// buffer and stores, but sums in f64. Positions that no warp stores are NaN.
    fn twin_of_batch_mma(inputs: &KernelInputs, coordinate_count: usize) -> Vec<f32> {
        let mut positions = vec![f32::NAN; coordinate_count];
        let vertices = inputs.args.vertices as usize;
        for (tile, warp) in (0..inputs.tiles.count()).flat_map(|tile| (0..WARPS).map(move |warp| (tile, warp))) {
            let first_vertex = QUAD * (TILE_QUADS * tile + WARP_QUADS * warp);
            if first_vertex < vertices {
                let sums = sum_modes(inputs, tile, warp);
                let coordinates = 3 * (QUAD * WARP_QUADS).min(vertices - first_vertex);
                // A pass stores four domains.
                (0..inputs.batch_size / 4).for_each(|pass| {
                    let staged = stage_positions(inputs, &sums, (tile, warp), pass);
                    store_staged(inputs, &staged, StoreRange { first_vertex, coordinates, pass }, &mut positions);
                });
            }
        }
        positions
    }

    #[test]
    fn twin_writes_each_position_once_from_its_inputs() {
        // Split q has a relative error of up to 2^-22 (2.4e-7) in f16 and 2^-16 (1.5e-5) in bf16. The tolerances are
        // about 16 and 6 times as large, for sums over up to 50 modes and for f32 rounding.
        for (storage, tolerance) in [(StorageType::F16, 4e-6), (StorageType::Bf16, 1e-4)] {
            for (vertices, rank, domains) in SIZES {
                let (scene, state) = instanced_scene(vertices, rank, domains, storage);
                let inputs = KernelInputs::pack(&scene, &state);
                let positions = twin_of_batch_mma(&inputs, 3 * scene.layout.vertices);
                let size = format!("{storage:?}, {vertices} vertices, {rank} modes, {domains} domains");
                for (packed_vertex, got) in positions.chunks_exact(3).enumerate() {
                    let (domain, vertex) = (packed_vertex / vertices, packed_vertex % vertices);
                    // The expected position uses U as stored, so that the rounding of U is not part of the error.
                    let want = stored_position(&scene, &state, &inputs.tiles, (domain, vertex));
                    let is_close = got.iter().zip(want).all(|(got, want)| (f64::from(*got) - want).abs() < tolerance);
                    assert!(is_close, "{size}: expected {want:?}, got {got:?}");
                    // Negative control: the next vertex of the next domain has another position. Random positions
                    // differ by more than 1e-3, ten times the larger tolerance.
                    let next = position_of(&scene, &state, (domain + 1) % domains, (vertex + 1) % vertices);
                    let is_only_vertex = domains == 1 && vertices == 1;
                    let differs = got.iter().zip(next).any(|(got, next)| (f64::from(*got) - next).abs() > 1e-3);
                    assert!(is_only_vertex || differs, "expected another position at the next vertex");
                }
            }
        }
    }

    /// x of a vertex in f64, with U as stored.
    fn stored_position(
        scene: &Scene,
        state: &SceneState,
        tiles: &TiledModes,
        (domain, vertex): (usize, usize),
    ) -> [f64; 3] {
        let (rest, q) = (scene.shape_of(domain).mesh.rest_positions()[vertex], state.q_of(scene, domain));
        let deformed = [0, 1, 2].map(|axis| {
            let terms = q.iter().enumerate().map(|(mode, q)| tiles.decode_entry(vertex, axis, mode) * f64::from(*q));
            f64::from(rest[axis]) + terms.sum::<f64>()
        });
        let rows = state.transforms[domain].0.map(f64::from);
        [0, 4, 8].map(|row| (0..3).map(|axis| rows[row + axis] * deformed[axis]).sum::<f64>() + rows[row + 3])
    }

    #[test]
    fn selects_compiled_batch_size_and_rejects_over_32_domains() {
        let batch_sizes: Vec<usize> = [1, 8, 9, 16, 17, 32].map(|domains| select_batch_size(domains).0).into();
        assert_eq!(batch_sizes, [8, 8, 16, 16, 32, 32]);
        let (scene, _) = instanced_scene(9, 2, 33, StorageType::F16);
        assert!(check_scene(&scene).expect_err("33 domains").to_string().contains("at most 32"));
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_batch_mma() {
        compile_all(&SOURCE);
    }
}
