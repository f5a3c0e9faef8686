//! Launches `kernels/batch_mma.cu`: x = T_b (x0 + U q_b) for up to 32 domains b of one shape, by tensor cores. Only
//! benchmarks use it, because its summation order differs from the deformer's and it rounds each coordinate to a pair
//! of 16-bit numbers.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::input_sets::{InputAddresses, InputSets};
use super::kernel_benchmark::{BenchmarkSource, CompiledKernel, KernelAttributes, KernelBenchmark};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::launchers::storage_define;
use modalcast_compute::storage::{QUAD, SplitCoordinates, TiledModes};
use modalcast_model::error::{Error, Result, fault_in, invalid};
use modalcast_model::scene::{Scene, SceneState, StorageType};

pub(super) const CODE: BenchmarkSource = BenchmarkSource {
    source: include_str!("../../kernels/batch_mma.cu"),
    functions: &["batch_mma"],
    variants: &[
        &["STORE_F16"],
        &["STORE_BF16"],
        &["STORE_F16", "BATCH_8"],
        &["STORE_BF16", "BATCH_8"],
        &["STORE_F16", "BATCH_32"],
        &["STORE_BF16", "BATCH_32"],
    ],
};

/// Upper limit of domains per launch.
const MOST: usize = 32;
/// Warps per block, which covers one tile, and modes per matrix product.
const WARPS: usize = 4;
const STEP: usize = 16;
/// The first compute capability whose tensor cores support this product (m16n8k16).
const AMPERE: (i32, i32) = (8, 0);

/// Arguments of `batch_mma`; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct BatchMmaArgs {
    words: u64,
    rest: u64,
    transforms: u64,
    shrinks: u64,
    halves: u64,
    positions: u64,
    first: [u32; MOST],
    domains: u32,
    vertices: u32,
    chunks: u32,
    aligned: u32,
}

const _: () = assert!(size_of::<BatchMmaArgs>() == 192, "BatchMmaArgs differs from kernels/batch_mma.cu");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for BatchMmaArgs {}

/// All domains of a scene with one shape, multiplied by tensor cores, for several steps.
#[derive(Debug)]
pub struct BatchMmaBenchmark {
    name: String,
    compiled: CompiledKernel,
    words: DeviceBuffer,
    rest: DeviceBuffer,
    positions: DeviceBuffer,
    turns: InputSets,
    /// Kernel arguments with null addresses; [`Self::args`] fills them in.
    args: BatchMmaArgs,
    vectors: usize,
    tiles: u32,
    bytes: Vec<(&'static str, u64)>,
}

impl BatchMmaBenchmark {
    /// Packs and uploads the shape and the values of each state. U is stored in the scene's 16-bit type.
    ///
    /// # Errors
    /// `Invalid` when the scene is not 1 to 32 domains of one shape, has followers, does not store U in 16 bits or
    /// requests compensated sums, or when there is no state; `Unavailable` when the device has no such tensor cores or
    /// NVRTC is missing; `Fault` when the device fails.
    pub fn new(device: &Device, scene: &Arc<Scene>, states: &[SceneState]) -> Result<Self> {
        check(scene)?;
        let storage = scene.deformation.storage;
        if !matches!(storage, StorageType::F16 | StorageType::Bf16) {
            return Err(invalid("deform.storage", "f16 or bf16 for tensor cores", storage.name()));
        }
        check_device(device)?;
        let (vectors, define) = vectors_for(scene.domains.len());
        let defines: Vec<&str> = storage_define(storage).into_iter().chain(define).collect();
        let tiles = TiledModes::new(scene.shape_of(0), storage);
        Ok(Self {
            name: format!("batch_mma{}_{}", scene.domains.len(), storage.name()),
            compiled: CompiledKernel::new(device, &CODE, &defines)?,
            words: DeviceBuffer::upload(device, tiles.packed_words())?,
            rest: DeviceBuffer::upload(device, tiles.rest())?,
            positions: DeviceBuffer::zeroed(device, 12 * scene.layout.vertices as u64)?,
            turns: InputSets::new(device, scene, states, |state| {
                let halves = halves(scene, state, &tiles);
                [bytemuck::cast_vec(fragments(&halves, tiles.rank(), vectors)), placements(state, &halves, vectors)]
            })?,
            args: args(scene, tiles.chunks()),
            vectors,
            tiles: tiles.count() as u32,
            bytes: bytes(scene, &tiles),
        })
    }

    fn args(&self, values: InputAddresses) -> BatchMmaArgs {
        BatchMmaArgs {
            words: self.words.address(),
            rest: self.rest.address(),
            transforms: values.transforms,
            shrinks: values.transforms + 48 * self.vectors as u64,
            halves: values.q,
            positions: self.positions.address(),
            ..self.args
        }
    }
}

impl KernelBenchmark for BatchMmaBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn turns(&self) -> usize {
        self.turns.count()
    }

    fn launch(&self, device: &Device, turn: usize) -> Result<()> {
        let args = self.args(self.turns.start(turn));
        let mut launch = device.stream().launch_builder(&self.compiled.function);
        let config =
            LaunchConfig { grid_dim: (self.tiles, 1, 1), block_dim: (32 * WARPS as u32, 1, 1), shared_mem_bytes: 0 };
        // SAFETY: `BatchMmaArgs` is the kernel's only argument. Tiles and x0 are those of the scene's one shape, with
        // one block per tile. Halves, T and shrinks hold as many vectors as the kernel was compiled for, and halves
        // hold whole steps of modes. `positions` has room for the shape's vertices from each domain's first vertex on.
        unsafe { launch.arg(&args).launch(config) }.map_err(fault_in("batch_mma"))?;
        Ok(())
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let mut positions = vec![0.0_f32; 3 * (self.args.vertices * self.args.domains) as usize];
        self.positions.read(device, 0, &mut positions)?;
        Ok(positions)
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        self.bytes.clone()
    }

    fn launches(&self) -> usize {
        1
    }

    fn kernels(&self) -> Vec<KernelAttributes> {
        vec![self.compiled.facts.clone()]
    }
}

/// Checks that the scene is one shape used by at most [`MOST`] domains, without compensated sums and followers.
///
/// # Errors
/// `Invalid` otherwise.
fn check(scene: &Scene) -> Result<()> {
    let (count, shape) = (scene.domains.len(), scene.domains[0].shape);
    if count > MOST {
        return Err(invalid("scene.domains", format!("at most {MOST}"), count));
    }
    if let Some(other) = scene.domains.iter().position(|domain| domain.shape != shape) {
        return Err(invalid(
            format!("domain {other}: shape"),
            format!("{shape}, as the first"),
            scene.domains[other].shape,
        ));
    }
    if scene.deformation.compensated {
        return Err(invalid("deform.compensated", "false for tensor cores", true));
    }
    if scene.needs.followers {
        return Err(invalid("follows", "no followers for tensor cores", true));
    }
    Ok(())
}

fn check_device(device: &Device) -> Result<()> {
    let (major, minor) = device.capability();
    if (major, minor) >= AMPERE {
        return Ok(());
    }
    let reason = format!("{} has capability {major}.{minor}", device.name());
    Err(Error::Unavailable { what: "a batch by tensor cores", reason, remedy: "Use a device of 8.0 or above".into() })
}

/// The smallest compiled number of vectors that is enough, and the macro that selects it.
const fn vectors_for(domains: usize) -> (usize, Option<&'static str>) {
    match domains {
        0..=8 => (8, Some("BATCH_8")),
        9..=16 => (16, None),
        _ => (32, Some("BATCH_32")),
    }
}

/// q of each domain, times the factors of the modes, split into pairs of 16-bit numbers.
fn halves(scene: &Scene, state: &SceneState, tiles: &TiledModes) -> Vec<SplitCoordinates> {
    let own = |domain: usize| {
        let amounts = state.q_of(scene, domain).iter().zip(tiles.factors()).map(|(q, factor)| q * factor);
        SplitCoordinates::new(&amounts.collect::<Vec<_>>(), tiles.storage())
    };
    (0..scene.domains.len()).map(own).collect()
}

/// The fragments of q as each lane reads them: [step][vectors / 8][lane][4] words; zeros where there is no domain or
/// mode.
fn fragments(halves: &[SplitCoordinates], rank: usize, vectors: usize) -> Vec<u32> {
    let mut words = Vec::with_capacity(rank.div_ceil(STEP) * vectors * 16);
    for (step, eight) in (0..rank.div_ceil(STEP)).flat_map(|step| (0..vectors / 8).map(move |eight| (step, eight))) {
        for lane in 0..32 {
            let (domain, first) = (8 * eight + lane / 4, STEP * step + 2 * (lane % 4));
            let half = |mode: usize, which: usize| {
                let own = halves.get(domain).filter(|_| mode < rank);
                u32::from(own.map_or(0, |halves| halves.pair(mode)[which]))
            };
            let both = |mode: usize, which: usize| half(mode, which) | half(mode + 1, which) << 16;
            words.extend([both(first, 0), both(first + 8, 0), both(first, 1), both(first + 8, 1)]);
        }
    }
    words
}

/// The transforms, then the scales that undo the scaling of q; zeros where there is no domain.
fn placements(state: &SceneState, halves: &[SplitCoordinates], vectors: usize) -> Vec<f32> {
    let mut numbers: Vec<f32> = bytemuck::cast_slice(&state.transforms).to_vec();
    numbers.resize(12 * vectors, 0.0);
    numbers.extend(halves.iter().map(SplitCoordinates::inverse_scale));
    numbers.resize(13 * vectors, 0.0);
    numbers
}

/// The arguments with null addresses.
fn args(scene: &Scene, chunks: usize) -> BatchMmaArgs {
    let slots = &scene.layout.slots;
    let mut args = BatchMmaArgs {
        domains: slots.len() as u32,
        vertices: slots[0].vertices as u32,
        chunks: chunks as u32,
        aligned: u32::from(slots.iter().all(|slot| slot.first_vertex.is_multiple_of(QUAD))),
        ..BatchMmaArgs::zeroed()
    };
    args.first.iter_mut().zip(slots).for_each(|(first, slot)| *first = slot.first_vertex as u32);
    args
}

/// The minimum of bytes that a launch moves. The few scales are not counted, because 16-bit storage needs none.
fn bytes(scene: &Scene, tiles: &TiledModes) -> Vec<(&'static str, u64)> {
    let (domains, vertices) = (scene.domains.len() as u64, scene.layout.vertices as u64);
    vec![
        ("U", tiles.bytes().len() as u64),
        ("x0", 48 * tiles.quads() as u64),
        ("q", 4 * domains * tiles.rank() as u64),
        ("T", 48 * domains),
        ("x", 12 * vertices),
    ]
}

#[cfg(test)]
mod warp;

#[cfg(test)]
mod tests {
    use super::super::kernel_benchmark::tests::compile_all;
    use super::warp::{KernelInputs, QUADS, staged, store, sums};
    use super::*;
    use modalcast_compute::storage::TILE_QUADS;
    use modalcast_compute::testing::{TestRng, position_of, scene_and_state};
    use modalcast_model::scene::SceneParts;

    fn ensemble(vertices: usize, rank: usize, domains: usize, storage: StorageType) -> (Arc<Scene>, SceneState) {
        let (one, _) = scene_and_state(&[(vertices, rank, 1)]);
        let mut parts = SceneParts::named("ensemble");
        parts.shapes = vec![one.shapes[0].clone()];
        parts.materials = one.materials.clone();
        parts.domains = vec![one.domains[0].clone(); domains];
        parts.deformation.storage = storage;
        let scene = Scene::new(parts).expect("a scene");
        let (mut random, mut state) = (TestRng(domains as u64), SceneState::rest(&scene));
        state.q.iter_mut().for_each(|coordinate| *coordinate = random.next());
        state.transforms.iter_mut().for_each(|transform| transform.0 = [0; 12].map(|_| random.next()));
        (scene, state)
    }

    const SIZES: [(usize, usize, usize); 12] = [
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
    ];

    /// CPU twin of `batch_mma`, warp by warp, with fragments, staging buffer and stores; sums in f64.
    fn twin_of_batch_mma(tables: &KernelInputs, numbers: usize) -> Vec<f32> {
        let mut positions = vec![f32::NAN; numbers];
        let vertices = tables.args.vertices as usize;
        for (tile, warp) in (0..tables.tiles.count()).flat_map(|tile| (0..WARPS).map(move |warp| (tile, warp))) {
            let first = 4 * (TILE_QUADS * tile + QUADS * warp);
            if first < vertices {
                let sums = sums(tables, tile, warp);
                let own = 3 * (4 * QUADS).min(vertices - first);
                (0..tables.vectors / 4).for_each(|pass| {
                    let staged = staged(tables, &sums, (tile, warp), pass);
                    store(tables, &staged, (first, own, pass), &mut positions);
                });
            }
        }
        positions
    }

    #[test]
    fn writes_each_position_once_from_its_own_inputs() {
        for storage in [StorageType::F16, StorageType::Bf16] {
            for (vertices, rank, domains) in SIZES.into_iter().chain([(70, 31, 32), (33, 40, 17)]) {
                let (scene, state) = ensemble(vertices, rank, domains, storage);
                let tables = KernelInputs::of(&scene, &state);
                let got = twin_of_batch_mma(&tables, 3 * scene.layout.vertices);
                for (packed, got) in got.chunks_exact(3).enumerate() {
                    let (domain, vertex) = (packed / vertices, packed % vertices);
                    // Compare with the result for stored U; only the rounding of q and f32 remains.
                    let want = exactly(&scene, &state, &tables.tiles, (domain, vertex));
                    let near = |tolerance: f64| {
                        got.iter().zip(want).all(|(got, want)| (f64::from(*got) - want).abs() < tolerance)
                    };
                    let tolerance = if storage == StorageType::F16 { 4e-6 } else { 1e-4 };
                    assert!(near(tolerance), "{storage:?} {vertices} {rank} {domains}: {got:?} not {want:?}");
                    let other = position_of(&scene, &state, (domain + 1) % domains, (vertex + 1) % vertices);
                    let alone = domains == 1 && vertices == 1;
                    let differs = got.iter().zip(other).any(|(got, other)| (f64::from(*got) - other).abs() > 1e-3);
                    assert!(alone || differs, "the judge can fail");
                }
            }
        }
    }

    /// x of a vertex in f64, with U as stored.
    fn exactly(scene: &Scene, state: &SceneState, tiles: &TiledModes, (domain, vertex): (usize, usize)) -> [f64; 3] {
        let (rest, q) = (scene.shape_of(domain).mesh.rest()[vertex], state.q_of(scene, domain));
        let bent = [0, 1, 2].map(|axis| {
            let terms = q.iter().enumerate().map(|(mode, q)| tiles.decode_entry(vertex, axis, mode) * f64::from(*q));
            f64::from(rest[axis]) + terms.sum::<f64>()
        });
        let rows = state.transforms[domain].0.map(f64::from);
        [0, 4, 8].map(|row| (0..3).map(|axis| rows[row + axis] * bent[axis]).sum::<f64>() + rows[row + 3])
    }

    #[test]
    fn pads_to_compiled_vector_counts_and_rejects_over_32() {
        let vectors: Vec<usize> = [1, 8, 9, 16, 17, 32].map(|domains| vectors_for(domains).0).into();
        assert_eq!(vectors, [8, 8, 16, 16, 32, 32]);
        let (scene, _) = ensemble(9, 2, 33, StorageType::F16);
        assert!(check(&scene).expect_err("33 domains").to_string().contains("at most 32"));
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_batch_mma() {
        compile_all(&CODE);
    }
}
