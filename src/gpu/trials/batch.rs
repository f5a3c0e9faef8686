//! Launches `kernels/batch.cu`: x = T_b (x0 + U q_b) of up to 16 domains b of one shape, for which U is read once. Only
//! trials use it.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::sys::CUfunction_attribute;
use cudarc::driver::{CudaSlice, DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::super::device::Device;
use super::super::memory::{address, download, room, upload};
use super::super::plan::storage_define;
use super::trial::{Code, Compiled, KernelFacts, Trial};
use super::turns::{Turns, Values};
use crate::error::{Result, during, invalid};
use crate::scene::{Scene, State};
use crate::storage::{QUAD, Tiles, modes_per_chunk};

pub(super) const CODE: Code = Code {
    source: include_str!("../../../kernels/batch.cu"),
    functions: &["batch"],
    variants: &[
        &[],
        &["STORE_F16"],
        &["STORE_BF16"],
        &["STORE_INT8"],
        &["BATCH_8"],
        &["STORE_F16", "BATCH_8"],
        &["STORE_BF16", "BATCH_8"],
        &["STORE_INT8", "BATCH_8"],
        &["BATCH_4"],
        &["STORE_F16", "BATCH_4"],
        &["STORE_BF16", "BATCH_4"],
        &["STORE_INT8", "BATCH_4"],
    ],
};

/// The most domains of a launch, and the other numbers of vectors that the kernel is compiled for, with their macros.
const MOST: usize = 16;
const FEWER: [(usize, &str); 2] = [(4, "BATCH_4"), (8, "BATCH_8")];

/// Warps of a block, and bytes of shared memory of each.
const WARPS: usize = 2;
const OWN: usize = 9984;

/// Arguments of `batch`; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct BatchArgs {
    words: u64,
    rest: u64,
    scales: u64,
    transforms: u64,
    q: u64,
    positions: u64,
    first: [u32; MOST],
    domains: u32,
    vertices: u32,
    chunks: u32,
    aligned: u32,
}

const _: () = assert!(size_of::<BatchArgs>() == 128, "BatchArgs differs from kernels/batch.cu");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for BatchArgs {}

/// All domains of a scene of one shape, deformed together, for several steps.
#[derive(Debug)]
pub struct Batch {
    name: String,
    compiled: Compiled,
    words: CudaSlice<u8>,
    rest: CudaSlice<u8>,
    scales: CudaSlice<u8>,
    positions: CudaSlice<u8>,
    turns: Turns,
    /// Without its addresses.
    args: BatchArgs,
    config: LaunchConfig,
    bytes: Vec<(&'static str, u64)>,
}

impl Batch {
    /// Packs the shape and the values of each state onto the device; U is stored as the scene says.
    ///
    /// # Errors
    /// `Invalid` when the scene is not 1 to 16 domains of one shape, or asks for compensated sums, or there is no state;
    /// `Unavailable` when NVRTC is missing; `Fault` when the device refuses.
    pub fn new(device: &Device, scene: &Arc<Scene>, states: &[State]) -> Result<Self> {
        check(scene, MOST)?;
        let (storage, shape) = (scene.deformation.storage, scene.shape_of(0));
        let vectors = vectors_for(scene.domains.len());
        let defines: Vec<&str> = storage_define(storage).into_iter().chain(vectors.1).collect();
        let tiles = Tiles::new(shape, storage);
        let modes = tiles.chunks() * modes_per_chunk(storage);
        let shared = shared_bytes(vectors.0, modes);
        let compiled = Compiled::new(device, &CODE, &defines)?;
        // As many blocks as registers allow, so nothing is left to the L1 cache.
        let carveout = CUfunction_attribute::CU_FUNC_ATTRIBUTE_PREFERRED_SHARED_MEMORY_CARVEOUT;
        let most = CUfunction_attribute::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
        for (attribute, value) in [(carveout, 100), (most, shared as i32)] {
            compiled.function.set_attribute(attribute, value).map_err(during("batch"))?;
        }
        Ok(Self {
            name: format!("batch{}_{}", scene.domains.len(), storage.name()),
            compiled,
            words: upload(device, tiles.planes())?,
            rest: upload(device, tiles.rest())?,
            scales: upload(device, tiles.scales())?,
            positions: room(device, 12 * scene.layout.vertices as u64)?,
            turns: Turns::new(device, scene, states, |state| {
                [amounts(scene, state, tiles.factors(), (vectors.0, modes)), transforms(scene, state, vectors.0)]
            })?,
            args: args(scene, tiles.chunks()),
            config: LaunchConfig {
                grid_dim: (tiles.count() as u32, 1, 1),
                block_dim: ((WARPS * 32) as u32, 1, 1),
                shared_mem_bytes: shared as u32,
            },
            bytes: bytes(scene, &tiles),
        })
    }

    fn args(&self, device: &Device, values: Values) -> BatchArgs {
        BatchArgs {
            words: address(device, &self.words),
            rest: address(device, &self.rest),
            scales: address(device, &self.scales),
            transforms: values.transforms,
            q: values.q,
            positions: address(device, &self.positions),
            ..self.args
        }
    }
}

impl Trial for Batch {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn turns(&self) -> usize {
        self.turns.count()
    }

    fn launch(&self, device: &Device, turn: usize) -> Result<()> {
        let args = self.args(device, self.turns.start(device, turn));
        let mut launch = device.stream().launch_builder(&self.compiled.function);
        // SAFETY: `BatchArgs` is the kernel's only argument. Tiles, x0 and scales are those of the scene's one shape, a
        // block for each tile; T and q have as many vectors as the kernel was compiled for, and q all modes of the
        // tiles; every domain has room for the shape's vertices from its first on; and the shared memory is as
        // `shared_bytes` says.
        unsafe { launch.arg(&args).launch(self.config) }.map_err(during("batch"))?;
        Ok(())
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let vertices = (self.args.vertices * self.args.domains) as usize;
        let mut positions = vec![0.0_f32; 3 * vertices];
        // SAFETY: the buffer has three floats for each vertex of each domain.
        unsafe { download(device, address(device, &self.positions), &mut positions) }?;
        Ok(positions)
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        self.bytes.clone()
    }

    fn launches(&self) -> usize {
        1
    }

    fn kernels(&self) -> Vec<KernelFacts> {
        vec![self.compiled.facts.clone()]
    }
}

/// Refuses scenes that are not one shape, used by at most `most` domains.
pub(super) fn check(scene: &Scene, most: usize) -> Result<()> {
    let (count, shape) = (scene.domains.len(), scene.domains[0].shape);
    if count > most {
        return Err(invalid("scene.domains", format!("at most {most}"), count));
    }
    if let Some(other) = scene.domains.iter().position(|domain| domain.shape != shape) {
        return Err(invalid(
            format!("domain {other}: shape"),
            format!("{shape}, as the first"),
            scene.domains[other].shape,
        ));
    }
    if scene.deformation.compensated {
        return Err(invalid("deform.compensated", "false for the batched kernel", true));
    }
    if scene.needs.followers {
        return Err(invalid("follows", "no followers for the batched kernel", true));
    }
    Ok(())
}

/// The fewest vectors that the kernel is compiled for and that are enough, and the macro that says so.
fn vectors_for(domains: usize) -> (usize, Option<&'static str>) {
    FEWER
        .iter()
        .find(|(vectors, _)| domains <= *vectors)
        .map_or((MOST, None), |(vectors, name)| (*vectors, Some(*name)))
}

/// Shared memory of a block: what each warp has, T and q of all vectors.
const fn shared_bytes(vectors: usize, modes: usize) -> usize {
    WARPS * OWN + 48 * vectors + 4 * vectors * modes
}

/// q as `[modes][vectors]`, times the factors of the modes; zeros where there is no domain or mode.
fn amounts(scene: &Scene, state: &State, factors: &[f32], (vectors, modes): (usize, usize)) -> Vec<f32> {
    let mut amounts = vec![0.0; vectors * modes];
    for domain in 0..scene.domains.len() {
        for (mode, amount) in state.q_of(scene, domain).iter().enumerate() {
            amounts[vectors * mode + domain] = amount * factors.get(mode).copied().unwrap_or(1.0);
        }
    }
    amounts
}

/// The transforms; zeros where there is no domain.
fn transforms(scene: &Scene, state: &State, vectors: usize) -> Vec<f32> {
    let mut rows: Vec<f32> = bytemuck::cast_slice(&state.world_transforms(scene)).to_vec();
    rows.resize(12 * vectors, 0.0);
    rows
}

/// The arguments without their addresses.
fn args(scene: &Scene, chunks: usize) -> BatchArgs {
    let slots = &scene.layout.slots;
    let mut args = BatchArgs {
        domains: slots.len() as u32,
        vertices: slots[0].vertices as u32,
        chunks: chunks as u32,
        aligned: u32::from(slots.iter().all(|slot| slot.first_vertex.is_multiple_of(QUAD))),
        ..BatchArgs::zeroed()
    };
    args.first.iter_mut().zip(slots).for_each(|(first, slot)| *first = slot.first_vertex as u32);
    args
}

/// What a launch must move, whichever kernel.
pub(super) fn bytes(scene: &Scene, tiles: &Tiles) -> Vec<(&'static str, u64)> {
    let (domains, vertices) = (scene.domains.len() as u64, scene.layout.vertices as u64);
    vec![
        ("U", tiles.bytes().len() as u64),
        ("scales", 4 * tiles.scales().len() as u64),
        ("x0", 48 * tiles.quads() as u64),
        ("q", 4 * domains * tiles.rank() as u64),
        ("T", 48 * domains),
        ("x", 12 * vertices),
    ]
}

#[cfg(test)]
mod warp;

#[cfg(test)]
pub(super) mod tests {
    use super::super::trial::tests::compile_all;
    use super::super::turns::tests::{Random, scene as trial_scene};
    pub(in super::super) use super::warp::placed;
    use super::warp::{Tables, Warp};
    use super::*;
    use crate::scene::{Parts, Storage};

    pub(in super::super) fn ensemble(
        vertices: usize,
        rank: usize,
        domains: usize,
        storage: Storage,
    ) -> (Arc<Scene>, State) {
        let (one, _) = trial_scene(&[(vertices, rank, 1)]);
        let mut parts = Parts::named("ensemble");
        parts.shapes = vec![one.shapes[0].clone()];
        parts.materials = one.materials.clone();
        parts.domains = vec![one.domains[0].clone(); domains];
        parts.deformation.storage = storage;
        let scene = Scene::new(parts).expect("a scene");
        let (mut random, mut state) = (Random(domains as u64), State::rest(&scene));
        state.q.iter_mut().for_each(|coordinate| *coordinate = random.number());
        state.transforms.iter_mut().for_each(|transform| transform.0 = [0; 12].map(|_| random.number()));
        (scene, state)
    }

    /// `batch` block by block, with its rings, stages and ways out.
    fn twin_of_batch(tables: &Tables, args: BatchArgs, numbers: usize) -> Vec<f32> {
        let mut positions = vec![f32::NAN; numbers];
        for (tile, warp) in (0..tables.tiles.count()).flat_map(|tile| (0..WARPS).map(move |warp| (tile, warp))) {
            let mut warp = Warp::new(tables, args, (tile, warp));
            if warp.quads > 0 {
                let sums = warp.sums();
                for domain in (0..args.domains as usize).step_by(2) {
                    warp.store(&warp.staged(&sums, domain), domain, &mut positions);
                }
            }
        }
        positions
    }

    /// x of a vertex by the same arithmetic on U as it is given.
    fn x_of(scene: &Scene, state: &State, domain: usize, vertex: usize) -> [f32; 3] {
        let (shape, q) = (scene.shape_of(domain), state.q_of(scene, domain));
        let rest = shape.mesh.rest()[vertex];
        let bent = [0, 1, 2].map(|axis| {
            let entry = |(mode, q): (usize, &f32)| (shape.modes.at(vertex, axis, mode), *q);
            rest[axis] + q.iter().enumerate().map(entry).fold(0.0_f32, |sum, (entry, q)| entry.mul_add(q, sum))
        });
        [0, 1, 2].map(|row| placed(&state.transforms[domain].0[4 * row..], bent))
    }

    pub(in super::super) const SIZES: [(usize, usize, usize); 12] = [
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

    #[test]
    fn every_number_of_every_domain_is_written_once_and_has_the_bits_of_the_plain_sum() {
        for (vertices, rank, domains) in SIZES {
            let (scene, state) = ensemble(vertices, rank, domains, Storage::F32);
            let tables = Tables::of(&scene, &state);
            let args = args(&scene, tables.tiles.chunks());
            let got = twin_of_batch(&tables, args, 3 * scene.layout.vertices);
            for (packed, got) in got.chunks_exact(3).enumerate() {
                let (domain, vertex) = (packed / vertices, packed % vertices);
                let bits = |x: &[f32]| x.iter().map(|number| number.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(got), bits(&x_of(&scene, &state, domain, vertex)), "{vertices} {rank} {domains}");
                let other = x_of(&scene, &state, (domain + 1) % domains, (vertex + 1) % vertices);
                assert!(domains == 1 && vertices == 1 || got != other, "the judge can fail");
            }
        }
    }

    #[test]
    fn every_storage_finds_its_entries_scales_and_factors() {
        for storage in Storage::ALL {
            let tolerance = [1e-5, 1e-2, 8e-2, 8e-2][Storage::ALL.iter().position(|own| *own == storage).expect("one")];
            for (vertices, rank, domains) in SIZES {
                let (scene, state) = ensemble(vertices, rank, domains, storage);
                let tables = Tables::of(&scene, &state);
                let args = args(&scene, tables.tiles.chunks());
                let got = twin_of_batch(&tables, args, 3 * scene.layout.vertices);
                for (packed, got) in got.chunks_exact(3).enumerate() {
                    let want = x_of(&scene, &state, packed / vertices, packed % vertices);
                    let near = got.iter().zip(want).all(|(got, want)| (got - want).abs() < tolerance);
                    assert!(near, "{storage:?} {vertices} {rank} {domains}: {got:?} not {want:?}");
                }
            }
        }
    }

    #[test]
    fn as_many_vectors_are_summed_as_are_needed_and_shared_memory_holds_all_modes() {
        let vectors: Vec<usize> = (1..=MOST).map(|domains| vectors_for(domains).0).collect();
        assert_eq!(vectors, [4, 4, 4, 4, 8, 8, 8, 8, 16, 16, 16, 16, 16, 16, 16, 16]);
        // 64 KiB is what the smallest device has.
        assert!(shared_bytes(MOST, crate::domain::MAX_RANK) <= 64 << 10);
        let (scene, _) = ensemble(9, 2, 17, Storage::F32);
        assert!(check(&scene, MOST).expect_err("17 domains").to_string().contains("at most 16"));
        let (scene, _) = trial_scene(&[(9, 2, 1), (9, 2, 1)]);
        check(&scene, MOST).expect_err("two shapes");
        check(&ensemble(9, 2, 16, Storage::F32).0, MOST).expect("16 of one shape");
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_batch() {
        compile_all(&CODE);
    }
}
