//! The deformer's own kernels as a trial: the same launchers and tables, on values that are uploaded beforehand.

use std::sync::Arc;

use serde::Serialize;

use super::input_sets::InputSets;
use super::kernel_benchmark::{KernelAttributes, KernelBenchmark};
use super::timer::MAX_GRAPHS;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::launchers::{
    ApplyKernel, BoundsKernel, ChangeListLengths, ChangedDomains, DeformKernel, DeviceTables, NormalsKernel,
    PositionKernels, plan_from_tables,
};
use modalcast_compute::gpu::step_input::{Header, InputPart, StagingBuffer, StepInputs};
use modalcast_compute::gpu::{BufferRole, DeformPlan, Device, KernelDescriptor, KernelKind};
use modalcast_compute::storage::modes_per_chunk;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// The part of a step to launch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum StepOutputs {
    /// u = U q alone, for scenes without batches. For validation, the host computes x = T (x0 + u) in f64.
    Uq,
    /// Positions, and a bounding box per warp.
    Positions,
    /// Positions, the bounds of all vertices, normals, and tangents where the scene has normal maps.
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

/// The `cuda` deformer of a scene, with the inputs of several steps.
#[derive(Debug)]
pub struct DeformerBenchmark {
    name: String,
    extent: StepOutputs,
    scene: Arc<Scene>,
    deform: DeformKernel,
    bounds: BoundsKernel,
    normals: Option<NormalsKernel>,
    listed: bool,
    inputs: Vec<StepInputs>,
    outputs: DeviceBuffer,
    turns: InputSets,
    plan: DeformPlan,
    /// Vertices and coordinates that a step computes, and the data that it reads.
    counts: ComputedCounts,
}

#[derive(Debug, Clone, Copy)]
struct ComputedCounts {
    vertices: u64,
    /// Bytes.
    transforms: u64,
    coordinates: u64,
    words: u64,
    rest: u64,
}

impl DeformerBenchmark {
    /// Packs and uploads the scene and the values of each state.
    ///
    /// # Errors
    /// `Invalid` when there is no state, or [`StepOutputs::Uq`] is requested for a scene with batches; `Unavailable` when
    /// NVRTC is missing; `Fault` when the device fails.
    pub fn new(device: &Device, scene: &Arc<Scene>, states: &[SceneState], extent: StepOutputs) -> Result<Self> {
        Self::of_changed(device, scene, states, (extent, None))
    }

    /// The same, for steps that change only the listed domains. The other domains keep the positions that
    /// [`KernelBenchmark::complete`] computed.
    ///
    /// # Errors
    /// Those of [`Self::new`], and `Invalid` when the list of changes is too long for a partial step.
    pub fn of_changed(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        (extent, changed): (StepOutputs, Option<&[u32]>),
    ) -> Result<Self> {
        let tables = DeviceTables::new(scene, scene.light_axes());
        let plan = plan_from_tables(scene, &tables);
        if extent == StepOutputs::Uq && plan.kernel(KernelKind::Batch).is_some() {
            return Err(invalid("deform.batches", "never, where u alone is computed", "batches"));
        }
        let normals = plan.kernel(KernelKind::Normals).filter(|_| extent == StepOutputs::Whole);
        let normals = normals.map(|kernel| NormalsKernel::new(device, scene, &tables, kernel)).transpose()?;
        let mut deform = plan.require_kernel(KernelKind::Deform)?.clone();
        leave_out(&mut deform, extent);
        let kernels = PositionKernels { deform: &deform, batch: plan.kernel(KernelKind::Batch) };
        let deform = DeformKernel::new(device, scene, kernels, tables)?;
        let outputs = DeviceBuffer::zeroed(device, outputs_of(&plan).iter().sum())?;
        let mut ours = Self {
            name: format!("ours_{}{}", scene.deformation.storage.name(), extent.suffix()),
            extent,
            scene: Arc::clone(scene),
            bounds: BoundsKernel::new(device, plan.require_kernel(KernelKind::Bounds)?, scene.light_axes(), &deform)?,
            normals,
            listed: changed.is_some(),
            inputs: Vec::new(),
            outputs,
            turns: InputSets::new(device, scene, states, |_| [Vec::new(), Vec::new()])?,
            counts: counts(scene, &plan, changed),
            deform,
            plan,
        };
        let mut staging = None;
        for state in states {
            let header = Header { last_full_step: 1, step: 1, ..ours.header() };
            let mut inputs = StepInputs::new(device, ours.deform.packing())?;
            let staging = match &mut staging {
                Some(staging) => staging,
                none => none.insert(inputs.staging(device)?),
            };
            send(device, (&mut inputs, staging), &header, state)?;
            ours.inputs.push(inputs);
        }
        changed.map_or(Ok(()), |changed| ours.apply(device, states, changed))?;
        Ok(ours)
    }

    /// Turns the inputs of each turn into those of a step that changed these domains.
    fn apply(&mut self, device: &Device, states: &[SceneState], changed: &[u32]) -> Result<()> {
        let allowed = "a quarter of the domains at most, no truncation, and less work than a whole step";
        let too_many = || invalid("changed", allowed, changed.len());
        let mut apply =
            ApplyKernel::new(device, self.deform.packing(), self.plan.kernel(KernelKind::Apply).ok_or_else(too_many)?)?;
        let mut list = apply.list(device)?;
        let old = Header { last_full_step: 1, ..self.header() };
        for (inputs, state) in self.inputs.iter_mut().zip(states) {
            let mut staging = inputs.staging(device)?;
            let lengths =
                apply.write(&mut list, self.deform.packing(), state, ChangedDomains { changed, outdated: &[] })?;
            let ChangeListLengths { changed, dirty_tiles } = lengths.ok_or_else(too_many)?;
            let header = Header { output_step: 1, step: 2, changed, dirty_tiles, ..old };
            send(device, (inputs, &mut staging), &header, state)?;
            // SAFETY: the lists were written above for the packing of `deform` and of the inputs, and the next statement
            // waits for the kernel.
            unsafe { apply.launch(device, &list, inputs, &self.deform) }?;
            device.stream().synchronize().map_err(fault_in("upload"))?;
        }
        Ok(())
    }

    fn header(&self) -> Header {
        let [positions, normals, tangents, _] = outputs_of(&self.plan);
        let begin = self.outputs.address();
        debug_assert!(positions + normals + tangents > 0);
        Header {
            positions: begin,
            normals: begin + positions,
            tangents: begin + positions + normals,
            // With u alone, u takes the place of the positions.
            displacements: if self.extent == StepOutputs::Uq { begin } else { begin + positions + normals + tangents },
            ..Header::default()
        }
    }

    /// Fraction of the chunks of modes that are summed, weighted by vertices, as a mean over the timed turns; `None`
    /// without truncation.
    fn kept(&self) -> Option<f64> {
        let per_chunk = modes_per_chunk(self.scene.deformation.storage);
        let weigh = |chunks: &dyn Fn(usize) -> usize| -> f64 {
            let slots = self.scene.layout.slots.iter().enumerate();
            slots.map(|(domain, slot)| slot.vertices as f64 * chunks(domain) as f64).sum()
        };
        let all = weigh(&|domain| self.scene.rank_of(domain).div_ceil(per_chunk));
        let shares = self.inputs.iter().take(MAX_GRAPHS).map(|inputs| {
            let kept = inputs.retained_chunk_counts()?;
            Some(weigh(&|domain| kept[domain] as usize) / all.max(1.0))
        });
        let shares: Vec<f64> = shares.collect::<Option<_>>()?;
        Some(shares.iter().sum::<f64>() / shares.len().max(1) as f64)
    }

    fn inputs(&self, turn: usize) -> &StepInputs {
        &self.inputs[turn % self.inputs.len()]
    }

    /// Computes the positions of all domains.
    fn launch_all_positions(&self, device: &Device, turn: usize) -> Result<()> {
        // SAFETY: the inputs are whole steps of this scene, whose header has the addresses of `outputs`. `self` owns the
        // inputs and the outputs, and device memory is released in the order of the stream.
        unsafe { self.deform.launch(device, self.inputs(turn)) }
    }
}

/// Removes the macros of features that this part of a step does not compute.
fn leave_out(kernel: &mut KernelDescriptor, extent: StepOutputs) {
    if extent != StepOutputs::Whole {
        kernel.defines.retain(|define| !["RIGID_NORMALS", "CORNER_OFFSETS", "NORMAL_MAPS", "SHEAR"].contains(define));
    }
    if extent == StepOutputs::Uq {
        kernel.defines.retain(|define| *define != "DISPLACEMENTS");
        kernel.defines.extend(["DISPLACEMENTS", "DISPLACEMENTS_ONLY"]);
    }
}

fn send(
    device: &Device,
    (inputs, staging): (&mut StepInputs, &mut StagingBuffer),
    header: &Header,
    state: &SceneState,
) -> Result<()> {
    inputs.write(staging, header, state)?;
    // SAFETY: the next statement waits for the copy.
    unsafe { inputs.send(device, staging, InputPart::Whole) }?;
    device.stream().synchronize().map_err(fault_in("upload"))
}

/// Bytes of positions, normals, tangents and displacements, each rounded up to the alignment of a float4.
fn outputs_of(plan: &DeformPlan) -> [u64; 4] {
    [BufferRole::Positions, BufferRole::Normals, BufferRole::Tangents, BufferRole::Displacements]
        .map(|role| plan.bytes(role).next_multiple_of(16))
}

fn counts(scene: &Scene, plan: &DeformPlan, changed: Option<&[u32]>) -> ComputedCounts {
    let slots = &scene.layout.slots;
    // With followers every domain reads the index of its mover in addition to its own T or frame.
    let transform = if scene.needs.followers { 56 } else { 48 };
    match changed {
        None => ComputedCounts {
            vertices: scene.layout.vertices as u64,
            transforms: transform * slots.len() as u64,
            coordinates: scene.layout.coordinates as u64,
            words: plan.bytes(BufferRole::ModeWords),
            rest: plan.bytes(BufferRole::RestPositions),
        },
        Some(list) => {
            let chosen = || list.iter().map(|domain| slots[*domain as usize]);
            let share = |slot: modalcast_model::scene::DomainLayout| (slot.vertices * slot.rank) as u64;
            let all: u64 = slots.iter().map(|slot| share(*slot)).sum();
            let own: u64 = chosen().map(share).sum();
            let vertices: u64 = chosen().map(|slot| slot.vertices as u64).sum();
            ComputedCounts {
                vertices,
                transforms: transform * list.len() as u64,
                coordinates: chosen().map(|slot| slot.rank as u64).sum(),
                words: plan.bytes(BufferRole::ModeWords) * own / all.max(1),
                rest: 12 * vertices,
            }
        }
    }
}

impl KernelBenchmark for DeformerBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn turns(&self) -> usize {
        self.inputs.len()
    }

    fn complete(&self, device: &Device, turn: usize) -> Result<()> {
        if self.listed { self.launch_all_positions(device, turn) } else { Ok(()) }
    }

    fn launch(&self, device: &Device, turn: usize) -> Result<()> {
        let inputs = self.inputs(turn);
        self.turns.start(turn);
        if self.listed {
            // SAFETY: as in `launch_all_positions`; `apply` has written the tile list.
            unsafe { self.deform.launch_tile_list(device, inputs) }?;
        } else {
            self.launch_all_positions(device, turn)?;
        }
        if self.extent == StepOutputs::Whole {
            // SAFETY: as in `launch_all_positions`.
            unsafe { self.bounds.launch(device, inputs, &self.deform) }?;
        }
        // SAFETY: as in `launch_all_positions`.
        self.normals.as_ref().map_or(Ok(()), |normals| unsafe { normals.launch(device, inputs) })
    }

    fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let mut numbers = vec![0.0_f32; (self.plan.bytes(BufferRole::Positions) / 4) as usize];
        self.outputs.read(device, 0, &mut numbers)?;
        if self.extent != StepOutputs::Uq {
            return Ok(numbers);
        }
        let slots = &self.scene.layout.slots;
        Ok(self.turns.finish_on_host(|domain, vertex| {
            let at = 3 * (slots[domain].first_vertex + vertex);
            [numbers[at], numbers[at + 1], numbers[at + 2]]
        }))
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        let ComputedCounts { vertices, transforms, coordinates, words, rest } = self.counts;
        let words = self.kept().map_or(("U", words), |share| ("U kept", (share * words as f64) as u64));
        let mut bytes = vec![words, ("scales", self.plan.bytes(BufferRole::Scales)), ("q", 4 * coordinates)];
        bytes.push(("u or x", 12 * vertices));
        if self.scene.needs.displacements && self.extent != StepOutputs::Uq {
            bytes.push(("u kept", 12 * vertices));
        }
        if self.extent != StepOutputs::Uq {
            bytes.extend([("x0", rest), ("T", transforms)]);
        }
        if self.extent == StepOutputs::Whole {
            let roles = [BufferRole::RestNormals, BufferRole::Normals, BufferRole::RestTangents, BufferRole::Tangents];
            bytes.push(("normals and tangents", roles.iter().map(|role| self.plan.bytes(*role)).sum()));
        }
        bytes
    }

    fn launches(&self) -> usize {
        let more = [self.extent == StepOutputs::Whole, self.normals.is_some()].map(usize::from);
        self.deform.kernels().len() + more[0] + more[1]
    }

    fn kernels(&self) -> Vec<KernelAttributes> {
        let functions = self.deform.kernels().into_iter().chain([("bounds", self.bounds.function())]);
        let functions = functions.chain(self.normals.iter().map(|normals| ("normals", normals.function())));
        functions.filter_map(|(name, function)| KernelAttributes::of(name, function).ok()).collect()
    }
}
