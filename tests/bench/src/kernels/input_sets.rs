//! Input sets of kernel benchmarks: the inputs of several steps, on the device and on the host.

use std::cell::Cell;
use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// The part of a step that a kernel benchmark launches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum StepPart {
    /// u = U q alone. For validation, the host computes x = T (x0 + u) in f64.
    Uq,
    /// u = U q and the vertex update.
    Whole,
}

impl StepPart {
    /// The name of a benchmark that launches this part.
    pub(super) fn benchmark_name(self, name: &str) -> String {
        match self {
            Self::Uq => format!("{name}_uq"),
            Self::Whole => name.to_owned(),
        }
    }
}

/// Minimum number of vertices per parallel task on the host, so that scheduling costs little.
const MIN_TASK_VERTICES: usize = 4096;

/// Device addresses of one input set.
#[derive(Debug, Clone, Copy)]
pub(super) struct InputAddresses {
    pub q: u64,
    pub transforms: u64,
}

/// The inputs of several steps of a scene, on the device and on the host. An input set belongs to one step.
#[derive(Debug)]
pub(super) struct InputSets {
    scene: Arc<Scene>,
    states: Vec<SceneState>,
    q: DeviceBuffer,
    transforms: DeviceBuffer,
    /// Bytes from one input set to the next, for q and for the transforms.
    strides: [u64; 2],
    /// Index of the input set that [`Self::select`] returned last.
    selected: Cell<usize>,
}

impl InputSets {
    /// Uploads the inputs of each state. `pack` returns q and the transforms of a state as the kernel reads them; their
    /// lengths must be equal for all states.
    ///
    /// # Errors
    /// `Invalid` when there is no state or a state does not fit the scene; `Fault` when the device fails.
    pub(super) fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        pack: impl Fn(&SceneState) -> [Vec<f32>; 2],
    ) -> Result<Self> {
        if states.is_empty() {
            return Err(invalid("states", "at least 1", 0));
        }
        let is_mismatched = |state: &&SceneState| {
            state.q.len() != scene.layout.coordinates || state.transforms.len() != scene.transform_roots.count()
        };
        if let Some(mismatched) = states.iter().find(is_mismatched) {
            let expected =
                format!("{} coordinates, {} transforms", scene.layout.coordinates, scene.transform_roots.count());
            let lengths = format!("{} and {}", mismatched.q.len(), mismatched.transforms.len());
            return Err(invalid("states", expected, lengths));
        }
        let [mut q, mut transforms] = [Vec::new(), Vec::new()];
        for state in states {
            let packed = pack(state);
            for (numbers, packed_numbers) in [&mut q, &mut transforms].into_iter().zip(packed) {
                numbers.extend_from_slice(&packed_numbers);
                // Each input set begins at a multiple of 16 bytes.
                numbers.resize(numbers.len().next_multiple_of(4), 0.0);
            }
        }
        let strides = [&q, &transforms].map(|numbers| 4 * (numbers.len() / states.len()) as u64);
        let (q, transforms) = (DeviceBuffer::upload(device, &q)?, DeviceBuffer::upload(device, &transforms)?);
        let (scene, states) = (Arc::clone(scene), states.to_vec());
        Ok(Self { scene, states, q, transforms, strides, selected: Cell::new(0) })
    }

    pub(super) const fn count(&self) -> usize {
        self.states.len()
    }

    /// Returns the addresses of an input set, and selects it for [`Self::compute_positions_on_host`]. The index is
    /// taken modulo the number of input sets.
    pub(super) fn select(&self, input_set: usize) -> InputAddresses {
        let input_set = input_set % self.states.len();
        self.selected.set(input_set);
        let [q_offset, transforms_offset] = self.strides.map(|stride| stride * input_set as u64);
        InputAddresses { q: self.q.address() + q_offset, transforms: self.transforms.address() + transforms_offset }
    }

    /// x = T (x0 + u) of the selected input set, three f32 per vertex. Each coordinate is computed in f64 and rounded
    /// once, so that only the error of u remains. `u` returns the displacement of a vertex. Its arguments are the
    /// domain and the index of the vertex in the domain.
    pub(super) fn compute_positions_on_host(&self, u: impl Fn(usize, usize) -> [f32; 3] + Sync) -> Vec<f32> {
        let state = &self.states[self.selected.get()];
        let mut positions = Vec::with_capacity(3 * self.scene.layout.vertices);
        let mut domain_positions: Vec<[f32; 3]> = Vec::new();
        for domain in 0..self.scene.domains.len() {
            // Three rows of four numbers.
            let t = state.composed_transform(&self.scene, domain).to_f64();
            let transform_vertex = |(vertex, rest): (usize, &[f32; 3])| {
                let u = u(domain, vertex);
                let [x, y, z] = [0, 1, 2].map(|axis| f64::from(rest[axis]) + f64::from(u[axis]));
                let transformed =
                    |row: usize| t[4 * row] * x + t[4 * row + 1] * y + t[4 * row + 2] * z + t[4 * row + 3];
                [0, 1, 2].map(|axis| transformed(axis) as f32)
            };
            let rest = self.scene.shape_of(domain).mesh.rest_positions().par_iter().enumerate();
            rest.with_min_len(MIN_TASK_VERTICES).map(transform_vertex).collect_into_vec(&mut domain_positions);
            positions.extend_from_slice(domain_positions.as_flattened());
        }
        positions
    }
}
