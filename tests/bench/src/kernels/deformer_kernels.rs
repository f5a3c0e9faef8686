//! Benchmarks the kernels of the CUDA deformer, with the deformer's launchers and tables. Inputs are uploaded in
//! advance.

use std::sync::Arc;

use serde::Serialize;

use super::input_sets::InputSets;
use super::kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::launchers::{
    ApplyKernel, BoundsKernel, ChangeListLengths, ChangedDomains, DeformKernel, DeviceTables, NormalsKernel,
    PositionKernels, plan_from_tables,
};
use modalcast_compute::gpu::step_input::{InputPart, StagingBuffer, StepHeader, StepInputs};
use modalcast_compute::gpu::{BufferRole, CudaDeformerOptions, DeformPlan, Device, KernelDescriptor, KernelKind};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// The outputs that the launched kernels of a step compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum StepOutputs {
    /// u = U q alone. Scenes with batches (domains that share U and are computed together) are rejected. For
    /// validation, the host computes x = T (x0 + u) in f64.
    Uq,
    /// Positions, and the bounding box of each warp's vertices.
    Positions,
    /// Positions, the bounding box of all vertices, normals, and tangents if the scene has normal maps.
    Whole,
}

impl StepOutputs {
    const fn suffix(self) -> &'static str {
        match self {
            Self::Uq => "_uq",
            Self::Positions => "_positions",
            Self::Whole => "",
        }
    }
}

/// The kernels of the CUDA deformer for a scene, with the inputs of several steps.
#[derive(Debug)]
pub struct DeformerBenchmark {
    name: String,
    step_outputs: StepOutputs,
    scene: Arc<Scene>,
    deform: DeformKernel,
    bounds: BoundsKernel,
    normals: Option<NormalsKernel>,
    /// Whether a launch computes only the changed domains.
    is_partial: bool,
    /// One per input set.
    step_inputs: Vec<StepInputs>,
    /// Positions, normals, tangents and displacements, one after the other.
    outputs: DeviceBuffer,
    /// Computes positions on the host for [`StepOutputs::Uq`]. Its device buffers are empty.
    input_sets: InputSets,
    plan: DeformPlan,
    counts: StepCounts,
}

/// The step that a [`DeformerBenchmark`] measures.
#[derive(Debug, Clone, Copy)]
pub struct BenchmarkStep<'a> {
    pub outputs: StepOutputs,
    pub batches: BatchPolicy,
    /// The domains that a partial step changes; the other domains keep the positions that
    /// [`KernelBenchmark::compute_skipped_domains`] computed. `None` measures full steps.
    pub changed: Option<&'a [u32]>,
}

impl BenchmarkStep<'_> {
    /// A full step with the default batching.
    pub fn full(outputs: StepOutputs) -> Self {
        Self { outputs, batches: BatchPolicy::default(), changed: None }
    }
}

/// Counts and bytes from which the memory traffic of a step is computed.
#[derive(Debug, Clone, Copy)]
struct StepCounts {
    vertices: u64,
    coordinates: u64,
    transform_bytes: u64,
    mode_bytes: u64,
    rest_bytes: u64,
}

impl DeformerBenchmark {
    /// Packs and uploads the scene and the values of each state.
    ///
    /// # Errors
    /// `Invalid` when there is no state, [`StepOutputs::Uq`] is requested for a scene with batches, or the list of
    /// changes is too long for a partial step; `Unavailable` when NVRTC is missing; `Fault` when the device fails.
    pub fn new(device: &Device, scene: &Arc<Scene>, states: &[SceneState], step: BenchmarkStep<'_>) -> Result<Self> {
        let BenchmarkStep { outputs: step_outputs, batches, changed } = step;
        let options = CudaDeformerOptions { batches, bounding_axes: scene.light_axes() };
        let tables = DeviceTables::new(scene, options);
        let plan = plan_from_tables(scene, &tables);
        if step_outputs == StepOutputs::Uq && plan.kernel(KernelKind::Batch).is_some() {
            return Err(invalid("deform.batches", "never for u = U q alone", "batches"));
        }
        let normals = plan.kernel(KernelKind::Normals).filter(|_| step_outputs == StepOutputs::Whole);
        let normals = normals.map(|kernel| NormalsKernel::new(device, scene, &tables, kernel)).transpose()?;
        let mut deform = plan.require_kernel(KernelKind::Deform)?.clone();
        select_output_defines(&mut deform, step_outputs);
        let kernels = PositionKernels { deform: &deform, batch: plan.kernel(KernelKind::Batch) };
        let deform = DeformKernel::new(device, scene, kernels, tables)?;
        let outputs = DeviceBuffer::zeroed(device, output_bytes(&plan).iter().sum())?;
        let mut benchmark = Self {
            name: format!("ours_{}{}", scene.deformation.storage.name(), step_outputs.suffix()),
            step_outputs,
            scene: Arc::clone(scene),
            bounds: BoundsKernel::new(
                device,
                plan.require_kernel(KernelKind::Bounds)?,
                options.bounding_axes,
                &deform,
            )?,
            normals,
            is_partial: changed.is_some(),
            step_inputs: Vec::new(),
            outputs,
            input_sets: InputSets::new(device, scene, states, |_| [Vec::new(), Vec::new()])?,
            counts: count_step(scene, &plan, changed),
            deform,
            plan,
        };
        let mut staging = None;
        for state in states {
            // Step 1 is a full step: it computes all domains.
            let header = StepHeader { last_full_step: 1, step: 1, ..benchmark.header() };
            let inputs = StepInputs::new(device, benchmark.deform.packer())?;
            let staging = match &mut staging {
                Some(staging) => staging,
                empty => empty.insert(inputs.allocate_staging(device)?),
            };
            upload_step(device, (&inputs, staging), &header, state)?;
            benchmark.step_inputs.push(inputs);
        }
        changed.map_or(Ok(()), |changed| benchmark.apply_changes(device, states, changed))?;
        Ok(benchmark)
    }

    /// Replaces each input set by that of a step that changes only these domains.
    fn apply_changes(&self, device: &Device, states: &[SceneState], changed: &[u32]) -> Result<()> {
        let requirement = "a quarter of the domains at most, and less work than a whole step";
        let not_partial = || invalid("changed", requirement, changed.len());
        let mut apply = ApplyKernel::new(
            device,
            self.deform.packer(),
            self.plan.kernel(KernelKind::Apply).ok_or_else(not_partial)?,
        )?;
        let mut change_list = apply.allocate_list(device)?;
        let full_step = StepHeader { last_full_step: 1, ..self.header() };
        for (inputs, state) in self.step_inputs.iter().zip(states) {
            let mut staging = inputs.allocate_staging(device)?;
            // No domain is outdated: step 1 computed all domains.
            let lengths = apply.write(
                &mut change_list,
                self.deform.packer(),
                state,
                ChangedDomains { changed, outdated: &[] },
            )?;
            let ChangeListLengths { change_count, dirty_tile_count } = lengths.ok_or_else(not_partial)?;
            // The output buffers contain step 1. Step 2 changes the listed domains.
            let header = StepHeader { output_step: 1, step: 2, change_count, dirty_tile_count, ..full_step };
            upload_step(device, (inputs, &mut staging), &header, state)?;
            // SAFETY: `change_list` was written above with the packer that `deform` and `inputs` use. The next
            // statement waits for the kernel.
            unsafe { apply.launch(device, &change_list, inputs, &self.deform) }?;
            device.stream().synchronize().map_err(fault_in("upload"))?;
        }
        Ok(())
    }

    fn header(&self) -> StepHeader {
        let [position_bytes, normal_bytes, tangent_bytes, _] = output_bytes(&self.plan);
        let base = self.outputs.address();
        debug_assert!(position_bytes + normal_bytes + tangent_bytes > 0);
        StepHeader {
            positions: base,
            normals: base + position_bytes,
            tangents: base + position_bytes + normal_bytes,
            // With `Uq`, u is written to the buffer of the positions.
            displacements: if self.step_outputs == StepOutputs::Uq {
                base
            } else {
                base + position_bytes + normal_bytes + tangent_bytes
            },
            ..StepHeader::default()
        }
    }

    fn step_inputs(&self, input_set: usize) -> &StepInputs {
        &self.step_inputs[input_set % self.step_inputs.len()]
    }

    /// Computes the positions of all domains.
    fn launch_all_positions(&self, device: &Device, input_set: usize) -> Result<()> {
        // SAFETY: the inputs hold all values of a step of this scene, and the addresses of `outputs` in their header.
        // `self` owns the inputs and the outputs, and releasing device memory is stream-ordered.
        unsafe { self.deform.launch(device, self.step_inputs(input_set)) }
    }
}

/// Removes the macros of outputs that are not requested, and adds the macros of [`StepOutputs::Uq`].
fn select_output_defines(kernel: &mut KernelDescriptor, step_outputs: StepOutputs) {
    if step_outputs != StepOutputs::Whole {
        kernel.defines.retain(|define| !["RIGID_NORMALS", "CORNER_OFFSETS", "NORMAL_MAPS", "SHEAR"].contains(define));
    }
    if step_outputs == StepOutputs::Uq {
        kernel.defines.retain(|define| *define != "DISPLACEMENTS");
        kernel.defines.extend(["DISPLACEMENTS", "DISPLACEMENTS_ONLY"]);
    }
}

/// Writes a step to its staging buffer, uploads it and waits for the copy.
fn upload_step(
    device: &Device,
    (inputs, staging): (&StepInputs, &mut StagingBuffer),
    header: &StepHeader,
    state: &SceneState,
) -> Result<()> {
    inputs.write(staging, header, state)?;
    // SAFETY: the next statement waits for the copy.
    unsafe { inputs.send(device, staging, InputPart::All) }?;
    device.stream().synchronize().map_err(fault_in("upload"))
}

/// Bytes of positions, normals, tangents and displacements, each rounded up to the 16 bytes of a float4.
fn output_bytes(plan: &DeformPlan) -> [u64; 4] {
    [BufferRole::Positions, BufferRole::Normals, BufferRole::Tangents, BufferRole::Displacements]
        .map(|role| plan.bytes(role).next_multiple_of(16))
}

/// The counts of a step that changes the domains `changed`; `None` means all domains.
fn count_step(scene: &Scene, plan: &DeformPlan, changed: Option<&[u32]>) -> StepCounts {
    let domain_layouts = &scene.layout.domains;
    // A domain reads 48 bytes: its T, or its frame if it follows another domain. In scenes with followers, it also
    // reads its transform link, 8 bytes.
    let bytes_per_transform = if scene.features.followers { 56 } else { 48 };
    match changed {
        None => StepCounts {
            vertices: scene.layout.vertices as u64,
            transform_bytes: bytes_per_transform * domain_layouts.len() as u64,
            coordinates: scene.layout.coordinates as u64,
            mode_bytes: plan.bytes(BufferRole::ModeWords),
            rest_bytes: plan.bytes(BufferRole::RestPositions),
        },
        Some(changed_domains) => {
            let changed_layouts = || changed_domains.iter().map(|domain| domain_layouts[*domain as usize]);
            let mode_entries = |domain_layout: modalcast_model::scene::DomainLayout| {
                (domain_layout.vertices * domain_layout.rank) as u64
            };
            let all_entries: u64 = domain_layouts.iter().map(|domain_layout| mode_entries(*domain_layout)).sum();
            let changed_entries: u64 = changed_layouts().map(mode_entries).sum();
            let vertices: u64 = changed_layouts().map(|domain_layout| domain_layout.vertices as u64).sum();
            StepCounts {
                vertices,
                transform_bytes: bytes_per_transform * changed_domains.len() as u64,
                coordinates: changed_layouts().map(|domain_layout| domain_layout.rank as u64).sum(),
                mode_bytes: plan.bytes(BufferRole::ModeWords) * changed_entries / all_entries.max(1),
                rest_bytes: 12 * vertices,
            }
        }
    }
}

impl KernelBenchmark for DeformerBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn input_set_count(&self) -> usize {
        self.step_inputs.len()
    }

    fn compute_skipped_domains(&self, device: &Device, input_set: usize) -> Result<()> {
        if self.is_partial { self.launch_all_positions(device, input_set) } else { Ok(()) }
    }

    fn launch(&self, device: &Device, input_set: usize) -> Result<()> {
        let inputs = self.step_inputs(input_set);
        self.input_sets.select(input_set);
        if self.is_partial {
            // SAFETY: as in `launch_all_positions`; `apply` has written the tile list.
            unsafe { self.deform.launch_tile_list(device, inputs) }?;
        } else {
            self.launch_all_positions(device, input_set)?;
        }
        if self.step_outputs == StepOutputs::Whole {
            // SAFETY: as in `launch_all_positions`.
            unsafe { self.bounds.launch(device, inputs, &self.deform) }?;
        }
        // SAFETY: as in `launch_all_positions`.
        self.normals.as_ref().map_or(Ok(()), |normals| unsafe { normals.launch(device, inputs) })
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let mut numbers = vec![0.0_f32; (self.plan.bytes(BufferRole::Positions) / 4) as usize];
        self.outputs.read(device, 0, &mut numbers)?;
        if self.step_outputs != StepOutputs::Uq {
            return Ok(numbers);
        }
        let domain_layouts = &self.scene.layout.domains;
        Ok(self.input_sets.compute_positions_on_host(|domain, vertex| {
            let first_number = 3 * (domain_layouts[domain].first_vertex + vertex);
            [numbers[first_number], numbers[first_number + 1], numbers[first_number + 2]]
        }))
    }

    fn traffic(&self) -> Vec<ArrayTraffic> {
        let StepCounts { vertices, coordinates, transform_bytes, mode_bytes, rest_bytes } = self.counts;
        let mut traffic = vec![
            ArrayTraffic::new("U", mode_bytes),
            ArrayTraffic::new("scales", self.plan.bytes(BufferRole::Scales)),
            ArrayTraffic::new("q", 4 * coordinates),
        ];
        traffic.push(ArrayTraffic::new("u or x", 12 * vertices));
        if self.scene.features.displacements && self.step_outputs != StepOutputs::Uq {
            // The scene stores displacements as an output, in addition to positions.
            traffic.push(ArrayTraffic::new("u kept", 12 * vertices));
        }
        if self.step_outputs != StepOutputs::Uq {
            traffic.extend([ArrayTraffic::new("x0", rest_bytes), ArrayTraffic::new("T", transform_bytes)]);
        }
        if self.step_outputs == StepOutputs::Whole {
            let roles = [BufferRole::RestNormals, BufferRole::Normals, BufferRole::RestTangents, BufferRole::Tangents];
            traffic
                .push(ArrayTraffic::new("normals and tangents", roles.iter().map(|role| self.plan.bytes(*role)).sum()));
        }
        traffic
    }

    fn launches_per_step(&self) -> usize {
        let bounds_launches = usize::from(self.step_outputs == StepOutputs::Whole);
        self.deform.kernels().len() + bounds_launches + usize::from(self.normals.is_some())
    }

    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        let functions = self.deform.kernels().into_iter().chain([("bounds", self.bounds.function())]);
        let functions = functions.chain(self.normals.iter().map(|normals| ("normals", normals.function())));
        functions.filter_map(|(name, function)| KernelAttributes::query(name, function).ok()).collect()
    }
}
