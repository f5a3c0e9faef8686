//! cuBLAS as a competitor: u = U q as its products, each followed by a plain vertex update. Loaded at run time; only
//! benchmarks use it.

mod batch;
mod library;

pub use batch::CublasMethod;
pub use library::cublas_version;

use std::sync::Arc;

use super::input_sets::{InputSets, Part};
use super::kernel_benchmark::{KernelAttributes, KernelBenchmark};
use super::plain_update::PlainUpdate;
use batch::GemmBatches;
use library::{CublasHandle, GemmCall, GroupedGemm};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, SceneState};

/// cuBLAS for a scene, with the inputs of several steps.
#[derive(Debug)]
pub struct CublasBenchmark {
    // Declared first and therefore dropped first: dropping it waits for its work on the buffers below.
    blas: CublasHandle,
    peer: CublasMethod,
    part: Part,
    batches: GemmBatches,
    u_matrices: DeviceBuffer,
    u: DeviceBuffer,
    update: Option<PlainUpdate>,
    /// First float of each domain's u; `None` for domains without modes.
    places: Vec<Option<u64>>,
    turns: InputSets,
    pointers: Option<PointerArrays>,
}

/// Device arrays with one pointer per problem: to U, to u, and to q for each turn.
#[derive(Debug)]
struct PointerArrays {
    matrices: DeviceBuffer,
    outputs: DeviceBuffer,
    q: DeviceBuffer,
    problems: u64,
}

impl CublasBenchmark {
    /// Packs a scene for one kind of product.
    ///
    /// # Errors
    /// `Invalid` when `peer` does not support the scene, or there is no state; `Unavailable` when cuBLAS is missing or
    /// too old, or the device has too little memory; `Fault` when the device fails.
    pub fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (peer, part): (CublasMethod, Part),
    ) -> Result<Self> {
        let batches = GemmBatches::of(scene, peer)?;
        check_memory(device, &batches)?;
        let blas = CublasHandle::new(device)?;
        blas.check_has(peer == CublasMethod::Grouped, peer.as_vectors())?;
        let places = batches.places_of_u(scene.domains.len());
        let u_matrices = upload_matrices(device, scene, &batches, peer)?;
        let u = DeviceBuffer::zeroed(device, 4 * batches.floats[2])?;
        let transforms = |state: &SceneState| bytemuck::cast_slice(&state.world_transforms(scene)).to_vec();
        let turns = InputSets::new(device, scene, states, |state| [batches.pack_q(scene, state), transforms(state)])?;
        let pointers =
            (peer == CublasMethod::Grouped).then(|| PointerArrays::new(device, &batches, [&u_matrices, &u], &turns));
        let update = (part == Part::Whole).then(|| PlainUpdate::new(device, scene, &places)).transpose()?;
        Ok(Self { blas, peer, part, pointers: pointers.transpose()?, batches, u_matrices, u, update, places, turns })
    }

    fn multiply(&self, q: u64, turn: usize) -> Result<()> {
        if let Some(pointers) = &self.pointers {
            let groups: Vec<GemmCall> = self.batches.list.iter().map(|batch| batch.product).collect();
            let q = pointers.q.address() + 8 * pointers.problems * (turn % self.turns.count()) as u64;
            let pointers = [pointers.matrices.address(), q, pointers.outputs.address()];
            // SAFETY: the arrays have a pointer for each problem, in the order of the groups, each to memory of the
            // size that `GemmBatches` planned.
            return unsafe { self.blas.grouped(&GroupedGemm { groups: &groups, pointers }) };
        }
        let bases = [self.u_matrices.address(), q, self.u.address()];
        for batch in &self.batches.list {
            let at: [u64; 3] = std::array::from_fn(|of| bases[of] + 4 * batch.first[of]);
            // SAFETY: the three buffers have the sizes that `GemmBatches` planned, and this batch lies inside them. The
            // products of the first three kinds have a `count` of 1, and those of the first two have one column.
            unsafe {
                match self.peer {
                    CublasMethod::SgemvColumns | CublasMethod::SgemvRows => {
                        self.blas.gemv(batch.product, self.peer == CublasMethod::SgemvRows, at)?;
                    }
                    CublasMethod::Instances => self.blas.gemm(batch.product, at)?,
                    _ => self.blas.strided(batch.product, self.peer.as_vectors(), at)?,
                }
            }
        }
        Ok(())
    }
}

impl KernelBenchmark for CublasBenchmark {
    fn name(&self) -> String {
        self.part.named(self.peer.name())
    }

    fn turns(&self) -> usize {
        self.turns.count()
    }

    fn launch(&self, device: &Device, turn: usize) -> Result<()> {
        let values = self.turns.start(turn);
        self.multiply(values.q, turn)?;
        let u = self.u.address();
        self.update.as_ref().map_or(Ok(()), |update| update.launch(device, values.transforms, u))
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        if let Some(update) = &self.update {
            return update.positions(device);
        }
        let mut u = vec![0.0_f32; self.batches.floats[2] as usize];
        self.u.read(device, 0, &mut u)?;
        let places = &self.places;
        Ok(self.turns.finish_on_host(|domain, vertex| {
            let of = |first: u64| [0, 1, 2].map(|axis| u[first as usize + 3 * vertex + axis]);
            places[domain].map_or([0.0; 3], of)
        }))
    }

    /// U counts as stored, padding included.
    fn bytes(&self) -> Vec<(&'static str, u64)> {
        let [matrices, q, u] = self.batches.floats.map(|floats| 4 * floats);
        let mut bytes = vec![("U as stored", matrices), ("q", q), ("u written", u)];
        bytes.extend(self.pointers.iter().map(|pointers| ("pointers", 24 * pointers.problems)));
        bytes.extend(self.update.iter().flat_map(PlainUpdate::bytes));
        bytes
    }

    /// Calls of the library, each of which may launch several kernels, plus the update.
    fn launches(&self) -> usize {
        let calls = if self.pointers.is_some() { 1 } else { self.batches.list.len() };
        calls + usize::from(self.update.is_some())
    }

    /// Facts about the update alone, because the library's kernels are not accessible.
    fn kernels(&self) -> Vec<KernelAttributes> {
        self.update.iter().map(|update| update.facts().clone()).collect()
    }
}

impl PointerArrays {
    fn new(
        device: &Device,
        batches: &GemmBatches,
        [matrices, u]: [&DeviceBuffer; 2],
        turns: &InputSets,
    ) -> Result<Self> {
        let problems =
            || batches.list.iter().flat_map(|batch| (0..batch.domains.len()).map(move |index| (batch, index)));
        let list = |base: u64, of: usize| problems().map(move |(batch, index)| base + 4 * batch.place(index, of));
        let of_turn = |turn: usize| list(turns.start(turn).q, 1);
        Ok(Self {
            matrices: DeviceBuffer::upload(device, &list(matrices.address(), 0).collect::<Vec<u64>>())?,
            outputs: DeviceBuffer::upload(device, &list(u.address(), 2).collect::<Vec<u64>>())?,
            q: DeviceBuffer::upload(device, &(0..turns.count()).flat_map(of_turn).collect::<Vec<u64>>())?,
            problems: problems().count() as u64,
        })
    }
}

fn upload_matrices(device: &Device, scene: &Scene, batches: &GemmBatches, peer: CublasMethod) -> Result<DeviceBuffer> {
    let mut buffer = DeviceBuffer::zeroed(device, 4 * batches.floats[0])?;
    for batch in &batches.list {
        let stored = if peer == CublasMethod::Instances { 1 } else { batch.domains.len() };
        for (index, domain) in batch.domains.iter().enumerate().take(stored) {
            let matrix = batch.matrix(scene, *domain, peer == CublasMethod::SgemvRows);
            buffer.write(device, 4 * batch.place(index, 0), &matrix)?;
        }
    }
    Ok(buffer)
}

/// Checks that the padded matrices fit into free device memory, before any of it is allocated.
///
/// # Errors
/// `Unavailable` when they do not fit.
fn check_memory(device: &Device, batches: &GemmBatches) -> Result<()> {
    let (free, _) = device.memory()?;
    let bytes: u64 = batches.floats.iter().map(|floats| 4 * floats).sum();
    if bytes <= free as u64 {
        return Ok(());
    }
    let reason = format!("the products need {bytes} bytes, {free} are free on {}", device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Leave this trial out for this scene".into() })
}
