//! u = U q by cuBLAS, alone or followed by a plain vertex update, for comparison with the server's kernels. cuBLAS is
//! loaded at run time; only benchmarks use it.

mod batch;
mod library;

pub use batch::CublasMethod;
pub use library::cublas_version;

use std::sync::Arc;

use super::input_sets::{InputSets, StepPart};
use super::kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
use super::plain_update::PlainUpdate;
use batch::{GemmPlan, Operand};
use library::{CublasHandle, GemmCall, GroupedGemm, check_functions};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, SceneState};

/// cuBLAS for a scene, with the inputs of several steps.
#[derive(Debug)]
pub struct CublasBenchmark {
    cublas: CublasHandle<ProductBuffers>,
    method: CublasMethod,
    part: StepPart,
    plan: GemmPlan,
    update: Option<PlainUpdate>,
    /// Offset of each domain's u, in floats; `None` for domains without modes.
    u_offsets: Vec<Option<u64>>,
}

/// Operands of the products on the device.
#[derive(Debug)]
struct ProductBuffers {
    matrices: DeviceBuffer,
    u: DeviceBuffer,
    input_sets: InputSets,
    /// Only for [`CublasMethod::Grouped`].
    pointers: Option<PointerArrays>,
}

/// Device arrays of pointers to the operands, in the order of the products.
#[derive(Debug)]
struct PointerArrays {
    matrices: DeviceBuffer,
    u: DeviceBuffer,
    /// The pointers of all input sets, one input set after the other.
    q: DeviceBuffer,
    product_count: u64,
}

impl CublasBenchmark {
    /// Packs and uploads a scene for one method.
    ///
    /// # Errors
    /// `Invalid` when `method` does not support the scene, or there is no state; `Unavailable` when cuBLAS is missing
    /// or too old, or the device has too little memory; `Fault` when the device fails.
    pub fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (method, part): (CublasMethod, StepPart),
    ) -> Result<Self> {
        let plan = GemmPlan::new(scene, method)?;
        check_memory(device, &plan)?;
        let is_grouped = method == CublasMethod::Grouped;
        check_functions(is_grouped, method.uses_strided_gemv())?;
        let u_offsets = plan.u_offsets(scene.domains.len());
        let matrices = upload_matrices(device, scene, &plan, method)?;
        let u = DeviceBuffer::zeroed(device, 4 * plan.floats[Operand::Displacements as usize])?;
        let transforms = |state: &SceneState| bytemuck::cast_slice(&state.world_transforms(scene)).to_vec();
        let input_sets = InputSets::new(device, scene, states, |state| [plan.pack_q(scene, state), transforms(state)])?;
        let pointers = is_grouped.then(|| PointerArrays::new(device, &plan, [&matrices, &u], &input_sets));
        let buffers = ProductBuffers { matrices, u, pointers: pointers.transpose()?, input_sets };
        let update = (part == StepPart::Whole).then(|| PlainUpdate::new(device, scene, &u_offsets)).transpose()?;
        Ok(Self { cublas: CublasHandle::new(device, buffers)?, method, part, plan, update, u_offsets })
    }

    /// Enqueues u = U q of all domains. `q` is the address of the coordinates of this input set. Grouped products read
    /// the pointers of the input set instead.
    fn multiply(&self, q: u64, input_set: usize) -> Result<()> {
        let ProductBuffers { matrices, u, input_sets, pointers } = &self.cublas.buffers;
        if let Some(pointers) = pointers {
            let groups: Vec<GemmCall> = self.plan.batches.iter().map(|batch| batch.call).collect();
            // A pointer has 8 bytes.
            let q_pointers =
                pointers.q.address() + 8 * pointers.product_count * (input_set % input_sets.count()) as u64;
            let pointers = [pointers.matrices.address(), q_pointers, pointers.u.address()];
            // SAFETY: the arrays have a pointer for each product, in the order of the groups, each to memory of the
            // size that `GemmPlan` planned.
            return unsafe { self.cublas.multiply_grouped(&GroupedGemm { groups: &groups, pointers }) };
        }
        let addresses = [matrices.address(), q, u.address()];
        for batch in &self.plan.batches {
            let operands: [u64; 3] = std::array::from_fn(|operand| addresses[operand] + 4 * batch.offsets[operand]);
            // SAFETY: the three buffers have the sizes that `GemmPlan` planned, and this batch lies inside them.
            // `count` is 1 for `SgemvColumns`, `SgemvRows` and `Instances`. `columns` is 1 except for `Instances`.
            unsafe {
                match self.method {
                    CublasMethod::SgemvColumns | CublasMethod::SgemvRows => {
                        self.cublas.gemv(batch.call, self.method == CublasMethod::SgemvRows, operands)?;
                    }
                    CublasMethod::Instances => self.cublas.gemm(batch.call, operands)?,
                    _ => self.cublas.multiply_strided(batch.call, self.method.uses_strided_gemv(), operands)?,
                }
            }
        }
        Ok(())
    }
}

impl KernelBenchmark for CublasBenchmark {
    fn name(&self) -> String {
        self.part.benchmark_name(self.method.name())
    }

    fn input_set_count(&self) -> usize {
        self.cublas.buffers.input_sets.count()
    }

    fn launch(&self, device: &Device, input_set: usize) -> Result<()> {
        let inputs = self.cublas.buffers.input_sets.select(input_set);
        self.multiply(inputs.q, input_set)?;
        let u = self.cublas.buffers.u.address();
        self.update.as_ref().map_or(Ok(()), |update| update.launch(device, inputs.transforms, u))
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        if let Some(update) = &self.update {
            return update.positions(device);
        }
        let mut u = vec![0.0_f32; self.plan.floats[Operand::Displacements as usize] as usize];
        self.cublas.buffers.u.read(device, 0, &mut u)?;
        let u_offsets = &self.u_offsets;
        Ok(self.cublas.buffers.input_sets.compute_positions_on_host(|domain, vertex| {
            let displacement = |offset: u64| [0, 1, 2].map(|axis| u[offset as usize + 3 * vertex + axis]);
            u_offsets[domain].map_or([0.0; 3], displacement)
        }))
    }

    /// Counts U as stored, padding included.
    fn traffic(&self) -> Vec<ArrayTraffic> {
        let [matrices, q, u] = self.plan.floats.map(|floats| 4 * floats);
        let mut traffic = vec![
            ArrayTraffic::new("U as stored", matrices),
            ArrayTraffic::new("q", q),
            ArrayTraffic::new("u written", u),
        ];
        let pointers = self.cublas.buffers.pointers.iter();
        // A product has three pointers of 8 bytes.
        traffic.extend(pointers.map(|pointers| ArrayTraffic::new("pointers", 3 * 8 * pointers.product_count)));
        traffic.extend(self.update.iter().flat_map(PlainUpdate::traffic));
        traffic
    }

    /// Calls of cuBLAS plus the launch of the update. A call counts as one launch, although it may launch several
    /// kernels.
    fn launches_per_step(&self) -> usize {
        let calls = if self.cublas.buffers.pointers.is_some() { 1 } else { self.plan.batches.len() };
        calls + usize::from(self.update.is_some())
    }

    /// Attributes of the update alone. The kernels of cuBLAS are not accessible.
    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        self.update.iter().map(|update| update.attributes().clone()).collect()
    }
}

impl PointerArrays {
    fn new(
        device: &Device,
        plan: &GemmPlan,
        [matrices, u]: [&DeviceBuffer; 2],
        input_sets: &InputSets,
    ) -> Result<Self> {
        // Each product as its batch and its index in the batch.
        let products =
            || plan.batches.iter().flat_map(|batch| (0..batch.domains.len()).map(move |index| (batch, index)));
        let pointers =
            |base: u64, operand: Operand| products().map(move |(batch, index)| base + 4 * batch.offset(index, operand));
        let q_pointers = |input_set: usize| pointers(input_sets.select(input_set).q, Operand::Q);
        let q: Vec<u64> = (0..input_sets.count()).flat_map(q_pointers).collect();
        let matrices: Vec<u64> = pointers(matrices.address(), Operand::Matrix).collect();
        Ok(Self {
            matrices: DeviceBuffer::upload(device, &matrices)?,
            u: DeviceBuffer::upload(device, &pointers(u.address(), Operand::Displacements).collect::<Vec<u64>>())?,
            q: DeviceBuffer::upload(device, &q)?,
            product_count: products().count() as u64,
        })
    }
}

fn upload_matrices(device: &Device, scene: &Scene, plan: &GemmPlan, method: CublasMethod) -> Result<DeviceBuffer> {
    let mut buffer = DeviceBuffer::zeroed(device, 4 * plan.floats[Operand::Matrix as usize])?;
    for batch in &plan.batches {
        // Instances of one shape share one U.
        let matrix_count = if method == CublasMethod::Instances { 1 } else { batch.domains.len() };
        for (index, domain) in batch.domains.iter().enumerate().take(matrix_count) {
            let matrix = batch.pack_matrix(scene, *domain, method == CublasMethod::SgemvRows);
            buffer.write(device, 4 * batch.offset(index, Operand::Matrix), &matrix)?;
        }
    }
    Ok(buffer)
}

/// Checks that the padded operands fit into free device memory, before any of them is allocated.
///
/// # Errors
/// `Unavailable` when they do not fit.
fn check_memory(device: &Device, plan: &GemmPlan) -> Result<()> {
    let (free, _) = device.memory()?;
    let bytes: u64 = plan.floats.iter().map(|floats| 4 * floats).sum();
    if bytes <= free as u64 {
        return Ok(());
    }
    let reason = format!("the products need {bytes} bytes, but {free} are free on {}", device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Do not select this variant for this scene".into() })
}
